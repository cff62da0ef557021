"""How well a system can explain samples at all: least squares without weights, to compare corrected samples with given.

Rows are those of the weak form. Each coordinate's rows count by their own size: of the torque where they hold one, else
of the terms that nominal values make of them. So parameters that shrink to zero explain no torque, and samples that no
parameters fit leave a large share. Undescribed friction and offset are allowed for at every joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.diagnosis.evidence import least_squares
from sms_online.diagnosis.record import Segment, excerpts
from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.scale_free import HomogeneousRows
from sms_online.diagnosis.weak_windows import SeenMotion, WeakWindows, WindowPlaces
from sms_online.effects.friction import sign
from sms_online.effects.possible import not_negative
from sms_online.model.effect import Inputs
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.momentum_windows import EXPONENT
from sms_online.pipeline.smoothing import HALF_WIDTHS, stride
from sms_online.stream import Array, Indices, Mask

# Windows overlap by half.
HALVES = 2
# Half filters in a window.
FILTERS = 20
# Rows of which nominal values make less than this share of the largest are of no motion.
LEAST_SIZE = 1e-9
# Parameters that explain less of the torques than this share explain nothing.
SMALLEST = 1e-6
# Laws of friction and offset that every joint may have.
LAWS = 3
# Seconds of a session, in stretches, that show what is there all the time.
SOME, STRETCH = 8.0, 4.0
# Rows for each unknown that are wanted where a session is long enough.
WANTED_ROWS = 6.0


@dataclass(frozen=True)
class RoughFit:
    """What least squares leaves of samples.

    beta (n,): parameters. left (rows,): rms share of each coordinate's rows that is not explained. nominal (rows,): the
    same with nominal values in place of those fitted, of what friction does not explain.
    """

    beta: Array
    left: Array
    nominal: Array


def stretches(session: Estimator | SessionRows, segments: Sequence[Segment]) -> list[Segment]:
    """Parts of a session that suffice for a rough fit."""
    system, rate = session.model.system, session.model.system.sample_rate
    windows = WANTED_ROWS * (session.base.n + LAWS * len(system.joints)) / session.model.layout.n_v
    duration = max(SOME, STRETCH * np.ceil(windows * system.windows.momentum / HALVES / STRETCH))
    return excerpts(segments, round(STRETCH * rate), round(duration * rate))


class RoughRows:
    """Rows of some samples as a session reads them, errors and all.

    count: number of windows. for_each: rows for each unknown of a fit.
    """

    def __init__(self, session: Estimator | SessionRows, segments: Sequence[Segment]) -> None:
        """Raises numpy.linalg.LinAlgError where there is no window, or rows are no numbers."""
        model, base = session.model, session.base
        layout, rate = model.layout, model.system.sample_rate
        width = round(model.system.windows.momentum * rate)
        M = max((HALF_WIDTHS[0], *(half for half in HALF_WIDTHS if FILTERS * half <= width)))
        starts = [
            np.arange(M, each.index.size - M - width - 1, max(1, width // HALVES), dtype=np.int64) for each in segments
        ]
        self.count = count = sum(each.size for each in starts)
        if 2 * base.n > count * layout.n_v:
            raise np.linalg.LinAlgError("too few windows without a gap")
        where = WindowPlaces(
            segment=np.repeat(np.arange(len(starts)), [each.size for each in starts]),
            start=np.concatenate(starts),
            half_width=np.full(count, M),
            width=width,
            exponent=EXPONENT,
            stride=lambda M: stride(M, width),
        )
        weak = WeakWindows(where, layout, session.sensing, segments, rate)
        self._motors = list(layout.theta_m)

        needed = model.of_parameters(base.needed)

        def inertia(motion: SeenMotion) -> tuple[Array, Array]:
            inputs = Inputs(motion.torque, np.zeros((len(motion.samples), model.n_states)))
            return needed.momentum_columns(motion.x, motion.v, inputs=inputs)

        def drives(motion: SeenMotion) -> tuple[None, Array]:
            G = np.zeros((*motion.v.shape, 1 + LAWS * len(self._motors)))
            for i, motor in enumerate(self._motors):
                speed = motion.v[:, motor]
                G[:, motor, 0] = -motion.torque[:, i]
                own = slice(1 + LAWS * i, 1 + LAWS * (i + 1))
                G[:, motor, own] = np.stack((-sign(speed), -speed, np.ones_like(speed)), axis=1)
            return None, G

        physical, driven = weak.columns(inertia), weak.columns(drives)
        if not (np.all(np.isfinite(physical)) and np.all(np.isfinite(driven))):
            raise np.linalg.LinAlgError("rows that are no numbers")
        self._torque, self._friction = driven[..., 0], driven[..., 1:]
        self._Y, self._known = base.columns(physical), base.known_part(physical)
        self._nominal = base.values(model.nominal)
        self._inertial = np.isin(base.independent, model.inertial)
        laws = np.tile([True, True, False], len(self._motors))  # an offset has either sign
        self._positive = np.concatenate(([not_negative(p.name) for p in base.parameters], laws))
        terms = np.sqrt(np.mean(np.sum((self._Y * self._nominal) ** 2, axis=2), axis=0))
        torque = np.sqrt(np.mean(self._torque**2, axis=0))
        self._homogeneous = torque == 0.0
        self._expected = np.sqrt(np.mean((self._Y @ self._nominal) ** 2, axis=0))
        stated: Array = np.asarray(np.where(torque > 0.0, torque, terms))
        # Without nominal values it is not known what counts as much.
        largest = np.sqrt(np.mean(np.sum(self._Y**2, axis=2), axis=0))
        self._size: Array = np.asarray(np.where(stated > 0.0, stated, largest))
        self._used: Indices = np.flatnonzero(self._size > LEAST_SIZE * self._size.max())
        self._size = np.maximum(self._size, LEAST_SIZE * self._size.max())
        self.for_each = count * self._used.size / (base.n + LAWS * len(self._motors))

    def fit(self) -> RoughFit:
        """The fit of all rows."""
        b = self._torque - self._known
        size = self._size.copy()
        # A common factor of all torques is one of all parameters: rows without a torque count by theirs.
        alike = self._ratio(self._torque)
        size[self._homogeneous] *= alike
        solution, left = _left(np.concatenate((self._Y, self._friction), axis=2), b, size)
        # Nor do they count less where the parameters have not followed, or those of other rows alone.
        beta = solution[: self._nominal.size]
        terms = np.sqrt(np.mean(np.sum((self._Y * beta) ** 2, axis=2), axis=0))
        smallest = SMALLEST * size
        followed = size / np.maximum(terms, smallest)
        followed = np.maximum(followed, alike / max(self._ratio(self._Y @ beta), SMALLEST * alike))
        left[self._homogeneous] *= followed[self._homogeneous]
        return RoughFit(beta, left[self._used], self._by_nominal(b, self._size))

    def freed(self, factors: Array | None = None, start: Array | None = None) -> RoughFit:
        """The fit with the torques of the joints times factors (joints,), ones unless given.

        Rows without a torque count as in `shares`: else they follow a torque that is too large. start (n,): parameters
        to begin with, near nominal values unless given.
        """
        scale = np.ones(self._torque.shape[1])
        if factors is not None:
            scale[self._motors] = factors
        size, every = self._size * np.abs(scale), np.ones(self.count, dtype=np.bool_)
        # A common factor of all torques is one of all parameters.
        near = self._nominal * self._ratio(self._torque * scale)
        solution, left = self._free(self._torque * scale, size, every, every, near, start=start)
        return RoughFit(solution[: near.size], left, self._by_nominal(self._torque * scale - self._known, size))

    def shares(self, fitted: Mask) -> Array:
        """rms shares (rows,) of what a fit of some windows (W,) leaves of the others.

        Of rows without a torque a share of the size of their terms, which no scale of the parameters changes.
        """
        return self._free(self._torque, self._size, fitted, ~fitted, self._nominal)[1]

    def factor(self, joint: int) -> float:
        """Factor of a joint's torque with which its rows follow from all others, where another torque fixes the scale.

        joint: its index. Other rows determine the parameters, but for what only its own rows hold.
        """
        motor, every = self._motors[joint], np.ones(self.count, dtype=np.bool_)
        others, own = self._torque.copy(), np.zeros((*self._torque.shape, 1))
        own[:, motor, 0], others[:, motor] = -self._torque[:, motor], 0.0
        return float(self._free(others, self._size, every, every, self._nominal * self._ratio(others), own)[0][-1])

    def stated(self, torque: Array | None = None) -> Array:
        """Torques of the joints (joints,) over what nominal values make of them, rms; NaN where they make none.

        torque (W, n_v): those of the samples unless given.
        """
        expected = self._expected[self._motors]
        own = (self._torque if torque is None else torque)[:, self._motors]
        rms = np.sqrt(np.mean(own**2, axis=0))
        return np.asarray(np.divide(rms, expected, out=np.full_like(rms, np.nan), where=expected > 0.0))

    def _free(
        self,
        torque: Array,
        size: Array,
        fitted: Mask,
        others: Mask,
        near: Array,
        beside: Array | None = None,
        start: Array | None = None,
    ) -> tuple[Array, Array]:
        """Solution (n + c,) of some windows (W,), rows with torques (W, n_v) by their size (n_v,), and shares (rows,).

        near (n,): parameters that what the rows do not determine stays near. beside (W, n_v, k): columns that are
        fitted with those of friction. start: as in `freed`.
        """
        Y, friction = self._Y / size[:, None], self._friction / size[:, None]
        positive = self._positive
        if beside is not None:
            friction = np.concatenate((friction, beside / size[:, None]), axis=2)
            positive = np.append(positive, [False] * beside.shape[2])
        b = (torque - self._known) / size
        speeds, n = np.flatnonzero(self._homogeneous).tolist(), Y.shape[2]
        free = HomogeneousRows(Y[fitted], speeds, self._inertial)
        begin = near if start is None else start
        solution = free.solved(friction[fitted], b[fitted], begin, near, SMALLEST, positive)
        left = b - np.concatenate((Y, friction), axis=2) @ solution
        squares = free.squares(solution[:n], left[others], self._nominal)
        # Of rows that the parameters leave no terms nothing is explained.
        return solution, np.nan_to_num(np.sqrt(squares[self._used]), nan=1.0)

    def _ratio(self, torque: Array) -> float:
        """Geometric mean of what is `stated` of torques (W, n_v), over the joints that have both; 1 without any."""
        known = self.stated(torque)
        known = known[known > 0.0]
        return float(np.exp(np.mean(np.log(known)))) if known.size else 1.0

    def _by_nominal(self, b: Array, size: Array) -> Array:
        """What nominal values, friction and offsets leave of rows b (W, n_v), as shares (rows,) of those used.

        Of rows with a torque a share of what friction and offsets alone leave: they explain a torque in any unit, as
        far as it is friction. Of others a share of their size (n_v,).
        """
        nominal = _left(self._friction, b - self._Y @ self._nominal, size)[1]
        alone = _left(self._friction, b, size)[1]
        whole = np.where(self._homogeneous, 1.0, np.maximum(alone, SMALLEST))
        return np.asarray((nominal / whole)[self._used])


def _left(columns: Array, b: Array, size: Array) -> tuple[Array, Array]:
    """Solution (n,) of columns (W, n_v, n) for b (W, n_v), and rms (n_v,) of what it leaves, over size (n_v,)."""
    n = columns.shape[2]
    solution = least_squares((columns / size[:, None]).reshape(-1, n), (b / size).ravel())
    return solution, np.sqrt(np.mean(((b - columns @ solution) / size) ** 2, axis=0))
