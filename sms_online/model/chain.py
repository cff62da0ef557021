"""Kinematics of the tree of links, (8)–(12), (16)–(22): frames, their twists, and the rates of these.

One recursion carries m columns of generalized speeds at once: the actual speeds (m = 1) give velocities, the identity
(m = n_v) gives Jacobians. Every twist is stacked as linear over angular velocity in the axes of its own frame.

Frames: 0 is {0} with origin in joint 1; 2 i - 1 is mount i, which holds stator i; 2 i is {i} of link i; the last one is
the end of the link of the last joint that moves, where a payload is. What a joint is mounted on comes before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from sms_online.description.bodies import FlexibleLink, Joint, RigidLink
from sms_online.description.schema import System
from sms_online.description.tree import BASE, Tree, mounts, tree_of
from sms_online.model import so3
from sms_online.model.beam import LinearLink
from sms_online.model.flexible import LinkKinematics, Shape, ShapeRate
from sms_online.model.layout import Layout
from sms_online.model.rod import ExactRod
from sms_online.stream import Array, Mask


@dataclass(frozen=True)
class Frame:
    """Pose of a frame: origin (B, 3) m, rotation to inertial axes (B, 3, 3)."""

    origin: Array
    rotation: Array


@lru_cache(maxsize=64)
def link_kinematics(link: FlexibleLink, free_end: bool) -> LinkKinematics:
    """The constant geometry of a flexible link, once for all the models that a search for effects makes of a system."""
    return LinearLink(link) if link.kinematics == "linear" else ExactRod(link, free_end=free_end)


@dataclass(frozen=True)
class Bracket:
    """A rigid displacement and turn, in the axes before the turn; None where there is none.

    offset (3,) m; shift (3, 3): minus its cross-product matrix, which adds v + ω × arm. All may have one more axis in
    front, another bracket at every position of a batch.
    """

    offset: Array | None
    shift: Array | None
    rotation: Array | None

    @classmethod
    def of(cls, position: Sequence[float], rotation: Sequence[float]) -> Bracket:
        """Bracket of a position, m, and a rotation vector, rad."""
        offset = np.array(position) if any(position) else None
        turn = so3.RotationVector(np.array(rotation)).matrix if any(rotation) else None
        return cls(offset, None if offset is None else -so3.skew(offset), turn)

    def pose(self, frame: Frame) -> Frame:
        """The frame at its other end."""
        origin = frame.origin if self.offset is None else frame.origin + _turned(frame.rotation, self.offset)
        return Frame(origin, frame.rotation if self.rotation is None else frame.rotation @ self.rotation)

    def carry(self, twist: Array) -> Array:
        """Twists (B, 6, m), or their rates, of the frame at its other end."""
        if self.shift is not None:
            twist = _shift(twist, self.shift)
        return twist if self.rotation is None else _turn_back(self.rotation, twist)

    def carry_back(self, twist: Array) -> Array:
        """Inverse of `carry`."""
        if self.rotation is not None:
            twist = _turn_back(self.rotation.swapaxes(-1, -2), twist)
        return twist if self.shift is None else _shift(twist, -self.shift)

    @classmethod
    def stacked(cls, brackets: Sequence[Bracket], repeats: Sequence[int]) -> Bracket:
        """Each of some brackets at so many positions of a batch, one after the other."""
        first = brackets[0]
        if all(_same(each.offset, first.offset) and _same(each.rotation, first.rotation) for each in brackets[1:]):
            return first
        offset = np.array([np.zeros(3) if each.offset is None else each.offset for each in brackets])
        rotation = np.array([np.eye(3) if each.rotation is None else each.rotation for each in brackets])
        offset, rotation = np.repeat(offset, repeats, axis=0), np.repeat(rotation, repeats, axis=0)
        return cls(offset, -so3.skew(offset), rotation)


NO_BRACKET = Bracket(None, None, None)


class Chain:
    """The constant geometry of a system; `configure` gives it a configuration."""

    def __init__(self, system: System, layout: Layout) -> None:
        self.layout = layout
        self.joints: tuple[Joint, ...] = system.joints
        self.tree: Tree = tree_of(system)
        self.axes = [np.array(joint.axis) for joint in system.joints]
        every = mounts(system)
        # From the end of the parent to each mount, and from each joint to its link's root.
        self.mounts = [Bracket.of(mount.mount_position, mount.mount_rotation) for mount in every]
        self.roots = [
            Bracket.of(link.root_position, link.root_rotation) if isinstance(link, FlexibleLink) else NO_BRACKET
            for link in system.links
        ]
        # A rigid link is a bracket from its frame to its end.
        self.rigid = [
            Bracket.of(link.tip, (0.0, 0.0, 0.0)) if isinstance(link, RigidLink) else None for link in system.links
        ]
        self.links = system.links
        self.flexible: list[LinkKinematics | None] = []
        for i, link in enumerate(system.links):
            free_end = i in self.tree.ending and (i != self.tree.last or system.payload is None)
            self.flexible.append(None if isinstance(link, RigidLink) else link_kinematics(link, free_end))
        tracked = system.spacecraft.tracked_point if system.spacecraft is not None else (0.0, 0.0, 0.0)
        self.joint_1_from_S = -np.array(tracked)
        # Twist of the base in inertial axes out of v, (6, n_v).
        self.select_base = np.zeros((6, layout.n_v))
        rows = [*layout.base_linear, *(3 + axis for axis in layout.base_angular)]
        self.select_base[rows, range(len(rows))] = 1.0
        # As the matrix that adds its moment to a linear velocity, v + ω × arm.
        self.base_arm = -so3.skew(self.joint_1_from_S)
        # A_i(q) is a combination of these by (1, sin q, 1 - cos q).
        self.turn_basis = [so3.turn_basis(axis) for axis in self.axes]

    def stacked(self, others: Sequence[Chain], repeats: Sequence[int]) -> Chain:
        """This chain with the brackets and links of others, each at so many positions of a batch, one after the other.

        The others differ in these alone, and flexible links in their lengths.
        """
        out = copy(self)
        out.flexible = [
            None if each[0] is None else each[0] if len(set(map(id, each))) == 1 else each[0].stacked(each, repeats)
            for each in zip(*(other.flexible for other in others), strict=True)
        ]
        for name in ("mounts", "roots", "rigid"):
            every = zip(*(getattr(other, name) for other in others), strict=True)
            setattr(out, name, [None if each[0] is None else Bracket.stacked(each, repeats) for each in every])
        return out

    @property
    def tip_frame(self) -> int:
        """Frame at the end of the link of the last joint that moves."""
        return 2 * len(self.links) + 1

    def link_of(self, frame: int) -> int:
        """Link (from 0) that a frame belongs to; BASE of {0}."""
        return self.tree.last if frame == self.tip_frame else (frame - 1) // 2

    def inwards(self, frame: int) -> tuple[int, int]:
        """Sorts frames from the tips to the base: every run of links that follow one another stays together."""
        link = self.link_of(frame)
        place = len(self.links) if link == BASE else -self.tree.outwards.index(link)
        return place, -frame

    def moving(self, frames: Iterable[int]) -> Mask:
        """Which speeds (n_v,) move what sits in some frames, but for speeds of its own."""
        layout = self.layout
        mask = np.zeros(layout.n_v, dtype=bool)
        mask[: layout.n_base_speeds] = True
        for frame in frames:
            link = self.link_of(frame)
            if link == BASE:
                continue
            before = self.tree.inwards(link)
            turned = before if frame == 2 * link + 1 else (link, *before)
            mask[[layout.q[i] for i in turned if i < len(layout.q)]] = True
            for i in before if frame != self.tip_frame else (link, *before):
                mask[layout.q_f[i]] = True
        return mask

    def configure(self, x: Array) -> Configuration:
        """Configuration at positions x (B, n_x)."""
        return Configuration(self, x)

    def elastic(self, x: Array, i: int) -> Array:
        """Elastic coordinates (B, n_f) of link i (from 0)."""
        return x[:, self.layout.elastic(i)]


class Configuration:
    """The chain at B positions: frames, and the maps from generalized speeds to twists."""

    def __init__(self, chain: Chain, x: Array) -> None:
        self.chain = chain
        self.x = x
        layout = chain.layout
        self.size = x.shape[0]
        self.r_S, self.T_0 = layout.base_pose(x)
        self._shapes: dict[int, Shape] = {}
        self.turns: list[Array] = []  # A_i(q_i), (B, 3, 3)
        self.slides: list[Array | None] = []  # displacement of a prismatic joint in its mount frame, (B, 3)
        for i, joint in enumerate(chain.joints):
            q = x[:, layout.q[i] + layout.offset]
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
        base = Frame(self.r_S + self.T_0 @ chain.joint_1_from_S, self.T_0)
        frames = [base] * (chain.tip_frame + 1)
        for i in chain.tree.outwards:
            parent = chain.tree.parents[i]
            mount = chain.mounts[i].pose(base if parent == BASE else self.end(parent, frames[2 * parent + 2]))
            link = mount
            if i < len(chain.joints):
                slide = self.slides[i]
                origin = mount.origin if slide is None else mount.origin + (mount.rotation @ slide[..., None])[..., 0]
                link = Frame(origin, mount.rotation @ self.turns[i])
            frames[2 * i + 1 : 2 * i + 3] = [mount, chain.roots[i].pose(link)]
        last = chain.tree.last
        frames[-1] = self.end(last, frames[2 * last + 2])
        return frames

    def end(self, i: int, link: Frame) -> Frame:
        """The end of link i (from 0), with its frame {i} given."""
        shape, rigid = self.shape(i), self.chain.rigid[i]
        if shape is None:
            assert rigid is not None
            return rigid.pose(link)
        return Frame(link.origin + _turned(link.rotation, shape.tip), link.rotation @ shape.tip_rotation)

    @cached_property
    def jacobians(self) -> list[Array]:
        """Twist Jacobians (B, 6, n_v) of all frames."""
        return self.twists(np.eye(self.chain.layout.n_v)[None])

    def twists(self, rates: Array, frames: int | None = None) -> list[Array]:
        """Twists (B, 6, m) of all frames, or of the first few, for columns of speeds `rates` (B or 1, n_v, m)."""
        chain = self.chain
        base = _turn_back(self.T_0, chain.select_base @ rates)
        base[:, :3] += chain.base_arm @ base[:, 3:]
        count = chain.tip_frame + 1 if frames is None else frames
        out = [base] * max(count, chain.tip_frame)
        for i in chain.tree.outwards:
            parent = chain.tree.parents[i]
            mount = chain.mounts[i].carry(base if parent == BASE else self._end(parent, out[2 * parent + 2], rates))
            link = self._joint(i, mount, rates) if i < len(chain.joints) else mount
            out[2 * i + 1 : 2 * i + 3] = [mount, chain.roots[i].carry(link)]
        if count > chain.tip_frame:
            last = chain.tree.last
            out[chain.tip_frame] = self._end(last, out[2 * last + 2], rates)
        return out

    def end_jacobians(self, places: Iterable[int]) -> list[Array]:
        """Twist Jacobians (B, 6, n_v), in their axes, of the ends of some links (from 0), or of S where it is BASE."""
        chain, unit = self.chain, np.eye(self.chain.layout.n_v)[None]
        return [
            _turn_back(self.T_0, chain.select_base @ unit)
            if i == BASE
            else self._end(i, self.jacobians[2 * i + 2], unit)
            for i in places
        ]

    def _joint(self, i: int, mount: Array, rates: Array) -> Array:
        """Twists beyond joint i (from 0) for those of its mount."""
        slide, q = self.slides[i], self.chain.layout.q[i]
        link = _turn_back(self.turns[i], mount if slide is None else _shift(mount, -so3.skew(slide)))
        rows = slice(3, 6) if slide is None else slice(0, 3)
        link[:, rows] += self.chain.axes[i][:, None] * rates[:, q, None, :]
        return link

    def _end(self, i: int, link: Array, rates: Array) -> Array:
        """Twists of the end of link i (from 0) for those of its frame {i}."""
        twist, shape = self._unturned_end(i, link, rates), self.shape(i)
        return twist if shape is None else _turn_back(shape.tip_rotation, twist)

    def _unturned_end(self, i: int, link: Array, rates: Array) -> Array:
        """Twists at the end of link i (from 0), still in the axes of {i}."""
        shape, rigid = self.shape(i), self.chain.rigid[i]
        if shape is None:
            assert rigid is not None
            return rigid.carry(link)
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
        base = -_spin(omega_body, at_S)
        base[:, :3] += chain.base_arm @ base[:, 3:]
        out = [base] * (chain.tip_frame + 1)

        def end(i: int) -> Array:
            return self._end_rate(i, out[2 * i + 2], twists[2 * i + 2], rates, shape_rates[i])

        for i in chain.tree.outwards:
            parent = chain.tree.parents[i]
            mount = chain.mounts[i].carry(base if parent == BASE else end(parent))
            link = mount
            if i < len(chain.joints):
                link = self._joint_rate(i, mount, twists[2 * i + 1], twists[2 * i + 2], rates, v[:, layout.q[i]])
            out[2 * i + 1 : 2 * i + 3] = [mount, chain.roots[i].carry(link)]
        out[-1] = end(chain.tree.last)
        return out

    def _joint_rate(
        self, i: int, mount: Array, mount_twist: Array, link_twist: Array, rates: Array, q_dot: Array
    ) -> Array:
        """Rates of the twists beyond joint i (from 0) for those of its mount."""
        chain, slide = self.chain, self.slides[i]
        spin = q_dot[:, None] * chain.axes[i]
        if slide is None:
            moved = chain.roots[i].carry_back(link_twist).copy()
            moved[:, 3:] -= chain.axes[i][:, None] * rates[:, chain.layout.q[i], None, :]
            return _turn_back(self.turns[i], mount) - _spin(spin, moved)
        link = _shift(mount, -so3.skew(slide))
        link[:, :3] -= so3.skew(spin) @ mount_twist[:, 3:]
        return link

    def _end_rate(self, i: int, link: Array, link_twist: Array, rates: Array, shape_rate: ShapeRate | None) -> Array:
        """Rates of the twists at the end of link i (from 0), in the end's axes."""
        shape, rigid = self.shape(i), self.chain.rigid[i]
        if shape is None or shape_rate is None:
            assert rigid is not None
            return rigid.carry(link)
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


def _turned(R: Array, vector: Array) -> Array:
    """Vectors (3,) or (B, 3) turned by R (B, 3, 3)."""
    return np.asarray((R @ vector[..., None])[..., 0])


def _same(one: Array | None, other: Array | None) -> bool:
    return one is other or (one is not None and other is not None and np.array_equal(one, other))


def _shift(twist: Array, arm: Array) -> Array:
    """Twists (B, 6, m) of a point displaced in the same axes; arm is minus the displacement's cross-product matrix."""
    out = twist.copy()
    out[:, :3] += arm @ twist[:, 3:]
    return out


def _spin(omega: Array, twist: Array) -> Array:
    """ω × of the linear and of the angular part of twists (B, 6, m)."""
    stacked = twist.reshape(twist.shape[0], 2, 3, twist.shape[2])
    return (so3.skew(omega)[:, None] @ stacked).reshape(twist.shape)
