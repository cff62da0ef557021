"""Flexible link with `linear` kinematics: Euler–Bernoulli elements on a straight line, (1)–(4), (11), (13), (14)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial

import numpy as np
from numpy.polynomial import Polynomial

from sms_online.description.bodies import FlexibleLink
from sms_online.model import so3
from sms_online.model.flexible import Sections, Shape, ShapeRate, repeated
from sms_online.model.layout import nodal_names
from sms_online.stream import Array

# Gauss points an element: exact to degree 7; the kinetic energy (7) of cubic elements has degree 6.
GAUSS_POINTS = 4

FIELDS = ("u_x", "u_y", "u_z", "theta_x", "theta_y", "theta_z")
# The rotation that a displacement's slope is, with its sign.
SLOPES = {"u_y": ("theta_z", 1.0), "u_z": ("theta_y", -1.0)}


def element_shape_functions(length: float) -> dict[tuple[str, str, int], Polynomial]:
    """S_j of (3) as polynomials in x_j: (field, nodal coordinate, node 1 or 2) to polynomial.

    Bending is cubic (Hermite), traction and torsion linear; θ_y = -u_z', θ_z = u_y' at the nodes.
    Source: the paper's [11].
    """
    s = Polynomial([0.0, 1.0 / length])
    linear = {1: 1 - s, 2: s}
    displacement = {1: 1 - 3 * s**2 + 2 * s**3, 2: 3 * s**2 - 2 * s**3}
    slope = {1: length * (s - 2 * s**2 + s**3), 2: length * (s**3 - s**2)}
    functions: dict[tuple[str, str, int], Polynomial] = {}
    for node in (1, 2):
        functions["u_x", "u_x", node] = linear[node]
        functions["theta_x", "theta_x", node] = linear[node]
        for u, theta, sign in (("u_y", "theta_z", 1.0), ("u_z", "theta_y", -1.0)):
            functions[u, u, node] = displacement[node]
            functions[u, theta, node] = sign * slope[node]
    return functions


class LinearLink:
    """Nodal displacements of equal elements as coordinates; the paper's link."""

    def __init__(self, link: FlexibleLink) -> None:
        self.length = link.length
        self._elements = link.elements
        self._names = nodal_names(link)
        self.first_order = link.tip_rotation == "first_order"
        names = nodal_names(link)
        self.n_f = link.elements * len(names)
        self.marker_names = tuple(f"marker_{j}.{name}" for j in range(1, link.elements + 1) for name in names)
        element_length = link.length / link.elements
        functions = element_shape_functions(element_length)
        nodes, weights = np.polynomial.legendre.leggauss(GAUSS_POINTS)
        local = 0.5 * element_length * (nodes + 1.0)
        G = GAUSS_POINTS * link.elements
        self.weights = np.tile(0.5 * element_length * weights, link.elements)
        self._x = np.zeros((1, G, 3))
        self._J = np.zeros((1, G, 3, self.n_f))
        self._twist = np.zeros(
            (1, G, 3, self.n_f)
        )  # of the sections, axial part only: rotary inertia of bending is left out
        stiffness = {
            "axial_rigidity": np.zeros((self.n_f, self.n_f)),
            "flexural_rigidity_y": np.zeros((self.n_f, self.n_f)),
            "flexural_rigidity_z": np.zeros((self.n_f, self.n_f)),
            "torsional_rigidity": np.zeros((self.n_f, self.n_f)),
        }
        strain = {
            "axial_rigidity": ("u_x", 1),
            "flexural_rigidity_y": ("u_z", 2),
            "flexural_rigidity_z": ("u_y", 2),
            "torsional_rigidity": ("theta_x", 1),
        }
        for element in range(link.elements):
            rows = slice(GAUSS_POINTS * element, GAUSS_POINTS * (element + 1))
            self._x[0, rows, 0] = element * element_length + local
            column = {
                (name, node): (element + node - 2) * len(names) + k
                for k, name in enumerate(names)
                for node in (1, 2)
                if element + node >= 2  # node 1 of the first element is clamped
            }
            for (field, name, node), function in functions.items():
                if (name, node) in column and field.startswith("u_"):
                    self._J[0, rows, FIELDS.index(field), column[name, node]] = function(local)
                if (name, node) in column and field == "theta_x":
                    self._twist[0, rows, 0, column[name, node]] = function(local)
            for rigidity, (field, order) in strain.items():
                B = np.zeros((GAUSS_POINTS, self.n_f))
                for (name, node), k in column.items():
                    if (field, name, node) in functions:
                        B[:, k] = functions[field, name, node].deriv(order)(local)
                stiffness[rigidity] += (B * self.weights[rows, None]).T @ B
        self.stiffness = {name: S for name, S in stiffness.items() if S.any()}
        self._tip_J = np.zeros((1, 3, self.n_f))
        self._tip_theta = np.zeros((3, self.n_f))
        for k, name in enumerate(names):
            target = self._tip_J[0] if name.startswith("u_") else self._tip_theta
            target[FIELDS.index(name) % 3, self.n_f - len(names) + k] = 1.0
        self._tip_x = np.array([link.length, 0.0, 0.0])
        self._tangent = np.zeros((1, G, 3))
        self._tangent[..., 0] = 1.0
        self._no_J_rate = np.zeros_like(self._J)
        self._no_tip_rate = np.zeros_like(self._tip_J)

    def shape(self, q_f: Array) -> Shape:
        """Shape for nodal displacements q_f (B, n_f), m and rad; tip rotation exp(θ_d×), or (13) as printed."""
        theta = q_f @ self._tip_theta.T
        turn = None if self.first_order else so3.RotationVector(theta)
        if turn is None:
            rotation, tip_spin = np.eye(3) + so3.skew(theta), self._tip_theta[None]
        else:
            rotation, tip_spin = turn.matrix, turn.left_jacobian @ self._tip_theta
        G = self._J.shape[1]
        if len(self._J) == 1:  # constant: one matrix product for the whole block
            bent = q_f @ self._J[0].reshape(3 * G, self.n_f).T
        else:
            bent = self._J.reshape(-1, 3 * G, self.n_f) @ q_f[..., None]
        return Shape(
            points=self._x + bent.reshape(-1, G, 3),
            J=self._J,
            tangent=self._tangent,
            spin=self._twist,
            tip=self._tip_x + q_f @ self._tip_J[0].T,
            tip_J=self._tip_J,
            tip_rotation=rotation,
            tip_spin=tip_spin,
            tip_turn=turn,
        )

    def shape_rate(self, q_f: Array, q_f_dot: Array, shape: Shape) -> ShapeRate:
        """Rates of `shape` for q̇_f (B, n_f)."""
        if shape.tip_turn is None:
            spin_rate = self._no_tip_rate
        else:
            spin_rate = shape.tip_turn.left_jacobian_rate(q_f_dot @ self._tip_theta.T) @ self._tip_theta
        return ShapeRate(
            J=self._no_J_rate,
            spin=self._no_J_rate,
            tip_J=self._no_tip_rate,
            tip_spin=spin_rate,
            tip=q_f_dot @ self._tip_J[0].T,
            tip_angular=(shape.tip_spin @ q_f_dot[..., None])[..., 0],
        )

    def sections(self, stations: Array) -> Callable[[Array], Sections]:
        """Sections at stations (n,), m from the root; they turn by the slopes as the tip does."""
        element_length = self.length / self._elements
        functions = element_shape_functions(element_length)
        fields = np.zeros((stations.size, len(FIELDS), self.n_f))
        for at, s in zip(fields, stations.tolist(), strict=True):
            element = min(int(s / element_length), self._elements - 1)
            local = s - element * element_length
            for (field, name, node), function in functions.items():
                if name not in self._names or element + node < 2:  # node 1 of the first element is clamped
                    continue
                column = (element + node - 2) * len(self._names) + self._names.index(name)
                at[FIELDS.index(field), column] = function(local)
                if field in SLOPES:
                    rotation, sign = SLOPES[field]
                    at[FIELDS.index(rotation), column] = sign * function.deriv()(local)
        displacement, theta = fields[:, :3], fields[:, 3:]
        straight = stations[:, None] * np.array([1.0, 0.0, 0.0])

        # No local function: models go to other processes.
        return partial(self._at_stations, straight, displacement, theta)

    def _at_stations(self, straight: Array, displacement: Array, theta: Array, q_f: Array) -> Sections:
        center = straight + (displacement @ q_f[:, None, :, None])[..., 0]
        angle = (theta @ q_f[:, None, :, None])[..., 0]
        if self.first_order:
            return Sections(center, np.eye(3) + so3.skew(angle), displacement[None], theta[None])
        turn = so3.RotationVector(angle)
        return Sections(center, turn.matrix, displacement[None], turn.left_jacobian @ theta)

    def markers(self, q_f: Array) -> Array:
        """The nodal coordinates themselves, (B, n_f)."""
        return q_f

    def marker_jacobian(self, q_f: Array) -> Array:
        """The identity: the coordinates are the markers' readings."""
        return np.broadcast_to(np.eye(self.n_f), (q_f.shape[0], self.n_f, self.n_f))

    def coordinates(self, markers: Array) -> Array:
        """The nodal coordinates themselves, (B, n_f)."""
        return markers

    def stacked(self, others: Sequence[LinearLink], repeats: Sequence[int]) -> LinearLink:
        """See `LinkKinematics`."""
        out = copy(self)
        out.weights, out._tip_x = (
            repeated([getattr(other, name) for other in others], repeats) for name in ("weights", "_tip_x")
        )
        out._x, out._J, out._twist = (
            repeated([getattr(other, name)[0] for other in others], repeats) for name in ("_x", "_J", "_twist")
        )
        return out
