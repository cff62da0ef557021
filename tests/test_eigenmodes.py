"""Clamped-loaded eigenmodes against textbook roots and against finite elements that share no code with them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import eigh

from sms_adapters.system_file import load_system
from sms_online.description.bodies import FlexibleLink
from sms_online.model.eigenmodes import Bending, TipLoad, clamped_loaded_modes, markers, tip_load
from tests.model_systems import tree

LENGTH, RHO_A, EI = 1.2, 31.42, 1768.8  # the paper's link 1


def finite_element_frequencies(load: TipLoad, elements: int = 40) -> np.ndarray:
    """Natural frequencies, rad/s, of the clamped beam from Hermite elements with the load on the last node."""
    h = LENGTH / elements
    k = EI / h**3 * np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2],
                              [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]])  # fmt: skip
    m = RHO_A * h / 420 * np.array([[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2],
                                    [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2]])  # fmt: skip
    n = 2 * (elements + 1)
    K, M = np.zeros((n, n)), np.zeros((n, n))
    for e in range(elements):
        at = slice(2 * e, 2 * e + 4)
        K[at, at] += k
        M[at, at] += m
    M[-2:, -2:] += [[load.mass, load.first_moment], [load.first_moment, load.inertia]]
    return np.sqrt(eigh(K[2:, 2:], M[2:, 2:], eigvals_only=True))


def test_an_unloaded_cantilever_has_the_textbook_roots() -> None:
    modes = clamped_loaded_modes(LENGTH, RHO_A, EI, TipLoad(), 4)
    roots = [mode.beta * LENGTH for mode in modes]
    # Blevins, Formulas for Natural Frequency and Mode Shape (1979), table 8-1
    assert roots == pytest.approx([1.87510407, 4.69409113, 7.85475744, 10.99554073], abs=1e-8)


@pytest.mark.parametrize(
    "load",
    [
        TipLoad(),
        TipLoad(mass=3.0, inertia=0.015),
        TipLoad(mass=40.704, first_moment=22.6224, inertia=18.11292),
        TipLoad(mass=40.704, inertia=18.11292),
        TipLoad(mass=5000.0, first_moment=8000.0, inertia=20000.0),
    ],
    ids=["free", "motor", "arm", "arm without first moment", "far heavier than the beam"],
)
def test_modes_are_all_those_of_finite_elements(load: TipLoad) -> None:
    modes = clamped_loaded_modes(LENGTH, RHO_A, EI, load, 4)
    expected = finite_element_frequencies(load)[:4]
    assert [mode.natural_frequency for mode in modes] == pytest.approx(expected, rel=2e-5)


def test_a_heavy_tip_mass_swings_on_a_massless_beam() -> None:
    tip = 1e4 * RHO_A * LENGTH
    lowest = clamped_loaded_modes(LENGTH, RHO_A, EI, TipLoad(mass=tip), 1)[0]
    # 33/140 of the beam's mass moves with the tip (Rayleigh, static shape).
    rayleigh = np.sqrt(3 * EI / LENGTH**3 / (tip + 33 / 140 * RHO_A * LENGTH))
    assert lowest.natural_frequency == pytest.approx(rayleigh, rel=1e-6)


def test_the_load_of_the_first_link_is_motor_2_and_link_2() -> None:
    system = load_system("paper-planar")
    load = tip_load(system, 1, "bending_z")
    link_mass = RHO_A * LENGTH
    assert load.mass == pytest.approx(3.0 + link_mass)
    assert load.first_moment == pytest.approx(link_mass * LENGTH / 2)
    assert load.inertia == pytest.approx(0.0075 + 0.0075 + link_mass * LENGTH**2 / 3)
    assert tip_load(system, 2, "bending_z") == TipLoad()


def test_the_payload_loads_the_last_link_in_each_plane() -> None:
    system = load_system("spatial-two-link")
    assert system.payload is not None
    (x, y, z), m, own = system.payload.center_of_mass, system.payload.mass, system.payload.inertia
    cases: tuple[tuple[Bending, float], ...] = (
        ("bending_z", own.zz + m * (x**2 + y**2)),
        ("bending_y", own.yy + m * (x**2 + z**2)),
    )
    for plane, moment in cases:
        load = tip_load(system, 2, plane)
        assert (load.mass, load.first_moment, load.inertia) == pytest.approx((m, m * x, moment))


def test_the_papers_links_need_two_markers_each() -> None:
    first, second = markers(load_system("paper-planar"))
    assert second.f_max == pytest.approx(0.62, abs=5e-3)
    assert second.f_s * LENGTH == pytest.approx(1.5, abs=0.01)
    assert second.markers == 2
    # A loaded link bends into less of a wave than a free one, so (6) alone would ask for one marker.
    assert first.f_max == pytest.approx(0.35, abs=5e-3)
    assert first.markers == 2


def test_the_third_mode_of_link_1_has_0_65_waves_a_metre() -> None:
    load = tip_load(load_system("paper-planar"), 1, "bending_z")
    frequencies = [
        mode.spatial_frequency
        for mode in clamped_loaded_modes(LENGTH, RHO_A, EI, TipLoad(load.mass, 0.0, load.inertia), 3)
    ]
    assert frequencies == pytest.approx([0.144, 0.271, 0.651], abs=1e-3)


def test_more_modes_need_more_markers_and_rigid_links_none() -> None:
    system = load_system("seven-joint")
    few, many = markers(system, modes=2), markers(system, modes=5)
    assert [entry.link for entry in few] == [3, 4]
    assert all(set(entry.modes) == {"bending_y", "bending_z"} for entry in few)
    assert all(b.markers > a.markers and b.f_max > a.f_max for a, b in zip(few, many, strict=True))
    assert markers(load_system("emps")) == ()


@pytest.mark.parametrize(
    "name", ["paper-planar", "paper-planar-table-v", "paper-planar-exact", "spatial-two-link", "seven-joint"]
)
def test_shipped_links_carry_the_markers_that_they_need(name: str) -> None:
    system = load_system(name)
    for entry in markers(system):
        link = system.links[entry.link - 1]
        assert isinstance(link, FlexibleLink)
        assert link.elements >= entry.markers


def test_markers_of_a_tree_carry_what_is_mounted_on_them() -> None:
    """Link 4 is a free panel; links 2, 3 and 7 are mounted on link 1, and the other arm is none of its load."""
    system = tree()
    assert tip_load(system, 4, "bending_z") == TipLoad()
    carried = sum(getattr(system.links[k], "mass", 0.0) for k in (1, 2, 6))
    motors = sum(system.motors[k].mass for k in (1, 2))  # type: ignore[union-attr]
    assert tip_load(system, 1, "bending_z").mass == pytest.approx(carried + motors)
    assert {entry.link for entry in markers(system)} == {1, 4, 5}
