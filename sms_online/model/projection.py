"""Transposed Jacobians of the chain, applied from its tip to its base: P = Σ Jᵀ p and G = Σ (J̇ᵀ p + Jᵀ g), (33)-(37).

The recursion is that of the twists and of their rates, transposed: what bodies carry is handed down from frame to frame
as one load, so that no Jacobian is needed, and every frame costs the same few operations however many bodies follow.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sms_online.model import so3
from sms_online.model.chain import Configuration
from sms_online.model.flexible import ShapeRate
from sms_online.model.inertia import Term
from sms_online.stream import Array

# A term, the first of its columns of the result, and its momenta p and convective parts g (B, d, ·) in local speeds.
Load = tuple[Term, int, Array, Array]


def project(
    configuration: Configuration, v: Array, shape_rates: list[ShapeRate | None], loads: Iterable[Load], columns: int
) -> Array:
    """P and G (2, B, n_v, columns) of loads while the chain moves with v (B, n_v).

    The columns of a load stand behind those of all that sits nearer to the tip, or are shared with them.
    """
    recursion = _Recursion(configuration, v, shape_rates, loads, columns)
    for i in reversed(range(len(configuration.chain.joints))):
        recursion.pass_link(i)
        recursion.pass_joint(i)
    recursion.pass_base()
    return recursion.out


class _Recursion:
    """The load on the current frame, in its axes: (2, B, 3, 2, n), p and g, by axis, linear and angular, n columns."""

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
        self._load = np.empty((2, configuration.size, 3, 2, 0))
        self._by_frame: dict[int, list[Load]] = {}
        for load in loads:
            self._by_frame.setdefault(load[0].frame, []).append(load)

    def _add(self, frame: int) -> None:
        """Take up what sits in a frame."""
        for term, first, momentum, force in self._by_frame.get(frame, ()):
            B, _, count = momentum.shape
            parts = np.array((momentum, force))
            twist = parts[:, :, :6].reshape(2, B, 2, 3, count).swapaxes(2, 3)
            if first == self._load.shape[4]:
                self._load = np.concatenate((self._load, twist), axis=4)
            else:
                self._load[..., first : first + count] += twist
            if parts.shape[2] > 6:
                self.out[:, :, term.speeds, first : first + count] += parts[:, :, 6:]

    def _turn(self, R: Array) -> None:
        """Express the load in the axes that a rotation R (B, 3, 3) or (3, 3) of the frame is told in."""
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
        if i == len(self._chain.joints) - 1:
            self._add(2 * i + 3)
        shape, rate, arm = self._configuration.shape(i), self._shape_rates[i], self._chain.rigid_arms[i]
        n = self._load.shape[4]
        if n and shape is not None and rate is not None:
            turn, tip, tip_rate = so3.skew(np.stack((rate.tip_angular, shape.tip, rate.tip)))
            self._turn(shape.tip_rotation)
            self._spin(turn)
            linear, angular = self._load[..., 0, :], self._load[..., 1, :]
            own = self.out[:, :, self._chain.layout.q_f[i], :n]
            own += shape.tip_J.swapaxes(1, 2) @ linear
            own += shape.tip_spin.swapaxes(1, 2) @ angular
            own[1] += rate.tip_J.swapaxes(1, 2) @ linear[0]
            own[1] += rate.tip_spin.swapaxes(1, 2) @ angular[0]
            angular[1] += tip_rate @ linear[0]
            self._shift(tip)
        elif n and arm is not None:
            self._shift(arm.T)
        self._add(2 * i + 2)

    def pass_joint(self, i: int) -> None:
        """From frame {i} of link i (from 0) over its joint and mount to the end of the link before."""
        q, axis = self._chain.layout.q[i], self._chain.axes[i]
        slide, mount = self._configuration.slides[i], self._chain.mounts[i]
        _, B, _, _, n = self._load.shape
        along = (axis @ self._load.reshape(2, B, 3, 2 * n)).reshape(2, B, 2, n)
        self.out[:, :, q, :n] += along[:, :, 1 if slide is None else 0]
        turn = self._v[:, q, None, None] * so3.skew(axis)
        if slide is None:
            self._spin(turn)
            self._turn(self._configuration.turns[i])
        else:
            self._shift(so3.skew(slide))
            self._load[1, ..., 1, :] += turn @ self._load[0, ..., 0, :]
        self._add(2 * i + 1)
        if mount is not None:
            self._turn(mount)

    def pass_base(self) -> None:
        """From joint 1 to the base's point S, in inertial axes."""
        chain, layout = self._chain, self._chain.layout
        self._add(0)
        self._shift(chain.base_arm.T)
        omega = self._v @ chain.select_base[3:].T
        self._spin(so3.skew((omega[:, None] @ self._configuration.T_0)[:, 0]))
        self._turn(self._configuration.T_0)
        linear = len(layout.base_linear)
        self.out[:, :, :linear] += self._load[:, :, list(layout.base_linear), 0]
        self.out[:, :, linear : layout.n_base_speeds] += self._load[:, :, list(layout.base_angular), 1]
