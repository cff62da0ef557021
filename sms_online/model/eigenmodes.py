"""Bending eigenmodes of clamped-loaded links and the number of markers that they ask for, section III, (5) and (6)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from sms_online.description.bodies import FlexibleLink, RigidBody
from sms_online.description.schema import System
from sms_online.description.tree import tree_of
from sms_online.stream import Array

Bending = Literal["bending_y", "bending_z"]

# Step of βL at which the frequency equation is searched for changes of sign. A beam's roots are about π apart; only the
# two lowest come closer, under loads far heavier than the beam, and even then they differ by a good part of themselves.
SEARCH_STEP = 0.01


@dataclass(frozen=True)
class TipLoad:
    """What a link carries: mass kg; first moment along the link's x, kg m, and inertia, kg m², about the link's end."""

    mass: float = 0.0
    first_moment: float = 0.0
    inertia: float = 0.0


@dataclass(frozen=True)
class Mode:
    """A bending mode: β, 1/m; spatial frequency β/2π, 1/m; natural frequency, rad/s."""

    beta: float
    spatial_frequency: float
    natural_frequency: float


@dataclass(frozen=True)
class LinkMarkers:
    """Markers that a link needs: f_max, 1/m, over its bending planes; f_s = 2 f_max, (5); markers see `markers`."""

    link: int
    modes: dict[Bending, tuple[Mode, ...]]
    f_max: float
    f_s: float
    markers: int


def clamped_loaded_modes(
    length: float, mass_per_length: float, flexural_rigidity: float, load: TipLoad, modes: int
) -> tuple[Mode, ...]:
    """Lowest `modes` bending modes of a uniform Euler–Bernoulli beam, clamped at one end and loaded at the other.

    length m, mass_per_length kg/m, flexural_rigidity N m². Source: D. J. Gorman, Free Vibration Analysis of Beams and
    Shafts (1975), cantilever with a rigid body at its end.
    """
    mass = load.mass / (mass_per_length * length)
    moment = load.first_moment / (mass_per_length * length**2)
    inertia = load.inertia / (mass_per_length * length**3)

    def equation(lam: float) -> float:
        return _frequency_equation(lam, mass, moment, inertia)

    out: list[Mode] = []
    low = SEARCH_STEP
    f_low = equation(low)
    while len(out) < modes:
        high = low + SEARCH_STEP
        f_high = equation(high)
        if f_low * f_high <= 0.0:
            beta = brentq(equation, low, high, xtol=1e-13) / length
            frequency = beta**2 * math.sqrt(flexural_rigidity / mass_per_length)
            out.append(Mode(beta, beta / (2.0 * math.pi), frequency))
        low, f_low = high, f_high
    return tuple(out)


def _frequency_equation(lam: float, mass: float, moment: float, inertia: float) -> float:
    """Determinant that vanishes at λ = βL; arguments are the load over ρA L, ρA L², ρA L³.

    w = a (cosh λξ - cos λξ) + b (sinh λξ - sin λξ) has to satisfy at ξ = 1: w'' = λ⁴ (inertia w' + moment w) and
    w''' = -λ⁴ (mass w + moment w'). Hyperbolic functions are divided by exp λ, so that nothing overflows.
    """
    decay = math.exp(-2.0 * lam)
    cosh, sinh = 0.5 * (1.0 + decay), 0.5 * (1.0 - decay)
    cos, sin = math.cos(lam) * math.exp(-lam), math.sin(lam) * math.exp(-lam)
    # Columns a and b; each derivative carries its power of λ, of which λ² and λ³ are divided out of the two rows.
    w = np.array([cosh - cos, sinh - sin])
    slope = np.array([sinh + sin, cosh - cos])
    curvature = np.array([cosh + cos, sinh + sin])
    shear = np.array([sinh - sin, cosh + cos])
    first = curvature - lam**2 * (inertia * lam * slope + moment * w)
    second = shear + lam * (mass * w + moment * lam * slope)
    return float(first[0] * second[1] - first[1] * second[0])


def tip_load(system: System, i: int, plane: Bending) -> TipLoad:
    """Load on link i (from 1) by what it carries, payload included; arm straight: mounts unturned, angles zero.

    Rotors turn with their stators, for the joints are held.
    """
    axis = "zz" if plane == "bending_z" else "yy"
    across = 1 if plane == "bending_z" else 2
    mass = first_moment = inertia = 0.0

    def add(m: float, center: Array, about_center: float) -> None:
        nonlocal mass, first_moment, inertia
        mass += m
        first_moment += m * float(center[0])
        inertia += about_center + m * float(center[0] ** 2 + center[across] ** 2)

    def add_body(body: RigidBody, at: Array) -> None:
        add(body.mass, at + np.array(body.center_of_mass), getattr(body.inertia, axis))

    tree, ends = tree_of(system), {i - 1: np.zeros(3)}
    for k in tree.outwards:
        if k in ends or tree.parents[k] not in ends:
            continue
        root, link = ends[tree.parents[k]], system.links[k]
        motor = system.motors[k] if k < len(system.motors) else None  # fixed joints have none
        if motor is not None:
            rotor = system.joints[k].axis["xyz".index(axis[0])] ** 2 * motor.rotor_inertia
            add(motor.mass, root, getattr(motor.stator_inertia, axis) + rotor)
        if isinstance(link, FlexibleLink):
            m, along = link.mass_per_length * link.length, np.array([link.length, 0.0, 0.0])
            add(m, root + 0.5 * along, m * link.length**2 / 12.0)
            ends[k] = root + along
        else:
            add_body(link, root)
            ends[k] = root + np.array(link.tip)
    if system.payload is not None and tree.last in ends:
        add_body(system.payload, ends[tree.last])
    return TipLoad(mass, first_moment, inertia)


def markers(system: System, modes: int = 2) -> tuple[LinkMarkers, ...]:
    """Markers of every flexible link that bends, from its lowest `modes` clamped-loaded modes in each plane.

    N_s = f_s L rounded up, (6), with the spatial frequency f = β/2π of a mode, but no fewer than `modes`: a heavy load
    bends its link into a fraction of a wave, and displacements at fewer points cannot distinguish that many modes.
    """
    out = []
    for i, link in enumerate(system.links, start=1):
        if not isinstance(link, FlexibleLink):
            continue
        found: dict[Bending, tuple[Mode, ...]] = {}
        for plane in ("bending_y", "bending_z"):
            if plane in link.deformations:
                rigidity = link.flexural_rigidity_z if plane == "bending_z" else link.flexural_rigidity_y
                load = tip_load(system, i, plane)
                found[plane] = clamped_loaded_modes(link.length, link.mass_per_length, rigidity, load, modes)
        if found:
            f_max = max(mode.spatial_frequency for series in found.values() for mode in series)
            f_s = 2.0 * f_max
            out.append(LinkMarkers(i, found, f_max, f_s, max(modes, math.ceil(f_s * link.length))))
    return tuple(out)
