"""What the chain and the balances need to know of a flexible link, whatever its kinematics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from sms_online.model.so3 import RotationVector
from sms_online.stream import Array


@dataclass(frozen=True)
class Shape:
    """A link's shape at B configurations in its frame {i}; Jacobians are with respect to its n_f elastic coordinates.

    points (B, G, 3) m: quadrature points. J (B or 1, G, 3, n_f). tangent (B or 1, G, 3): unit axis of each section.
    spin (B or 1, G, 3, n_f): angular velocity of the sections. tip (B, 3), tip_J (B or 1, 3, n_f), tip_rotation (B, 3,
    3), tip_spin (B or 1, 3, n_f): the same at x = L. tip_turn: behind tip_rotation, where it is made of a vector.
    """

    points: Array
    J: Array
    tangent: Array
    spin: Array
    tip: Array
    tip_J: Array
    tip_rotation: Array
    tip_spin: Array
    tip_turn: RotationVector | None = None


@dataclass(frozen=True)
class ShapeRate:
    """Time derivatives of a Shape's Jacobians along q̇_f, same shapes, and the tip's velocity (B, 3), m/s."""

    J: Array
    spin: Array
    tip_J: Array
    tip_spin: Array
    tip: Array
    tip_angular: Array  # (B, 3) rad/s, in {i}


@dataclass(frozen=True)
class Sections:
    """Sections of a link at n stations, at B configurations, in its frame {i}.

    center (B, n, 3) m: on the neutral axis. rotation (B, n, 3, 3). J, spin (B or 1, n, 3, n_f): what elastic
    coordinates do to the centre, and the angular velocity of the section.
    """

    center: Array
    rotation: Array
    J: Array
    spin: Array


class LinkKinematics(Protocol):
    """Kinematics of one flexible link.

    n_f: number of elastic coordinates. weights (G,) m, or (B, G) of a `stacked` one: quadrature weights along the link.
    stiffness: for each rigidity, the matrix (n_f, n_f) that makes its strain energy ½ EI q_fᵀ S q_f, (14).
    marker_names: what `markers` returns.
    """

    n_f: int
    weights: Array
    stiffness: dict[str, Array]
    marker_names: tuple[str, ...]

    def shape(self, q_f: Array) -> Shape:
        """Shape for elastic coordinates q_f (B, n_f)."""

    def shape_rate(self, q_f: Array, q_f_dot: Array, shape: Shape) -> ShapeRate:
        """Rates of `shape` for q̇_f (B, n_f)."""

    def sections(self, stations: Array) -> Callable[[Array], Sections]:
        """Sections at stations (n,), m from the root, as a function of q_f (B, n_f)."""

    def markers(self, q_f: Array) -> Array:
        """Nodal displacements (m) and rotations (rad) of the markers, (B, n_markers · per node), in {i}, (31)."""

    def marker_jacobian(self, q_f: Array) -> Array:
        """Derivatives of `markers` by q_f, (B, n_markers · per node, n_f)."""

    def coordinates(self, markers: Array) -> Array:
        """Inverse of `markers`: q_f (B, n_f)."""

    def stacked(self, others: Sequence[Self], repeats: Sequence[int]) -> Self:
        """Shapes of others, which differ in length alone, each at so many configurations of a batch."""


def repeated(parts: Sequence[Array], repeats: Sequence[int]) -> Array:
    """Arrays along a new first axis, each so many times."""
    return np.repeat(np.stack(parts), repeats, axis=0)
