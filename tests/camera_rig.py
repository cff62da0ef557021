"""Rigs whose links cameras see as points: three markers a link at 240 Hz, 0.1 mm, and the base's pose with them."""

from __future__ import annotations

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.description.bodies import FlexibleLink, Marker
from sms_online.description.parse import parse_system
from sms_online.description.schema import Sensor, System, Tolerances
from sms_online.stream import Array, Block
from sms_sim.bound import motion_bounds
from sms_sim.simulate import Simulation
from tests.one_link import TEXT

CAMERA_RATE = 240.0  # Hz
# Of each link: stations off the ends of its elements, the middle one beside the neutral axis.
POSITIONS = ((0.35, 0.0, 0.0), (0.75, 0.03, 0.0), (1.15, 0.0, 0.0))
SPATIAL_POSITIONS = ((0.35, 0.0, 0.05), (0.75, 0.06, -0.04), (1.15, -0.05, 0.02))


MARKERS = """
[[link_1.markers]]
position = [0.3, 0.0, 0.0]

[[link_1.markers]]
name = "beside the tip"
position = [1.0, 0.03, 0.0]
"""

# Of a session of 20 s.
FAULTS = (
    "missing@link_*:share=0.1",
    "hidden@link_2.*:begin=8,over=2",
    "swapped@link_1.marker_1+link_1.marker_2:begin=4,over=1",
)


def marked_bench(old: str = "", new: str = "") -> System:
    """A bench of one link with two markers; a text of its description replaced."""
    text = TEXT.replace("KINEMATICS", "linear").replace("marker_*.u_y", "marker_*.[xy]") + MARKERS
    return parse_system(text.replace(old, new) if old else text, "one-link")


def bound_of(simulation: Simulation) -> Array:
    """Cramér–Rao bound (n,) of a simulated motion and the sensors that its system describes."""
    return np.array([bound.std for bound in motion_bounds(simulation).parameters.values()])


def readings_off(system: System, block: Block, seed: int) -> tuple[System, Block]:
    """A description of a rig, and its samples, off by what readings may be within the default tolerances, 1σ each.

    The description has other places of markers and another tracked point. Encoders have zeros and errors once a turn,
    cameras a clock and a scale.
    """
    rng, within, names = np.random.default_rng(1000 + seed), Tolerances(), list(block.channels)
    axes = 2 if system.motion == "planar" else 3

    def moved(place: tuple[float, ...], size: float) -> tuple[float, ...]:
        return tuple(value + (size * rng.standard_normal() if k < axes else 0.0) for k, value in enumerate(place))

    links = []
    for link in system.links:
        markers = [m.model_copy(update={"position": moved(m.position, within.marker_station)}) for m in link.markers]
        links.append(link.model_copy(update={"markers": tuple(markers)}))
    changed: dict[str, object] = {"links": tuple(links), "tolerances": within}
    base = system.spacecraft
    if base is not None:
        point = moved(base.tracked_point, within.tracked_point)
        changed["spacecraft"] = base.model_copy(update={"tracked_point": point})
    values = block.values.copy()
    for k, name in enumerate(names):
        if name.startswith(("q_", "theta_m_")):
            sine, cosine = within.once_per_turn * rng.standard_normal(2)
            zero = within.encoder_zero * rng.standard_normal()
            values[:, k] += zero + sine * np.sin(values[:, k]) + cosine * np.cos(values[:, k])
    seen = np.array([".marker_" in name or name.startswith(("r_S", "theta_0", "eps", "eta")) for name in names])
    metres = np.array([".marker_" in name or name.startswith("r_S") for name in names])
    values[:, metres] *= 1.0 + within.camera_scale * rng.standard_normal()
    rows = np.isfinite(values[:, seen]).any(axis=1)
    late = np.full((np.count_nonzero(rows), len(names)), np.nan)
    late[:, seen] = values[np.ix_(rows, seen)]
    values[:, seen] = np.nan
    t = np.concatenate((block.t, block.t[rows] + within.clock * rng.standard_normal()))
    order = np.argsort(t, kind="stable")
    order = order[(t[order] >= block.t[0]) & (t[order] <= block.t[-1])]
    return system.model_copy(update=changed), Block(t[order], block.channels, np.concatenate((values, late))[order])


def seen_by_cameras(name: str) -> System:
    """A shipped system with points in place of displacements; noise grade B, its geometry exactly known."""
    system = load_system(name)
    planar = system.motion == "planar"
    markers = tuple(Marker(position=at) for at in (POSITIONS if planar else SPATIAL_POSITIONS))
    links = tuple(
        link.model_copy(update={"markers": markers}) if isinstance(link, FlexibleLink) else link
        for link in system.links
    )
    sensors = (
        Sensor(channels=("tau_*",), noise=0.01),  # 0.5 N m after the gear
        Sensor(channels=("theta_m_*", "q_*"), noise=1e-4),
        Sensor(channels=("r_S_*",), rate=CAMERA_RATE, noise=1e-4),
        Sensor(channels=("theta_0",) if planar else ("eps_*", "eta"), rate=CAMERA_RATE, noise=1e-4 if planar else 5e-5),
        Sensor(channels=("link_*.marker_*.[xyz]",), rate=CAMERA_RATE, noise=1e-4),
    )
    return system.model_copy(
        update={"links": links, "sensors": sensors, "tolerances": Tolerances.model_validate("none")}
    )
