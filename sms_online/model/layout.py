"""Active generalized coordinates and speeds of a system, (29)–(32): names, indices, kinematic map.

Positions x: S and attitude of a free base (planar: x, y, angle), q, θ_m of flexible joints, elastic coordinates.
Speeds v: inertial velocity of S and inertial ω_0 (planar: x, y, z), then the rates of the other positions in the same
order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.description.bodies import FlexibleLink
from sms_online.description.channels import AXES, NODAL, has_motor_side
from sms_online.description.schema import System
from sms_online.model import so3
from sms_online.stream import Array

# Strain fields of a geometrically exact link, by deformation.
STRAIN = {"twist": "torsion", "curvature_y": "bending_y", "curvature_z": "bending_z"}


def nodal_names(link: FlexibleLink) -> tuple[str, ...]:
    """Active coordinates of one node of a link, in the order of (31)."""
    return tuple(name for name, deformation in NODAL.items() if deformation in link.deformations)


def strain_names(link: FlexibleLink) -> tuple[str, ...]:
    """Elastic coordinates of an exact link: as many coefficients a strain field as its markers determine."""
    per_marker = {"twist": 1, "curvature_y": 2, "curvature_z": 2}
    return tuple(
        f"{field}_{k}"
        for field, deformation in STRAIN.items()
        if deformation in link.deformations
        for k in range(per_marker[field] * link.elements)
    )


@dataclass(frozen=True)
class Layout:
    """Where each coordinate sits; theta_m[i] is q[i] on a rigid or passive joint. Fixed joints have none."""

    planar: bool
    free: bool
    position_names: tuple[str, ...]
    speed_names: tuple[str, ...]
    base_linear: tuple[int, ...]  # inertial axes that are active; their speeds come first
    base_angular: tuple[int, ...]  # and then these
    n_base_positions: int
    q: tuple[int, ...]  # speed index of each joint's link side
    theta_m: tuple[int, ...]  # speed index of each joint's motor side
    q_f: tuple[slice, ...]  # speed indices of each link's elastic coordinates

    @property
    def n_x(self) -> int:
        """Number of positions."""
        return len(self.position_names)

    @property
    def n_v(self) -> int:
        """Number of generalized speeds."""
        return len(self.speed_names)

    @property
    def n_base_speeds(self) -> int:
        """Number of the base's generalized speeds."""
        return len(self.base_linear) + len(self.base_angular)

    @property
    def offset(self) -> int:
        """Number of a position beyond the base's, less that of its speed: of an attitude's four numbers three turn."""
        return self.n_base_positions - self.n_base_speeds

    def elastic(self, i: int) -> slice:
        """Where positions hold the elastic coordinates of link i (from 0)."""
        return slice(self.q_f[i].start + self.offset, self.q_f[i].stop + self.offset)

    def joint_positions(self, x: Array) -> Array:
        """Positions (B, ·) whose rates are speeds: all but the base's; speed i is column i - n_base_speeds."""
        return x[:, self.n_base_positions :]

    def base_pose(self, x: Array) -> tuple[Array, Array]:
        """Position of S (B, 3), m, and T_0 (B, 3, 3) at positions x (B, n_x); a fixed base stays at the origin."""
        B = x.shape[0]
        r_S = np.zeros((B, 3))
        if not self.free:
            return r_S, np.broadcast_to(np.eye(3), (B, 3, 3))
        r_S[:, list(self.base_linear)] = x[:, : len(self.base_linear)]
        if self.planar:
            c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
            T = np.zeros((B, 3, 3))
            T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1], T[:, 2, 2] = c, -s, s, c, 1.0
            return r_S, T
        return r_S, so3.from_euler_parameters(x[:, 3:6], x[:, 6])

    def position_rate(self, x: Array, v: Array) -> Array:
        """ẋ (B, n_x) for speeds v (B, n_v): the identity but for Euler parameters."""
        if self.planar or not self.free:
            return v
        return np.concatenate((v[:, :3], so3.euler_parameter_rate(x[:, 3:6], x[:, 6], v[:, 3:6]), v[:, 6:]), axis=1)

    def speeds(self, x: Array, x_dot: Array) -> Array:
        """Speeds v (B, n_v) for position rates ẋ (B, n_x): inverse of `position_rate`."""
        if self.planar or not self.free:
            return x_dot
        omega = so3.angular_velocity(x[:, 3:6], x[:, 6], x_dot[:, 3:7])
        return np.concatenate((x_dot[:, :3], omega, x_dot[:, 7:]), axis=1)

    def displaced(self, x: Array, change: Array) -> Array:
        """Positions (B, n_x) that small displacements (B, n_v), in the order of the speeds, lead to from x (B, n_x)."""
        moved = x + self.position_rate(x, change)
        if self.free and not self.planar:
            moved[:, 3:7] /= np.linalg.norm(moved[:, 3:7], axis=1)[:, None]
        return moved


def build_layout(system: System) -> Layout:
    """Layout of a described system."""
    planar, free = system.motion == "planar", system.spacecraft is not None
    linear: tuple[int, ...] = ()
    angular: tuple[int, ...] = ()
    base_positions: tuple[str, ...] = ()
    if free:
        linear, angular = ((0, 1), (2,)) if planar else ((0, 1, 2), (0, 1, 2))
        attitude = ("theta_0",) if planar else ("eps_x", "eps_y", "eps_z", "eta")
        base_positions = tuple(f"r_S_{AXES[a]}" for a in linear) + attitude
    base_speeds = tuple(f"v_S_{AXES[a]}" for a in linear) + tuple(f"omega_0_{AXES[a]}" for a in angular)
    names = [f"q_{i}" for i in range(1, len(system.joints) + 1)]
    q = tuple(len(base_speeds) + i for i in range(len(system.joints)))
    theta_m = list(q)
    for i, joint in enumerate(system.joints):
        if has_motor_side(joint):
            theta_m[i] = len(base_speeds) + len(names)
            names.append(f"theta_m_{i + 1}")
    q_f = []
    for i, link in enumerate(system.links, start=1):
        start = len(base_speeds) + len(names)
        if isinstance(link, FlexibleLink):
            if link.kinematics == "exact":
                names += [f"link_{i}.{name}" for name in strain_names(link)]
            else:
                names += [
                    f"link_{i}.marker_{j}.{name}" for j in range(1, link.elements + 1) for name in nodal_names(link)
                ]
        q_f.append(slice(start, len(base_speeds) + len(names)))
    return Layout(
        planar=planar,
        free=free,
        position_names=base_positions + tuple(names),
        speed_names=base_speeds + tuple(names),
        base_linear=linear,
        base_angular=angular,
        n_base_positions=len(base_positions),
        q=q,
        theta_m=tuple(theta_m),
        q_f=tuple(q_f),
    )
