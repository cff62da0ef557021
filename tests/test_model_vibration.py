"""Links vibrate as the textbook says: Euler–Bernoulli bending, torsion and traction of a clamped bar.

A link on a fixed base whose joint is held (its row and column struck out) is a cantilever. Roots of the cantilever:
Blevins, Formulas for Natural Frequency and Mode Shape (1979), table 8-1.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from sms_online.description.bodies import Deformation, FlexibleLink, Inertia, Joint, RigidBody
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.eigenmodes import clamped_loaded_modes, tip_load
from sms_online.stream import Array

BETA_L = np.array([1.875104068711961, 4.694091132974175, 7.854757438237613])
LENGTH, RHO_A, RHO_IP, EI_Z, EI_Y, GI_P, EA = 1.2, 5.0, 0.12, 300.0, 400.0, 150.0, 1e4


def cantilever(elements: int, deformation: Deformation, kinematics: str, payload: RigidBody | None = None) -> System:
    link = FlexibleLink(
        kind="flexible",
        length=LENGTH,
        elements=elements,
        mass_per_length=RHO_A,
        polar_inertia_per_length=RHO_IP,
        flexural_rigidity_z=EI_Z,
        flexural_rigidity_y=EI_Y,
        torsional_rigidity=GI_P,
        axial_rigidity=EA,
        deformations=(deformation,),
        kinematics=kinematics,
    )
    return System(
        name="cantilever", joints=(Joint(transmission="rigid"),), motors=(None,), links=(link,), payload=payload
    )


def natural_frequencies(system: System) -> Array:
    """ω, rad/s, with the joint held and the link straight."""
    model = build_model(system)
    dynamics = model.dynamics(model.nominal)
    H = dynamics.mass_matrix(np.zeros((1, model.layout.n_x)))[0, 1:, 1:]
    return np.sqrt(scipy.linalg.eigvalsh(dynamics.stiffness[1:, 1:], H))


@pytest.mark.parametrize(("plane", "EI"), [("bending_z", EI_Z), ("bending_y", EI_Y)])
def test_linear_link_converges_to_the_cantilever(plane: Deformation, EI: float) -> None:
    """Cubic elements approach the lowest frequencies from above, sixteen times closer with elements half as long."""
    exact = (BETA_L / LENGTH) ** 2 * np.sqrt(EI / RHO_A)
    errors = [natural_frequencies(cantilever(n, plane, "linear"))[:3] / exact - 1.0 for n in (8, 16)]
    assert (errors[1] > 0.0).all()
    np.testing.assert_allclose(errors[0] / errors[1], 16.0, rtol=0.05)
    np.testing.assert_allclose(errors[1], 0.0, atol=5e-5)


@pytest.mark.parametrize(("plane", "EI"), [("bending_z", EI_Z), ("bending_y", EI_Y)])
def test_exact_rod_converges_to_the_cantilever(plane: Deformation, EI: float) -> None:
    """Polynomials of curvature converge faster than any power: each marker more is worth two decimals at least."""
    exact = (BETA_L / LENGTH) ** 2 * np.sqrt(EI / RHO_A)
    errors = [natural_frequencies(cantilever(n, plane, "exact"))[:2] / exact[:2] - 1.0 for n in (1, 2, 3)]
    assert (errors[0] > 100.0 * errors[1]).all()
    assert (errors[1] > 100.0 * errors[2]).all()
    three = natural_frequencies(cantilever(4, plane, "exact"))[:3]
    np.testing.assert_allclose(three, exact, rtol=1e-5)


def test_two_markers_carry_the_two_lowest_modes() -> None:
    """With the paper's number of markers the two lowest frequencies are right to 1 %, whatever the kinematics."""
    exact = (BETA_L[:2] / LENGTH) ** 2 * np.sqrt(EI_Z / RHO_A)
    for kinematics in ("linear", "exact"):
        found = natural_frequencies(cantilever(2, "bending_z", kinematics))[:2]
        np.testing.assert_allclose(found, exact, rtol=0.01)


@pytest.mark.parametrize(("kinematics", "elements", "tolerance"), [("linear", 16, 4e-3), ("exact", 6, 1e-6)])
def test_torsion_is_that_of_a_clamped_free_bar(kinematics: str, elements: int, tolerance: float) -> None:
    """ω_k = (k - ½) π/L √(GI_p/ρI_p): the polar inertia gives the torsional coordinates their mass."""
    exact = (np.arange(2) + 0.5) * np.pi / LENGTH * np.sqrt(GI_P / RHO_IP)
    found = natural_frequencies(cantilever(elements, "torsion", kinematics))[:2]
    np.testing.assert_allclose(found, exact, rtol=tolerance)


def test_traction_is_that_of_a_clamped_free_bar() -> None:
    """ω_k = (k - ½) π/L √(EA/ρA), the error of linear elements falling fourfold when they are halved."""
    exact = (np.arange(2) + 0.5) * np.pi / LENGTH * np.sqrt(EA / RHO_A)
    errors = [natural_frequencies(cantilever(n, "traction", "linear"))[:2] / exact - 1.0 for n in (8, 16)]
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.05)
    np.testing.assert_allclose(errors[1], 0.0, atol=5e-3)


@pytest.mark.parametrize(("kinematics", "tolerance"), [("linear", 2e-3), ("exact", 1e-7)])
def test_a_tip_load_lowers_the_frequencies_like_the_eigenmodes(kinematics: str, tolerance: float) -> None:
    """The model's H and stiffness against the frequency equation of the clamped-loaded beam, section III."""
    payload = RigidBody(mass=4.0, center_of_mass=(0.2, 0.0, 0.0), inertia=Inertia(zz=0.3))
    system = cantilever(4, "bending_z", kinematics, payload)
    modes = clamped_loaded_modes(LENGTH, RHO_A, EI_Z, tip_load(system, 1, "bending_z"), 3)
    expected = np.array([mode.natural_frequency for mode in modes])
    found = natural_frequencies(system)[:3]
    np.testing.assert_allclose(found, expected, rtol=tolerance)
    assert (found < natural_frequencies(cantilever(4, "bending_z", kinematics))[:3]).all()
