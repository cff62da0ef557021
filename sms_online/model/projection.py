"""Transposed Jacobians of the tree, applied from its tips to its base: P = Σ Jᵀ p and G = Σ (J̇ᵀ p + Jᵀ g), (33)-(37).

The recursion is that of the twists and of their rates, transposed: what bodies carry is handed down from frame to frame
as one load, so that no Jacobian is needed, and every frame costs the same few operations however many bodies follow.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sms_online.description.tree import BASE
from sms_online.grouping import grouped
from sms_online.model import so3
from sms_online.model.chain import Bracket, Configuration
from sms_online.model.flexible import ShapeRate
from sms_online.model.inertia import Term
from sms_online.stream import Array

# A term, the first of its columns of the result, and its momenta p and convective parts g (B, d, ·) in local speeds.
Load = tuple[Term, int, Array, Array]


def project(
    configuration: Configuration, v: Array, shape_rates: list[ShapeRate | None], loads: Iterable[Load], columns: int
) -> Array:
    """P and G (2, B, n_v, columns) of loads while the chain moves with v (B, n_v).

    The columns of a load follow those of all that comes before it in the order of `Chain.inwards`, or all share them.
    """
    recursion = _Recursion(configuration, v, shape_rates, loads, columns)
    chain = configuration.chain
    for i in reversed(chain.tree.outwards):
        recursion.begin(i)
        recursion.pass_link(i)
        if i < len(chain.joints):
            recursion.pass_joint(i)
        recursion.pass_mount(i)
        recursion.hand_down(chain.tree.parents[i])
    recursion.begin(BASE)
    recursion.pass_base()
    return recursion.out


class _Recursion:
    """The load on the current frame, in its axes: (2, B, 3, 2, n), p and g, by axis, linear and angular, n columns.

    They are columns `first` to `first + n` of the result.
    """

    def __init__(
        self,
        configuration: Configuration,
        v: Array,
        shape_rates: list[ShapeRate | None],
        loads: Iterable[Load],
        columns: int,
    ) -> None:
        self._configuration, self._v, self._shape_rates = configuration, v, shape_rates
        self._chain = configuration.chain
        self.out = np.zeros((2, configuration.size, v.shape[1], columns))
        self._nothing = (np.empty((2, configuration.size, 3, 2, 0)), 0)
        self._load, self._first = self._nothing
        self._handed: dict[int, tuple[Array, int]] = {}  # by what is mounted on a link, or on BASE
        self._by_frame = grouped((load[0].frame, load) for load in loads)

    @property
    def _columns(self) -> slice:
        """The result's columns that the load has."""
        return slice(self._first, self._first + self._load.shape[4])

    def begin(self, i: int) -> None:
        """At the end of link i (from 0), or at the BASE, with the load of all that is mounted there."""
        self._load, self._first = self._handed.pop(i, self._nothing)

    def hand_down(self, parent: int) -> None:
        """The load, in the axes of the end of its parent, joins those of others that are mounted there."""
        load, first = self._handed.get(parent, self._nothing)
        if load.shape[4] == 0:
            self._handed[parent] = self._load, self._first
        elif self._load.shape[4] and first == self._first:
            self._handed[parent] = load + self._load, first
        elif self._load.shape[4]:
            self._handed[parent] = np.concatenate((load, self._load), axis=4), first

    def _add(self, frame: int) -> None:
        """Add what sits in a frame."""
        for term, first, momentum, force in self._by_frame.get(frame, ()):
            B, _, count = momentum.shape
            parts = np.array((momentum, force))
            twist = parts[:, :, :6].reshape(2, B, 2, 3, count).swapaxes(2, 3)
            n = self._load.shape[4]
            if n == 0:
                self._first = first
            if first == self._first + n:
                self._load = np.concatenate((self._load, twist), axis=4)
            else:
                self._load[..., first - self._first : first - self._first + count] += twist
            if parts.shape[2] > 6:
                self.out[:, :, term.speeds, first : first + count] += parts[:, :, 6:]

    def _turn(self, R: Array) -> None:
        """Express the load in the axes in which a rotation R (B, 3, 3) or (3, 3) of the frame is given."""
        _, B, _, _, n = self._load.shape
        self._load = (R @ self._load.reshape(2, B, 3, 2 * n)).reshape(2, B, 3, 2, n)

    def _spin(self, turn: Array) -> None:
        """Frames that spin by ω against the one before: the momentum turns, ω × p, with ω× (B, 3, 3)."""
        _, B, _, _, n = self._load.shape
        momentum, force = self._load.reshape(2, B, 3, 2 * n)
        force += turn @ momentum

    def _shift(self, arm: Array) -> None:
        """A frame displaced by an arm, given as its cross-product matrix: the moment of what is linear."""
        self._load[..., 1, :] += arm @ self._load[..., 0, :]

    def pass_link(self, i: int) -> None:
        """From the end of link i (from 0) to its frame {i}."""
        if i == self._chain.tree.last:
            self._add(self._chain.tip_frame)
        shape, rate, rigid = self._configuration.shape(i), self._shape_rates[i], self._chain.rigid[i]
        n = self._load.shape[4]
        if n and shape is not None and rate is not None:
            turn, tip, tip_rate = so3.skew(np.stack((rate.tip_angular, shape.tip, rate.tip)))
            self._turn(shape.tip_rotation)
            self._spin(turn)
            linear, angular = self._load[..., 0, :], self._load[..., 1, :]
            own = self.out[:, :, self._chain.layout.q_f[i], self._columns]
            own += shape.tip_J.swapaxes(1, 2) @ linear
            own += shape.tip_spin.swapaxes(1, 2) @ angular
            own[1] += rate.tip_J.swapaxes(1, 2) @ linear[0]
            own[1] += rate.tip_spin.swapaxes(1, 2) @ angular[0]
            angular[1] += tip_rate @ linear[0]
            self._shift(tip)
        elif n and rigid is not None:
            self._pass_bracket(rigid)
        self._add(2 * i + 2)
        self._pass_bracket(self._chain.roots[i])

    def _pass_bracket(self, bracket: Bracket) -> None:
        """From the other end of a bracket to the frame that it is fixed to."""
        if bracket.rotation is not None:
            self._turn(bracket.rotation)
        if bracket.shift is not None:
            self._shift(bracket.shift.swapaxes(-1, -2))

    def pass_joint(self, i: int) -> None:
        """From joint i (from 0) to its mount."""
        q, axis, slide = self._chain.layout.q[i], self._chain.axes[i], self._configuration.slides[i]
        _, B, _, _, n = self._load.shape
        along = (axis @ self._load.reshape(2, B, 3, 2 * n)).reshape(2, B, 2, n)
        self.out[:, :, q, self._columns] += along[:, :, 1 if slide is None else 0]
        turn = self._v[:, q, None, None] * so3.skew(axis)
        if slide is None:
            self._spin(turn)
            self._turn(self._configuration.turns[i])
        else:
            self._shift(so3.skew(slide))
            self._load[1, ..., 1, :] += turn @ self._load[0, ..., 0, :]

    def pass_mount(self, i: int) -> None:
        """From mount i (from 0) to the end of its parent."""
        self._add(2 * i + 1)
        self._pass_bracket(self._chain.mounts[i])

    def pass_base(self) -> None:
        """From joint 1 to the base's point S, in inertial axes."""
        chain, layout = self._chain, self._chain.layout
        self._add(0)
        columns = self._columns
        self._shift(chain.base_arm.T)
        omega = self._v @ chain.select_base[3:].T
        self._spin(so3.skew((omega[:, None] @ self._configuration.T_0)[:, 0]))
        self._turn(self._configuration.T_0)
        linear = len(layout.base_linear)
        self.out[:, :, :linear, columns] += self._load[:, :, list(layout.base_linear), 0]
        self.out[:, :, linear : layout.n_base_speeds, columns] += self._load[:, :, list(layout.base_angular), 1]
