"""Elastic coordinates of a link from its markers' readings, whether or not they are as many."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.model import so3
from sms_online.model.flexible import LinkKinematics
from sms_online.model.points import LinkPoints
from sms_online.model.rod import NEWTON_STEPS
from sms_online.stream import Array

# Deflection of a link that is usual, as a share of its length. Beside points good to 0.1 mm it shapes what they do not
# show, and hardly changes what they do.
USUAL_DEFLECTION = 0.03
# What a link's frame is off by, made of readings of base and joints as it is, m and rad, as a multiple of the points'
# noise. With none a link behind noisy frames comes out bent; a hundred times as much lets it hang from a wrong slope.
FRAME_NOISE = 3.0
# Steps to a shape at most, more than NEWTON_STEPS where it is far from straight, and halvings of one of them. Rounding
# may raise the cost by the share SAME. A step that lowers twice the negative log likelihood by less than CONVERGED is
# the last.
MOST_STEPS, MOST_HALVINGS, SAME, CONVERGED = 40, 8, 1e-9, 1e-3


class SensedShape:
    """Shape of a link with some of its markers' readings measured.

    Where they are fewer than the elastic coordinates, the shape is the static one: of all that agree with the readings
    the one of least strain energy, as a link takes that is only held at its markers. Limitation: the load along a
    moving link bends it otherwise; in the paper's example slopes are off by 0.012 rad of 0.17 rad then.

    measured: which of `kinematics.marker_names` are read; at least one.
    """

    def __init__(self, kinematics: LinkKinematics, measured: Sequence[int]) -> None:
        self._kinematics = kinematics
        self._measured = list(measured)
        self.complete = len(self._measured) == len(kinematics.marker_names)
        # Rigidities are not known here; each kind of strain counts alike.
        self._compliance = np.linalg.inv(np.sum(list(kinematics.stiffness.values()), axis=0))

    def coordinates(self, readings: Array) -> Array:
        """Elastic coordinates q_f (B, n_f) for readings (B, measured), m and rad."""
        if self.complete:
            return self._kinematics.coordinates(readings)
        q_f = np.zeros((readings.shape[0], self._kinematics.n_f))
        for _ in range(NEWTON_STEPS):
            J = self._kinematics.marker_jacobian(q_f)[:, self._measured]
            residual = readings - self._kinematics.markers(q_f)[:, self._measured]
            bent = self._compliance @ J.swapaxes(1, 2)
            ahead = residual[..., None] + J @ q_f[..., None]
            q_f = (bent @ np.linalg.solve(J @ bent, ahead))[..., 0]
        return q_f


class PointedShape:
    """Shape of a link whose markers cameras see as points: of all that agree with them, that of least strain energy.

    A frame that is off by its noise would bend a link that is held to it. So it may move by as much.
    length: of the link, m. axes: of {i} that are active. sigma: noise of the points, m.
    """

    def __init__(
        self, length: float, kinematics: LinkKinematics, points: LinkPoints, axes: list[int], sigma: float
    ) -> None:
        self._points, self._axes, self._sigma, self._n_f = points, axes, sigma, kinematics.n_f
        self._turning = [2] if axes == [0, 1] else [0, 1, 2]
        stiffness = np.sum(list(kinematics.stiffness.values()), axis=0)
        # Rigidities are not known here; each kind of strain counts alike.
        tip = kinematics.shape(np.zeros((1, kinematics.n_f))).tip_J[0]
        soft = float(np.trace(tip @ np.linalg.solve(stiffness, tip.T)))
        frame = np.full(len(axes) + len(self._turning), FRAME_NOISE * sigma)
        self._precision = np.diag(np.concatenate((np.zeros(kinematics.n_f), 1.0 / frame**2)))
        self._precision[: kinematics.n_f, : kinematics.n_f] = stiffness * soft / (USUAL_DEFLECTION * length) ** 2

    @property
    def usual(self) -> Array:
        """Covariance (n_f, n_f) of the elastic coordinates of the shapes that the link usually takes."""
        return np.asarray(np.linalg.inv(self._precision[: self._n_f, : self._n_f]))

    def coordinates(self, readings: Array, origin: Array, rotation: Array) -> Array:
        """q_f (B, n_f) for positions (B, n · axes), m, NaN where a marker is not seen.

        origin (B, 3), m, rotation (B, 3, 3): of the link's frame {i}. NaN where no marker is seen.
        """
        B, axes = len(readings), self._axes
        if not B:
            return np.empty((0, self._n_f))
        seen = np.zeros((B, readings.shape[1] // len(axes), 3))
        seen[..., axes] = readings.reshape(B, -1, len(axes))
        seen[..., axes] -= origin[:, None, axes]
        seen = (seen @ rotation)[..., axes].reshape(B, -1)
        z = self._nearest(seen)
        z[np.isnan(seen).all(axis=1)] = np.nan
        return z[:, : self._n_f]

    def _nearest(self, seen: Array) -> Array:
        """Elastic coordinates and displacement of the frame (B, n_f + d) for points in {i} (B, n · axes), by
        Gauss-Newton steps that are halved where they lead away."""
        z = np.zeros((len(seen), len(self._precision)))
        step, cost, moving = z.copy(), np.full(len(seen), np.inf), np.arange(len(seen))
        for k in range(MOST_STEPS):
            J, off, now = self._about(z[moving], seen[moving])
            for share in (*[0.5] * MOST_HALVINGS, 0.0):  # in the end none of it
                worse = ~(now <= (1.0 + SAME) * cost[moving])
                if not worse.any():
                    break
                back = moving[worse]
                z[back] -= (1.0 - share) * step[back]
                step[back] *= share
                J[worse], off[worse], now[worse] = self._about(z[back], seen[back])
            cost[moving] = now
            weighted = np.where(np.isnan(off)[..., None], 0.0, J) / self._sigma**2
            right = (weighted.swapaxes(1, 2) @ np.nan_to_num(off)[..., None])[..., 0] - z[moving] @ self._precision
            ahead = np.linalg.solve(weighted.swapaxes(1, 2) @ J + self._precision, right[..., None])[..., 0]
            step[moving] = ahead
            z[moving] += ahead
            if k + 1 >= NEWTON_STEPS:
                moving = moving[np.sum(ahead * right, axis=1) > CONVERGED]
                if not moving.size:
                    return z
        z[moving] -= step[moving]  # which nothing has tried
        return z

    def _about(self, z: Array, seen: Array) -> tuple[Array, Array, Array]:
        """Derivatives (K, n · axes, n_f + d) of points at z (K, n_f + d), what these are off by, and the cost (K,)."""
        local, axes = self._points.local(z[:, : self._n_f]), self._axes
        moved = np.broadcast_to(np.eye(3)[:, axes], (*local.position.shape, len(axes)))
        turned = -so3.skew(local.position)[..., self._turning]
        J = np.concatenate((local.by_elastic, moved, turned), axis=3)[:, :, axes].reshape(len(z), -1, z.shape[1])
        frame = (J[..., self._n_f :] @ z[:, self._n_f :, None])[..., 0]
        off = seen - local.position[..., axes].reshape(len(z), -1) - frame
        cost = np.nansum(off**2, axis=1) / self._sigma**2 + np.sum((z @ self._precision) * z, axis=1)
        return J, off, cost
