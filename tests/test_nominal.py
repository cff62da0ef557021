"""Estimates against the stated values: what only these can show, wrong units, gears and signs of whole balances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sms_online as sms
from sms_online.nominal import compare, unit_factors
from sms_online.verdict.trust import Trust
from tests.evaluated import judged
from tests.sessions_of import session_of

GEAR = 100.0
# One flexible joint and a rigid link, on a fixed base; noise stated, so that a session of 12 s is enough.
RIG = {
    "name": "rig",
    "motion": "planar",
    "sample_rate": 500.0,
    "joint_1": {"gear_ratio": GEAR, "stiffness": 40.0, "damping": 2.0},
    "motor_1": {"rotor_inertia": 6.4e-6},
    "link_1": {"kind": "rigid", "inertia": {"zz": 0.17}},
    "sensor": [
        {"channels": ["theta_m_1", "q_1"], "noise": 1e-5},
        {"channels": ["tau_1"], "noise": 1e-4},
    ],
    "controller": {"stiffness": [4.0], "damping": [0.8]},
    "trajectory": {
        "duration": 12.0,
        "joint_1": [{"frequency": 4.0, "sine": 0.5}, {"frequency": 11.0, "sine": 0.2}],
    },
}
NAMES = ("a", "b", "c", "d")
NOMINAL = dict(zip(NAMES, (1.0, 20.0, 3.0, 400.0), strict=True))


@pytest.fixture(scope="module")
def capture() -> sms.Capture:
    """The rig along its trajectory, noise of seed 0."""
    return sms.simulate(sms.load_system(RIG), duration=12.0)


def scaled(capture: sms.Capture, factors: dict[str, float]) -> sms.Capture:
    """The capture with some channels in other units."""
    by = np.array([factors.get(name, 1.0) for name in capture.channels])
    return replace(capture, values=capture.values * by)


def trust_in(system: sms.System, capture: sms.Capture) -> Trust:
    """May the estimate of a session be trusted? Without the search for effects, which takes most of the time."""
    estimator = session_of(system, capture)
    return judged(estimator)


@pytest.mark.slow
def test_a_session_as_described_is_trusted(capture: sms.Capture) -> None:
    trust = trust_in(sms.load_system(RIG), capture)
    assert trust.level == "trust", trust


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factors", "factor", "cause"),
    [
        ({"tau_1": GEAR}, "100", "joint's torque"),
        ({"tau_1": 1000.0}, "1e+03", "mN m"),
        ({"tau_1": -1.0}, "-1", "sign of the torque looks inverted"),
        ({"theta_m_1": 180.0 / np.pi, "q_1": 180.0 / np.pi}, "0.01", "degrees"),
    ],
)
def test_a_wrong_unit_of_everything_is_named(
    capture: sms.Capture, factors: dict[str, float], factor: str, cause: str
) -> None:
    """Rows fit as well as ever, so that green would be the worst of answers."""
    trust = trust_in(sms.load_system(RIG), scaled(capture, factors))
    assert trust.grave, trust
    assert trust.reasons[0].startswith(f"everything is {factor}")
    assert cause in trust.reasons[0]
    assert "unit" in trust.next_step


@pytest.mark.slow
def test_a_wrong_gear_is_never_green(capture: sms.Capture) -> None:
    """Ten for a hundred: a tenth of all torques, and of the rotor's inertia a hundredth of the gear's square."""
    system = sms.load_system({**RIG, "joint_1": {**RIG["joint_1"], "gear_ratio": 10.0}})
    assert trust_in(system, capture).level == "doubt"


def test_a_factor_that_most_parameters_share_is_common() -> None:
    value = 57.0 * np.array([1.0, 20.5, 2.9, 1.0])
    found = compare(NAMES, value, 1e-3 * value, NOMINAL, {"x": 60.0})
    assert found.common == pytest.approx(57.0, rel=0.05)
    assert (found.cause, found.apart) == ("x", ())


def test_a_single_parameter_apart_is_said_by_name() -> None:
    value = np.array([1.1, 19.0, 7.0, 390.0])
    found = compare(NAMES, value, 1e-3 * value, NOMINAL, {})
    assert found.common is None
    assert [(p.name, p.value, p.nominal) for p in found.apart] == [("c", 7.0, 3.0)]


def test_what_error_bars_leave_possible_is_not_apart() -> None:
    value = np.array([1.1, 19.0, 7.0, 390.0])
    assert compare(NAMES, value, 0.3 * value, NOMINAL, {}).apart == ()


def test_parameters_without_a_stated_value_are_not_compared() -> None:
    value = np.array([5.0, 100.0])
    assert compare(("e", "f"), value, 1e-3 * value, {"e": 0.0}, {}).common is None


def test_a_rig_without_gears_has_no_factor_of_a_gear() -> None:
    assert 1000.0 in unit_factors(sms.load_system("emps")).values()
    assert not any("tau" in cause for cause in unit_factors(sms.load_system("emps")))
