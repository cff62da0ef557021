"""What a model with some effects leaves of a session: a function of the samples and these effects alone."""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.schema import Effect, System
from sms_online.diagnosis.attempt import Attempt, Case
from sms_online.diagnosis.record import SampleRecord
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from tests.axis_effects import SYSTEM, axis_block
from tests.slow_encoder import F, K, bench, session

EFFECTS = [Effect(name=name, where="joint_1") for name in ("coulomb_friction", "cubic_stiffness", "torque_offset")]
COULOMB, CORNER = 0.01, 20.0


def attempt() -> Attempt:
    """The bench with a link encoder behind 20 Hz and Coulomb friction, undeclared: rows hold more than noise."""
    return attempt_of(bench(), session(CORNER, COULOMB), EFFECTS)


def attempt_of(system: System, block: Block, candidates: list[Effect]) -> Attempt:
    estimator, record = Estimator(system, block.channels, "test"), SampleRecord(system.sample_rate)
    estimator.observers.append(record)
    estimator.push(block)
    estimator.finish()
    assert estimator.momentum is not None
    assert estimator.momentum.sensor_noise is not None
    case = Case("test", estimator, estimator.momentum.sensor_noise, record.segments(), [], lambda estimator: None)
    return Attempt(case, system, candidates=candidates)


def coarse(step: float, block: Block, coefficients: bool = True) -> tuple[System, Block]:
    """The bench with all its effects described, and a motor encoder that is read in steps, rad.

    coefficients: whether those of friction are described, to some 25 %.
    """
    frictions = [("viscous_friction", {"damping": 1.25 * F}), ("coulomb_friction", {"torque": 0.8 * COULOMB})]
    effects = [
        *(Effect(name=name, where="joint_1", coefficients=given if coefficients else {}) for name, given in frictions),
        Effect(name="sensor_lag", where="q_1", coefficients={"corner": CORNER}),
    ]
    system = bench()
    torque, encoders = system.sensors
    motor = encoders.model_copy(update={"channels": ("theta_m_1",), "resolution": step})
    sensors = (torque, motor, encoders.model_copy(update={"channels": ("q_1",)}))
    values = block.values.copy()
    values[:, 1] = step * np.round(values[:, 1] / step)
    described = system.model_copy(update={"effects": tuple(effects), "sensors": sensors})
    return described, Block(block.t, block.channels, values)


@pytest.mark.slow
def test_what_effects_leave_does_not_depend_on_questions_before() -> None:
    bench = attempt()
    assert bench.tracing.exceeds
    sets = [[], [0], [1], [0, 1]]
    first = {tuple(chosen): bench.state(chosen) for chosen in sets}
    for chosen in (*reversed(sets), *sets[1:]):
        again, before = bench.state(chosen), first[tuple(chosen)]
        np.testing.assert_array_equal(again.solution, before.solution)
        assert again.holdout == before.holdout
        assert again.test == before.test


@pytest.mark.slow
def test_a_search_finds_the_same_whatever_was_asked_before() -> None:
    one, other = attempt(), attempt()
    for chosen in ([2], [0], [1, 2]):
        other.state(chosen)
    found = [each.tracing.run(lambda chosen, k: None) for each in (one, other)]
    assert found[0] == found[1]
    np.testing.assert_array_equal(one.solution(found[0]), other.solution(found[1]))


@pytest.mark.parametrize("coefficients", [True, False])
def test_a_candidate_that_acts_like_a_parameter_does_not_change_the_weights(coefficients: bool) -> None:
    """Friction by direction is viscous friction where its two coefficients are equal.

    Rows do not say how much of it belongs to which. Coefficients of some N m s/rad that cancel each other would turn
    the encoder's deviation of 1 mrad into a torque noise that hides all else, and the spring would be a quarter too
    soft. A fit of rows that hold no more than noise is right to 0.5 %; without described coefficients the one in the
    weights is near zero.
    """
    whole = session(CORNER, COULOMB)
    block = Block(whole.t[:4000], whole.channels, whole.values[:4000])
    system, block = coarse(4e-3, block, coefficients)
    found = attempt_of(system, block, [Effect(name="direction_friction", where="joint_1")])
    names = [p.name for p in found.rows.base.parameters]
    assert abs(found.rows.beta[names.index("viscous_friction@joint_1.damping")] - F) < 2.0 * F
    assert found.solution([])[names.index("joint_1.stiffness")] == pytest.approx(K, rel=0.01)


@pytest.mark.slow
def test_a_described_lag_leaves_the_spring_beside_a_torque_that_wanders() -> None:
    """Nothing known explains a torque whose gain wanders by 3 %, correlated over a second. The spring stays known."""
    system, block = coarse(1.5e-3, session(CORNER, COULOMB, wander=0.03))
    found = sms.diagnose(system, sms.Capture(block.t, block.channels, block.values))
    assert found.verdict == "unexplained"
    spring = found.after.parameters["joint_1.stiffness"]
    # The session's, whose deviations are those between blocks.
    assert abs(spring.value - K) < 3.0 * spring.std < 0.05 * K


@pytest.mark.long
def test_friction_behind_the_spring_is_told_from_the_motor_s() -> None:
    """Both undeclared. The simulation rounds the motor's off below 0.02 rad/s, as presliding does."""
    found = sms.diagnose(bench(), session(None, COULOMB, bearing=2.0 * COULOMB))
    bearing, motor = sorted(found.effects, key=lambda effect: effect.name)
    assert bearing.name == "bearing_coulomb_friction"
    assert bearing.coefficients["torque"].value == pytest.approx(2.0 * COULOMB, rel=0.05)
    assert motor.name in ("coulomb_friction", "presliding_friction")
    assert motor.coefficients["torque"].value == pytest.approx(COULOMB, rel=0.05)
    assert found.after.parameters["joint_1.stiffness"].value == pytest.approx(K, rel=0.005)


def test_what_an_event_added_to_a_session_is_no_part_of_the_description() -> None:
    """Coulomb friction begins after 6 s, and an event adds it to the session's model; a lag is then tried."""
    block = axis_block(lambda q, rate: np.sign(rate), begin=6.0)
    found = attempt_of(SYSTEM, block, [])
    names = ["link_1.inertia", "viscous_friction@joint_1.damping"]
    assert [p.name for p in found.case.session.base.parameters] == [*names, "coulomb_friction@joint_1.torque"]
    lag = Effect(name="sensor_lag", where="q_1", coefficients={"corner": CORNER})
    tried = found.trial(SYSTEM, [lag], found.rows.beta, [])
    for each in (found, tried):
        assert [p.name for p in each.rows.base.parameters] == names


@pytest.mark.slow
@pytest.mark.parametrize("coulomb", [0.0, pytest.param(0.01, marks=pytest.mark.long)])
def test_a_lag_is_found_where_the_spring_vanishes_without_it(coulomb: float) -> None:
    """All candidates together explain a link encoder behind 20 Hz; none of them does, but by a spring of nothing."""
    found = sms.diagnose(bench(), session(20.0, coulomb))
    lag = next(effect for effect in found.effects if effect.name == "sensor_lag")
    assert lag.where == "q_1"
    assert lag.coefficients["corner"].value == pytest.approx(20.0, rel=0.02)
    beside = {effect.name for effect in found.effects} - {"sensor_lag"}
    assert beside <= ({"presliding_friction", "coulomb_friction"} if coulomb else set())
    assert found.after.parameters["joint_1.stiffness"].value == pytest.approx(K, rel=0.01)


@pytest.mark.slow
def test_rows_are_whitened_by_the_session_s_parameters_where_these_leave_noise() -> None:
    """A first fit without weights is attenuated further."""
    clean = attempt_of(bench(), session(None, 0.0), [])
    np.testing.assert_array_equal(clean.rows.beta, clean.case.session.estimate().pi)
    lacking = attempt()
    assert np.any(lacking.rows.beta != lacking.case.session.estimate().pi)


@pytest.mark.long
def test_a_perfect_model_with_noisy_torques_is_clean() -> None:
    """Torques fix the scale of all masses weakly, and noise in the columns would attenuate it by 13 deviations."""
    system = sms.load_system("paper-planar")
    data = sms.simulate(system, duration=10.0, grade="C", seed=1)
    values = dict(zip(data.channels, data.values.T, strict=True))
    random = np.random.default_rng(5)
    noisy = {name: values[name] + 5.0 * random.normal(size=data.t.size) for name in ("tau_1", "tau_2")}
    found = sms.diagnose(system, sms.Capture.from_arrays(data.t, values | noisy))
    attempt = found.search.attempt
    assert found.verdict == "clean"
    assert max(attempt.state([]).fit.whitened.values()) < 1.2
    true = attempt.rows.base.values(attempt.rows.model.nominal)
    std = np.sqrt(np.diag(attempt.tracing.covariance([])))[: true.size]
    off = (attempt.solution([])[: true.size] - true) / std
    assert np.max(np.abs(off)) < 4.0


def test_an_eccentricity_within_its_tolerance_is_no_effect() -> None:
    calibrated = attempt().rows.calibrated
    tolerance = bench().tolerances.once_per_turn

    def of(size: float, phase: float = 1.0) -> Effect:
        return Effect(name="encoder_eccentricity", where="q_1", coefficients={"amplitude": size, "phase": phase})

    assert calibrated.tolerates(of(0.1 * tolerance))
    assert not calibrated.tolerates(of(100.0 * tolerance))
    # A lag is limited by what it is a lag behind, not by clocks.
    assert not calibrated.tolerates(Effect(name="sensor_lag", where="q_1", coefficients={"corner": 1e4}))
