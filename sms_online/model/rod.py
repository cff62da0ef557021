"""Flexible link with `exact` kinematics: an inextensible, geometrically exact rod.

Its coordinates are the coefficients of its strain fields, twist κ_x and curvatures κ_y, κ_z over the arc length s:
R' = R κ×, r' = R e_x. A planar rod has the slope θ(s) = ∫ κ_z ds. Strain energy is quadratic with constant matrices.
Source: the strain parametrisation of Boyer, Lebastard, Candelier, Renda, IEEE Trans. Robotics 37 (2021) 847.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial

import numpy as np
from numpy.polynomial import Legendre, Polynomial

from sms_online.description.bodies import FlexibleLink
from sms_online.model import so3
from sms_online.model.flexible import Sections, Shape, ShapeRate, repeated
from sms_online.model.layout import STRAIN, nodal_names, strain_names
from sms_online.stream import Array

# Gauss points along the rod: with as many for its shape a spatial rod's rates at 0.3 rad (and the tip of a planar one
# at 1 rad) are right to 1e-12; each element's coefficients need two more a field for a mass matrix of full rank.
SHAPE_POINTS = 12
POINTS_AN_ELEMENT = 2
# Picard iterations of R = 1 + ∫ R κ×: the error falls as (total angle)^k / k!, below 1e-15 for 1 rad.
PICARD_ITERATIONS = 18
# Newton steps from marker readings to strain coefficients; it converges quadratically and needs 4 for 1 rad.
NEWTON_STEPS = 5

RIGIDITY = {"twist": "torsional_rigidity", "curvature_y": "flexural_rigidity_y", "curvature_z": "flexural_rigidity_z"}


class ExactRod:
    """Strain coefficients as coordinates; as many a field as the markers determine.

    free_end: the strain fields vanish at s = L (natural boundary condition of a last link without payload).
    """

    def __init__(self, link: FlexibleLink, free_end: bool) -> None:
        self.length = link.length
        names = strain_names(link)
        self.n_f = len(names)
        nodal = nodal_names(link)
        self.marker_names = tuple(f"marker_{j}.{name}" for j in range(1, link.elements + 1) for name in nodal)
        self._nodal_rows = [("u_x", "u_y", "u_z", "theta_x", "theta_y", "theta_z").index(name) for name in nodal]
        self._G = SHAPE_POINTS + POINTS_AN_ELEMENT * link.elements
        self._gauss = nodes, weights = np.polynomial.legendre.leggauss(self._G)
        s = 0.5 * link.length * (nodes + 1.0)
        self.weights = 0.5 * link.length * weights
        marker_s = link.length * np.arange(1, link.elements + 1) / link.elements
        # Stations: the Gauss points, where fields are sampled, then the markers; the last marker is the tip.
        self._s = np.concatenate((s, marker_s))
        self._integrate = _cumulative_integration(link.length, nodes, weights, self._s)
        self._axis = np.array([list(STRAIN).index(name.rsplit("_", 1)[0]) for name in names], dtype=int)
        taper = Polynomial([1.0, -1.0 / link.length]) if free_end else Polynomial([1.0])
        self._chi = np.zeros((self._G, self.n_f))
        for k, name in enumerate(names):
            order = int(name.rsplit("_", 1)[1])
            self._chi[:, k] = Legendre.basis(order, [0.0, link.length])(s) * taper(s)
        self.stiffness = {}
        for axis, field in enumerate(STRAIN):
            chi = np.where(self._axis == axis, self._chi, 0.0)
            if chi.any():
                self.stiffness[RIGIDITY[field]] = (chi * self.weights[:, None]).T @ chi
        # With one active field rotations commute and R is the exponential of the integrated strain.
        self._commuting = len(set(self._axis)) == 1
        self._turn = so3.turn_basis(np.eye(3)[self._axis[0]])
        self._fields = np.zeros((self.n_f, 3, self._G))  # strain at the Gauss points per coordinate
        self._fields[np.arange(self.n_f), self._axis] = self._chi.T
        self._one_field = self._one_field_markers() if self._commuting else None
        self._linear_map = self.marker_jacobian(np.zeros((1, self.n_f)))[0]

    def _rotations(self, q_f: Array) -> Array:
        """R (B, stations, 3, 3) of the sections."""
        if self._commuting:
            turned = self._integrate @ self._chi
            angle = q_f @ turned.T if turned.ndim == 2 else (turned @ q_f[..., None])[..., 0]
            return so3.about(self._turn, angle.ravel()).reshape(*angle.shape, 3, 3)
        kappa = np.tensordot(q_f, self._fields, axes=(1, 0)).transpose(0, 2, 1)  # (B, G, 3)
        R = so3.RotationVector(self._integrate @ kappa).matrix
        K = so3.skew(kappa)
        G = self._G
        for _ in range(PICARD_ITERATIONS):
            R = np.eye(3) + _along(self._integrate, R[:, :G] @ K)
        return R

    def shape_at_stations(self, q_f: Array) -> tuple[Array, Array, Array, Array]:
        """R (B, n, 3, 3), r (B, n, 3), Jacobians of spin and position (B, n, 3, n_f) at Gauss points and markers."""
        G = self._G
        R = self._rotations(q_f)
        spin = _along(self._integrate, R[:, :G][..., self._axis] * self._chi[:, None, :])
        tangent = R[:, :G, :, 0]
        r = _along(self._integrate, tangent)
        J = _along(self._integrate, _cross_columns(spin[:, :G], tangent))
        return R, r, spin, J

    def shape(self, q_f: Array) -> Shape:
        """Shape for strain coefficients q_f (B, n_f), 1/m."""
        G = self._G
        R, r, spin, J = self.shape_at_stations(q_f)
        return Shape(
            points=r[:, :G],
            J=J[:, :G],
            tangent=R[:, :G, :, 0],
            spin=spin[:, :G],
            tip=r[:, -1],
            tip_J=J[:, -1],
            tip_rotation=R[:, -1],
            tip_spin=spin[:, -1],
        )

    def shape_rate(self, q_f: Array, q_f_dot: Array, shape: Shape) -> ShapeRate:
        """Rates of `shape` for q̇_f (B, n_f)."""
        G = self._G
        R = self._rotations(q_f)[:, :G]
        Omega = (shape.spin @ q_f_dot[:, None, :, None])[..., 0]
        R_dot = so3.skew(Omega) @ R
        spin_rate = _along(self._integrate, R_dot[..., self._axis] * self._chi[:, None, :])
        tangent_rate = R_dot[..., 0]
        J_rate = _along(
            self._integrate,
            _cross_columns(spin_rate[:, :G], shape.tangent) + _cross_columns(shape.spin, tangent_rate),
        )
        rates = q_f_dot[..., None]
        return ShapeRate(
            J=J_rate[:, :G],
            spin=spin_rate[:, :G],
            tip_J=J_rate[:, -1],
            tip_spin=spin_rate[:, -1],
            tip=(shape.tip_J @ rates)[..., 0],
            tip_angular=(shape.tip_spin @ rates)[..., 0],
        )

    def sections(self, stations: Array) -> Callable[[Array], Sections]:
        """Sections at stations (n,), m from the root."""
        # No local function: models go to other processes.
        return partial(self._at_stations, _cumulative_integration(self.length, *self._gauss, stations))

    def _at_stations(self, integrate: Array, q_f: Array) -> Sections:
        G = self._G
        R = self._rotations(q_f)[:, :G]
        kappa = np.tensordot(q_f, self._fields, axes=(1, 0)).transpose(0, 2, 1)
        turning = R[..., self._axis] * self._chi[:, None, :]
        tangent = R[..., 0]
        return Sections(
            center=_along(integrate, tangent),
            rotation=np.eye(3) + _along(integrate, R @ so3.skew(kappa)),
            J=_along(integrate, _cross_columns(_along(self._integrate[:G], turning), tangent)),
            spin=_along(integrate, turning),
        )

    def _one_field_markers(self) -> _OneFieldMarkers:
        G, angles = self._G, self._integrate @ self._chi
        # By the integrals of sin and 1 - cos of the angle, and by the angle itself.
        nodal = np.zeros((3, 6))
        nodal[:2, :3] = self._turn.reshape(3, 3, 3)[1:, :, 0]
        nodal[2, 3 + self._axis[0]] = 1.0
        displacement, rotation = np.split(nodal[:, self._nodal_rows], [2])
        return _OneFieldMarkers(
            angles[:G], self._integrate[G:], displacement, np.multiply.outer(angles[G:], rotation[0])
        )

    def _read(self, q_f: Array) -> tuple[Array, Array]:
        """Markers (B, n_markers · per node) and their derivatives by q_f (B, n_markers · per node, n_f)."""
        if self._one_field is not None:
            return self._one_field(q_f)
        R, r, spin, J = self.shape_at_stations(q_f)
        G, B = self._G, len(q_f)
        displacement = r[:, G:].copy()
        displacement[..., 0] -= self._s[G:]
        rotation = so3.logarithm(R[:, G:])
        turned = np.linalg.solve(so3.RotationVector(rotation).left_jacobian, spin[:, G:])
        markers = np.concatenate((displacement, rotation), axis=2)[:, :, self._nodal_rows]
        by_q_f = np.concatenate((J[:, G:], turned), axis=2)[:, :, self._nodal_rows]
        return markers.reshape(B, -1), by_q_f.reshape(B, -1, self.n_f)

    def markers(self, q_f: Array) -> Array:
        """Displacements (m) and rotation vectors (rad) of the markers, (B, n_markers · per node), in {i}."""
        return self._read(q_f)[0]

    def marker_jacobian(self, q_f: Array) -> Array:
        """Derivatives of `markers` by q_f, (B, n_markers · per node, n_f)."""
        return self._read(q_f)[1]

    def coordinates(self, markers: Array) -> Array:
        """Strain coefficients q_f (B, n_f) that reproduce the markers' readings, by Newton's method."""
        q_f = np.linalg.solve(self._linear_map, markers.T).T
        for _ in range(NEWTON_STEPS):
            predicted, by_q_f = self._read(q_f)
            q_f = q_f + np.linalg.solve(by_q_f, (markers - predicted)[..., None])[..., 0]
        return q_f

    def stacked(self, others: Sequence[ExactRod], repeats: Sequence[int]) -> ExactRod:
        """See `LinkKinematics`; strain fields by s / L are the same for all lengths. Not for readings of markers."""
        out = copy(self)
        out.weights = repeated([other.weights for other in others], repeats)
        out._integrate = repeated([other._integrate for other in others], repeats)
        return out


class _OneFieldMarkers:
    """Markers of a rod that turns about one axis: sines and cosines of its angles, times constant matrices.

    Every sample of a session is inverted by them, so they are computed without the rest of the shape.
    """

    def __init__(self, angles: Array, integrate: Array, displacement: Array, rotation: Array) -> None:
        """angles (G, n_f): of the sections at the Gauss points by q_f. integrate (M, G): from there to the M markers.
        displacement (2, per node): of a reading by the integrated sin and 1 - cos. rotation (M, n_f, per node): by q_f.
        """
        self._angles = angles
        G, self._n_f = angles.shape
        by_point = np.einsum("mg,kr->kgmr", integrate, displacement).reshape(2, G, -1)
        self._sine, self._versine = by_point
        self._rotation = rotation.transpose(1, 0, 2).reshape(self._n_f, -1)
        self._by_sine, self._by_versine = (
            np.einsum("gj,gf->gjf", part, angles).reshape(G, -1) for part in (self._sine, self._versine)
        )

    def __call__(self, q_f: Array) -> tuple[Array, Array]:
        """The same as `ExactRod._read`."""
        angle = q_f @ self._angles.T
        sine, cosine = np.sin(angle), np.cos(angle)
        markers = sine @ self._sine + (1.0 - cosine) @ self._versine + q_f @ self._rotation
        by_q_f = (cosine @ self._by_sine + sine @ self._by_versine).reshape(len(q_f), -1, self._n_f)
        return markers, by_q_f + self._rotation.T


def _cumulative_integration(length: float, nodes: Array, weights: Array, ends: Array) -> Array:
    """D (ends, nodes): D f = ∫_0^end of the polynomial through samples f at the Gauss points, given on [-1, 1].

    Through Legendre coefficients, which stay well conditioned for any number of points.
    """
    orders = range(nodes.size)
    coefficients = np.array([(k + 0.5) * Legendre.basis(k)(nodes) * weights for k in orders])
    primitives = np.array([Legendre.basis(k).integ(lbnd=-1.0)(2.0 * ends / length - 1.0) for k in orders])
    return np.asarray(0.5 * length * primitives.T @ coefficients)


def _along(D: Array, samples: Array) -> Array:
    """Cumulative integral along axis 1 of samples (B, G, ...)."""
    flat = samples.reshape(samples.shape[0], samples.shape[1], -1)
    return np.asarray((D @ flat).reshape(samples.shape[0], D.shape[-2], *samples.shape[2:]))


def _cross_columns(columns: Array, vector: Array) -> Array:
    """Each column of (B, G, 3, n) crossed with a vector (B, G, 3)."""
    return -so3.skew(vector) @ columns
