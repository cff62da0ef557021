"""Kinematics of the serial chain, (8)–(12), (16)–(22): frames, their twists, and the rates of these.

One recursion carries m columns of generalized speeds at once: the actual speeds (m = 1) give velocities, the identity
(m = n_v) gives Jacobians. Every twist is stacked as linear over angular velocity in the axes of its own frame.

Frames, from the base outwards: 0 is {0} with origin in joint 1; mount i is the frame that holds stator i; link i is
{i}; the last one is the end of the last link.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from sms_online.description.schema import FlexibleLink, Joint, RigidLink, System
from sms_online.model import so3
from sms_online.model.beam import LinearLink
from sms_online.model.flexible import LinkKinematics, Shape, ShapeRate
from sms_online.model.layout import Layout
from sms_online.model.rod import ExactRod
from sms_online.stream import Array


@dataclass(frozen=True)
class Frame:
    """Pose of a frame: origin (B, 3) m, rotation to inertial axes (B, 3, 3)."""

    origin: Array
    rotation: Array


@lru_cache(maxsize=64)
def link_kinematics(link: FlexibleLink, free_end: bool) -> LinkKinematics:
    """The constant geometry of a flexible link, once for all the models that a search for effects makes of a system."""
    return LinearLink(link) if link.kinematics == "linear" else ExactRod(link, free_end=free_end)


class Chain:
    """The constant geometry of a system; `configure` gives it a configuration."""

    def __init__(self, system: System, layout: Layout) -> None:
        self.layout = layout
        self.joints: tuple[Joint, ...] = system.joints
        self.axes = [np.array(joint.axis) for joint in system.joints]
        # None where a mount is not turned at all.
        self.mounts = [
            so3.RotationVector(np.array(joint.mount_rotation)).matrix if any(joint.mount_rotation) else None
            for joint in system.joints
        ]
        self.links = system.links
        self.flexible: list[LinkKinematics | None] = []
        for i, link in enumerate(system.links):
            last = i == len(system.links) - 1
            free_end = last and system.payload is None
            self.flexible.append(None if isinstance(link, RigidLink) else link_kinematics(link, free_end))
        tracked = system.spacecraft.tracked_point if system.spacecraft is not None else (0.0, 0.0, 0.0)
        self.joint_1_from_S = -np.array(tracked)
        # Twist of the base in inertial axes out of v, (6, n_v).
        self.select_base = np.zeros((6, layout.n_v))
        rows = [*layout.base_linear, *(3 + axis for axis in layout.base_angular)]
        self.select_base[rows, range(len(rows))] = 1.0
        # Arms that never change, as the matrices that add their moment to a linear velocity, v + ω × arm.
        self.base_arm = -so3.skew(self.joint_1_from_S)
        self.rigid_arms = [
            -so3.skew(np.array(link.tip)) if isinstance(link, RigidLink) else None for link in system.links
        ]
        # A_i(q) is a combination of these by (1, sin q, 1 - cos q).
        self.turn_basis = [so3.turn_basis(axis) for axis in self.axes]

    def moves(self, frame: int, own: slice) -> NDArray[np.bool_]:
        """Which speeds (n_v,) move a body in a frame that has speeds of its own besides."""
        mask = np.zeros(self.layout.n_v, dtype=bool)
        mask[: self.layout.n_base_speeds] = True
        mask[own] = True
        for i in range(len(self.joints)):
            mask[self.layout.q[i]] |= frame >= 2 * i + 2
            if frame > 2 * i + 2:
                mask[self.layout.q_f[i]] = True
        return mask

    def configure(self, x: Array) -> Configuration:
        """Configuration at positions x (B, n_x)."""
        return Configuration(self, x)

    def elastic(self, x: Array, i: int) -> Array:
        """Elastic coordinates (B, n_f) of link i (from 0)."""
        offset = self.layout.n_base_positions - self.layout.n_base_speeds
        s = self.layout.q_f[i]
        return x[:, s.start + offset : s.stop + offset]


class Configuration:
    """The chain at B positions: frames, and the maps from generalized speeds to twists."""

    def __init__(self, chain: Chain, x: Array) -> None:
        self.chain = chain
        self.x = x
        layout = chain.layout
        self.size = x.shape[0]
        self.r_S, self.T_0 = layout.base_pose(x)
        offset = layout.n_base_positions - layout.n_base_speeds
        self._shapes: dict[int, Shape] = {}
        self.turns: list[Array] = []  # A_i(q_i), (B, 3, 3)
        self.slides: list[Array | None] = []  # displacement of a prismatic joint in its mount frame, (B, 3)
        for i, joint in enumerate(chain.joints):
            q = x[:, layout.q[i] + offset]
            if joint.kind == "revolute":
                self.turns.append(so3.about(chain.turn_basis[i], q))
                self.slides.append(None)
            else:
                self.turns.append(np.broadcast_to(np.eye(3), (self.size, 3, 3)))
                self.slides.append(q[:, None] * chain.axes[i])

    def shape(self, i: int) -> Shape | None:
        """Shape of link i (from 0), made when it is first asked for; None of a rigid link."""
        kinematics = self.chain.flexible[i]
        if kinematics is not None and i not in self._shapes:
            self._shapes[i] = kinematics.shape(self.chain.elastic(self.x, i))
        return self._shapes.get(i)

    @cached_property
    def frames(self) -> list[Frame]:
        """Poses of all frames; velocities do not need them, gravity and pictures do."""
        chain = self.chain
        end = Frame(self.r_S + self.T_0 @ chain.joint_1_from_S, self.T_0)
        frames = [end]
        for i, (turn, slide) in enumerate(zip(self.turns, self.slides, strict=True)):
            C, description, shape = chain.mounts[i], chain.links[i], self.shape(i)
            mount = end if C is None else Frame(end.origin, end.rotation @ C)
            origin = mount.origin if slide is None else mount.origin + (mount.rotation @ slide[..., None])[..., 0]
            link = Frame(origin, mount.rotation @ turn)
            if shape is not None:
                tip, rotation = shape.tip, link.rotation @ shape.tip_rotation
            else:
                assert isinstance(description, RigidLink)
                tip, rotation = np.array(description.tip), link.rotation
            end = Frame(link.origin + (link.rotation @ tip[..., None])[..., 0], rotation)
            frames += [mount, link]
        return [*frames, end]

    @cached_property
    def jacobians(self) -> list[Array]:
        """Twist Jacobians (B, 6, n_v) of all frames."""
        return self.twists(np.eye(self.chain.layout.n_v)[None])

    def twists(self, rates: Array, frames: int | None = None) -> list[Array]:
        """Twists (B, 6, m) of all frames, or of the first few, for columns of speeds `rates` (B or 1, n_v, m)."""
        chain, layout = self.chain, self.chain.layout
        twist = _turn_back(self.T_0, chain.select_base @ rates)
        twist[:, :3] += chain.base_arm @ twist[:, 3:]
        out = [twist]
        for i in range(len(chain.joints)):
            C = chain.mounts[i]
            mount = twist if C is None else _turn_back(C, twist)
            slide = self.slides[i]
            moved = mount if slide is None else _shift(mount, -so3.skew(slide))
            link = _turn_back(self.turns[i], moved)
            rows = slice(3, 6) if slide is None else slice(0, 3)
            link[:, rows] += chain.axes[i][:, None] * rates[:, layout.q[i], None, :]
            out += [mount, link]
            if frames is not None and len(out) >= frames:
                return out
            twist = self._unturned_end(i, link, rates)
            shape = self.shape(i)
            if shape is not None:
                twist = _turn_back(shape.tip_rotation, twist)
        return [*out, twist]

    def _unturned_end(self, i: int, link: Array, rates: Array) -> Array:
        """Twists at the end of link i (from 0), still in the axes of {i}."""
        shape, arm = self.shape(i), self.chain.rigid_arms[i]
        if shape is None or arm is not None:
            return _shift(link, arm)
        end = _shift(link, -so3.skew(shape.tip))
        elastic = rates[:, self.chain.layout.q_f[i]]
        end[:, :3] += shape.tip_J @ elastic
        end[:, 3:] += shape.tip_spin @ elastic
        return end

    def shape_rates(self, v: Array) -> list[ShapeRate | None]:
        """Rates of every flexible link's shape for speeds v (B, n_v)."""
        out: list[ShapeRate | None] = []
        for i, kinematics in enumerate(self.chain.flexible):
            shape = self.shape(i)
            if kinematics is None or shape is None:
                out.append(None)
            else:
                q_f_dot = v[:, self.chain.layout.q_f[i]]
                out.append(kinematics.shape_rate(self.chain.elastic(self.x, i), q_f_dot, shape))
        return out

    def twist_rates(
        self, rates: Array, twists: list[Array], v: Array, shape_rates: list[ShapeRate | None]
    ) -> list[Array]:
        """Time derivatives, in the frames' axes, of `twists` of constant `rates` while the chain moves with v (B, n_v).

        With rates = v this is the acceleration at v̇ = 0; with the identity it is the Jacobians' rate.
        """
        chain, layout = self.chain, self.chain.layout
        omega = v @ chain.select_base[3:].T
        omega_body = (omega[:, None] @ self.T_0)[:, 0]
        # Undo the shift to joint 1 to reach the twist at S, whose inertial components are constant.
        at_S = twists[0].copy()
        at_S[:, :3] -= chain.base_arm @ at_S[:, 3:]
        rate = -_spin(omega_body, at_S)
        rate[:, :3] += chain.base_arm @ rate[:, 3:]
        out = [rate]
        for i in range(len(chain.joints)):
            mount_twist, link_twist = twists[2 * i + 1], twists[2 * i + 2]
            C = chain.mounts[i]
            mount = rate if C is None else _turn_back(C, rate)
            slide = self.slides[i]
            q_dot = v[:, layout.q[i]]
            spin = q_dot[:, None] * chain.axes[i]
            if slide is None:
                moved = link_twist.copy()
                moved[:, 3:] -= chain.axes[i][:, None] * rates[:, layout.q[i], None, :]
                link = _turn_back(self.turns[i], mount) - _spin(spin, moved)
            else:
                link = _shift(mount, -so3.skew(slide))
                link[:, :3] -= so3.skew(spin) @ mount_twist[:, 3:]
            out += [mount, link]
            rate = self._end_rate(i, link, link_twist, rates, shape_rates[i])
        return [*out, rate]

    def _end_rate(self, i: int, link: Array, link_twist: Array, rates: Array, shape_rate: ShapeRate | None) -> Array:
        """Rates of the twists at the end of link i (from 0), in the end's axes."""
        shape, arm = self.shape(i), self.chain.rigid_arms[i]
        if shape is None or shape_rate is None or arm is not None:
            return _shift(link, arm)
        elastic = rates[:, self.chain.layout.q_f[i]]
        end = _shift(link, -so3.skew(shape.tip))
        end[:, :3] += shape_rate.tip_J @ elastic - so3.skew(shape_rate.tip) @ link_twist[:, 3:]
        end[:, 3:] += shape_rate.tip_spin @ elastic
        end -= _spin(shape_rate.tip_angular, self._unturned_end(i, link_twist, rates))
        return _turn_back(shape.tip_rotation, end)


def _turn_back(R: Array, twist: Array) -> Array:
    """Twists (B, 6, m) expressed in the axes of a frame turned by R (B, 3, 3) or (3, 3)."""
    R_T = R.swapaxes(-1, -2)
    m = twist.shape[2]
    stacked = twist.reshape(-1, 2, 3, m)
    turned = (R_T[:, None] if R.ndim == 3 else R_T) @ stacked
    return turned.reshape(-1, 6, m)


def _shift(twist: Array, arm: Array | None) -> Array:
    """Twists (B, 6, m) of a point displaced in the same axes; arm is minus the displacement's cross-product matrix."""
    assert arm is not None
    out = twist.copy()
    out[:, :3] += arm @ twist[:, 3:]
    return out


def _spin(omega: Array, twist: Array) -> Array:
    """ω × of the linear and of the angular part of twists (B, 6, m)."""
    stacked = twist.reshape(twist.shape[0], 2, 3, twist.shape[2])
    return (so3.skew(omega)[:, None] @ stacked).reshape(twist.shape)
