"""The model's energy against a second, slow computation that knows positions alone.

Every body and every slice of a link is a point and a frame; their velocities are differences of their positions
R(x(t)), (8)–(12), (16)–(20), and integrals over links are quadratures of their own.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import Legendre
from scipy.integrate import simpson
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from sms_online.description.bodies import FlexibleLink, Inertia, Joint, Motor, RigidBody
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.layout import Layout
from sms_online.stream import Array
from tests.model_systems import DIFFERENCE, SYSTEMS, random_states

# Instants of the differences, s. The step leaves 1e-16/STEP of rounding and STEP⁸ of truncation.
STEP = 2e-3
TIMES = STEP * np.arange(-4, 5)
NOW = 4
ROD_STEPS = 512
RELATIVE = 1e-10


def turned(vectors: Array) -> Array:
    """Rotation matrices (T, 3, 3) of rotation vectors (T, 3)."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def rate(samples: Array) -> Array:
    """Derivative at NOW of samples (9, ...)."""
    terms = [w * (samples[NOW + k] - samples[NOW - k]) / STEP for k, w in enumerate(DIFFERENCE, start=1)]
    return np.asarray(np.sum(terms, axis=0))


def angular_velocity(R: Array) -> Array:
    """Inertial ω (..., 3) at NOW of frames (9, ..., 3, 3)."""
    W = rate(R) @ np.swapaxes(R[NOW], -1, -2)
    return 0.5 * np.stack(
        (W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]), axis=-1
    )


def tensor(i: Inertia) -> Array:
    return np.array([[i.xx, i.xy, i.xz], [i.xy, i.yy, i.yz], [i.xz, i.yz, i.zz]])


class Bodies:
    """Kinetic and potential energy, added up body by body."""

    def __init__(self, gravity: Array) -> None:
        self.gravity = gravity
        self.kinetic = self.potential = 0.0

    def point(self, mass: float, r: Array) -> None:
        """A point mass at positions r (9, 3)."""
        self.kinetic += 0.5 * mass * float(rate(r) @ rate(r))
        self.potential -= mass * float(self.gravity @ r[NOW])

    def tumble(self, inertia: Array, R: Array) -> None:
        """A body that turns with frames R (9, 3, 3), its inertia (3, 3) given in them."""
        omega = R[NOW].T @ angular_velocity(R)
        self.kinetic += 0.5 * float(omega @ inertia @ omega)

    def body(self, body: RigidBody, origin: Array, R: Array) -> None:
        """A rigid body in a frame."""
        self.point(body.mass, origin + R @ np.array(body.center_of_mass))
        self.tumble(tensor(body.inertia), R)


def linear_link(link: FlexibleLink, q_f: Array) -> tuple[Array, Array, Array, Array, Array, float]:
    """Points (9, n, 3), section frames, weights (n,), tip, its frame, strain energy: (1)–(4), (11), (14)."""
    names = ("u_x", "u_y", "u_z", "theta_x", "theta_y", "theta_z")
    nodal = np.zeros((len(TIMES), link.elements + 1, 6))
    active = {"traction": "u_x", "bending_z": "u_y theta_z", "bending_y": "u_z theta_y", "torsion": "theta_x"}
    kept = sorted(names.index(name) for d in link.deformations for name in active[d].split())
    nodal[:, 1:, kept] = q_f.reshape(len(TIMES), link.elements, len(kept))
    nodes = np.linspace(0.0, link.length, link.elements + 1)
    xi, w = np.polynomial.legendre.leggauss(9)
    half = 0.5 * link.length / link.elements
    x = np.concatenate([node + half * (1.0 + xi) for node in nodes[:-1]])
    weights = np.tile(half * w, link.elements)
    u_y = CubicHermiteSpline(nodes, nodal[..., 1], nodal[..., 5], axis=1)
    u_z = CubicHermiteSpline(nodes, nodal[..., 2], -nodal[..., 4], axis=1)
    u_x = np.stack([np.interp(x, nodes, u) for u in nodal[..., 0]])
    theta_x = np.stack([np.interp(x, nodes, u) for u in nodal[..., 3]])
    points = np.stack((x + u_x, u_y(x), u_z(x)), axis=2)
    sections = turned(np.stack((theta_x, 0.0 * theta_x, 0.0 * theta_x), axis=2).reshape(-1, 3)).reshape(
        *theta_x.shape, 3, 3
    )
    stretch, twist = (np.diff(nodal[NOW, :, k]) / np.diff(nodes) for k in (0, 3))
    length = np.diff(nodes)
    strain = 0.5 * (
        link.axial_rigidity * stretch**2 @ length
        + link.torsional_rigidity * twist**2 @ length
        + link.flexural_rigidity_z * u_y(x, 2)[NOW] ** 2 @ weights
        + link.flexural_rigidity_y * u_z(x, 2)[NOW] ** 2 @ weights
    )
    tip = np.array([link.length, 0.0, 0.0]) + nodal[:, -1, :3]
    return points, sections, weights, tip, turned(nodal[:, -1, 3:]), float(strain)


def exact_rod(link: FlexibleLink, q_f: Array, free_end: bool) -> tuple[Array, Array, Array, Array, Array, float]:
    """The same for R' = R κ×, r' = R e_x, integrated by Runge–Kutta over ROD_STEPS steps."""
    h = link.length / ROD_STEPS
    fine = np.linspace(0.0, link.length, 2 * ROD_STEPS + 1)
    fields = {"torsion": (0, 1), "bending_y": (1, 2), "bending_z": (2, 2)}
    kappa = np.zeros((len(TIMES), len(fine), 3))
    column = 0
    for deformation, (axis, per_marker) in fields.items():
        if deformation in link.deformations:
            for k in range(per_marker * link.elements):
                kappa[..., axis] += np.multiply.outer(q_f[:, column], Legendre.basis(k, [0.0, link.length])(fine))
                column += 1
    if free_end:
        kappa *= (1.0 - fine / link.length)[:, None]
    K = np.zeros((*kappa.shape, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = np.moveaxis(kappa, -1, 0)
    K -= np.swapaxes(K, -1, -2)
    R = [np.broadcast_to(np.eye(3), (len(TIMES), 3, 3))]
    r = [np.zeros((len(TIMES), 3))]
    for k in range(ROD_STEPS):
        start, middle, end = K[:, 2 * k], K[:, 2 * k + 1], K[:, 2 * k + 2]
        k1 = R[-1] @ start
        R2 = R[-1] + 0.5 * h * k1
        k2 = R2 @ middle
        R3 = R[-1] + 0.5 * h * k2
        k3 = R3 @ middle
        R4 = R[-1] + h * k3
        r.append(r[-1] + h / 6.0 * (R[-1] + 2.0 * R2 + 2.0 * R3 + R4)[..., 0])
        R.append(R[-1] + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + R4 @ end))
    rigidity = np.array([link.torsional_rigidity, link.flexural_rigidity_y, link.flexural_rigidity_z])
    strain = 0.5 * simpson(kappa[NOW] ** 2 @ rigidity, x=fine)
    weights = simpson(np.eye(ROD_STEPS + 1), dx=h)
    return np.stack(r, axis=1), np.stack(R, axis=1), weights, r[-1], R[-1], float(strain)


def energy(system: System, layout: Layout, x: Array, v: Array) -> tuple[float, float]:
    """K and U of one state."""
    out = Bodies(np.array(system.gravity))
    moved = x[layout.n_base_positions :] + TIMES[:, None] * v[layout.n_base_speeds :]
    n = layout.n_base_speeds
    r_S, T_0 = (a[0] for a in layout.base_pose(x[None]))
    v_S, omega = np.zeros(3), np.zeros(3)
    v_S[list(layout.base_linear)] = v[: len(layout.base_linear)]
    omega[list(layout.base_angular)] = v[len(layout.base_linear) : n]
    R = turned(TIMES[:, None] * omega) @ T_0
    r = r_S + TIMES[:, None] * v_S
    if system.spacecraft is not None:
        r = r - R @ np.array(system.spacecraft.tracked_point)
        out.body(system.spacecraft, r, R)
    ends = {"base": (r, R)}
    payload = None if system.payload is None else f"link_{len(system.joints)}"
    mounts = (*system.joints, *system.fixed_joints)
    waiting = list(range(len(system.links)))
    while waiting:
        i = waiting.pop(0)
        mount, link = mounts[i], system.links[i]
        before = mount.parent or (f"link_{i}" if i else "base")
        if before not in ends:
            waiting.append(i)
            continue
        r, R = ends[before]
        r, R = r + R @ np.array(mount.mount_position), R @ turned(np.array(mount.mount_rotation))
        if i < len(system.joints):
            joint, motor = system.joints[i], system.motors[i]
            r, R = beyond_joint(out, joint, motor, r, R, *(moved[:, k[i] - n] for k in (layout.q, layout.theta_m)))
        if isinstance(link, FlexibleLink):
            r, R = r + R @ np.array(link.root_position), R @ turned(np.array(link.root_rotation))
            free_end = f"link_{i + 1}" not in (payload, *parents(system))
            q_f = moved[:, layout.q_f[i].start - n : layout.q_f[i].stop - n]
            ends[f"link_{i + 1}"] = beyond_link(out, link, r, R, q_f, free_end)
        else:
            out.body(link, r, R)
            ends[f"link_{i + 1}"] = r + R @ np.array(link.tip), R
    if system.payload is not None and payload is not None:
        out.body(system.payload, *ends[payload])
    return out.kinetic, out.potential


def parents(system: System) -> list[str]:
    """What the joints are mounted on."""
    every = enumerate((*system.joints, *system.fixed_joints))
    return [mount.parent or (f"link_{i}" if i else "base") for i, mount in every]


def beyond_joint(
    out: Bodies, joint: Joint, motor: Motor | None, r: Array, R: Array, q: Array, theta_m: Array
) -> tuple[Array, Array]:
    """From a mount over its motor and joint."""
    axis = np.array(joint.axis)
    if motor is not None:
        out.point(motor.mass, r)
        out.tumble(tensor(motor.stator_inertia), R)
        spin = (R[NOW] @ axis) @ angular_velocity(R) + joint.gear_ratio * rate(theta_m)
        out.kinetic += 0.5 * motor.rotor_inertia * float(spin) ** 2
    out.potential += 0.5 * joint.stiffness * float(q[NOW] if joint.passive else theta_m[NOW] - q[NOW]) ** 2
    if joint.kind == "prismatic":
        return r + q[:, None] * (R @ axis), R
    return r, R @ turned(q[:, None] * axis)


def beyond_link(out: Bodies, link: FlexibleLink, r: Array, R: Array, q_f: Array, free_end: bool) -> tuple[Array, Array]:
    """From the root of a flexible link to its end."""
    if link.kinematics == "linear":
        points, sections, weights, tip, tip_turn, strain = linear_link(link, q_f)
    else:
        points, sections, weights, tip, tip_turn, strain = exact_rod(link, q_f, free_end)
    out.potential += strain
    inertial = r[:, None] + points @ np.swapaxes(R, 1, 2)
    frames = R[:, None] @ sections
    axial = np.einsum("ni,ni->n", frames[NOW, :, :, 0], angular_velocity(frames))
    out.kinetic += 0.5 * link.mass_per_length * float((rate(inertial) ** 2).sum(axis=1) @ weights)
    out.kinetic += 0.5 * link.polar_inertia_per_length * float(axial**2 @ weights)
    out.potential -= link.mass_per_length * float(weights @ inertial[NOW] @ out.gravity)
    return r + (R @ tip[..., None])[..., 0], R @ tip_turn


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS.keys())
def test_energy_is_that_of_all_points_and_slices(system: System) -> None:
    model = build_model(system)
    x, v = random_states(model.layout, 3, seed=30)
    moving = model.energy_columns(x, v) @ model.nominal
    at_rest = model.energy_columns(x, 0.0 * v) @ model.nominal
    for b in range(len(x)):
        K, U = energy(system, model.layout, x[b], v[b])
        np.testing.assert_allclose(moving[b] - at_rest[b], K, rtol=RELATIVE)
        np.testing.assert_allclose(at_rest[b], U, rtol=RELATIVE)
