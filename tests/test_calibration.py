"""What the description is off by within its tolerances: estimated, said, corrected, and in the error bars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from sms_adapters.system_file import load_system
from sms_online.calibration.found import Calibration
from sms_online.calibration.nuisance import Nuisance, known_beforehand, prior_rows
from sms_online.calibration.release import released
from sms_online.description.parse import parse_system, shipped_text
from sms_online.description.schema import Tolerances
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.pipeline.snapshot import statistics_of
from sms_online.session import Session
from sms_online.stream import Array, Block
from sms_online.trackers.interface import Rows
from sms_online.trackers.square_root import session_tracker
from sms_online.verdict.judged import JudgedEvaluation
from sms_sim.simulate import sampled_blocks
from tests.exactly_known import EXACTLY
from tests.sessions_of import session_of
from tests.simulations import planar

# Two clocks and two parameters, of rows that determine all of them.
NUISANCES = (Nuisance("clock", "a", "s", 0.5), Nuisance("clock", "b", "s", np.inf))


def test_the_prior_solution_marginalises_the_nuisance() -> None:
    """Random rows, seed 1: the same as generalised least squares whose covariance holds N P Nᵀ."""
    random = np.random.default_rng(1)
    Y, N, b = (random.standard_normal((40, k)) for k in (2, 1, 1))
    known = known_beforehand(NUISANCES[:1], 2)
    tracker = session_tracker(2, None, 1)
    tracker.begin(known)
    tracker.update(Rows(np.column_stack((N, Y)), b[:, 0], np.ones(40), np.arange(40.0)))
    estimate = tracker.estimate().without_nuisances(1)
    weight = np.linalg.inv(np.eye(40) + 0.25 * N @ N.T)
    covariance = np.linalg.inv(Y.T @ weight @ Y)
    np.testing.assert_allclose(estimate.covariance, covariance, rtol=1e-10)
    np.testing.assert_allclose(estimate.pi, covariance @ (Y.T @ weight @ b[:, 0]), rtol=1e-10)
    assert estimate.nuisances.shape == estimate.nuisances_std.shape == (1,)


@pytest.mark.parametrize(("off", "given"), [(0.4, 0.0), (40.0, 0.4)])
def test_rows_release_a_tolerance_that_keeps_a_value_within_it(off: float, given: float) -> None:
    """Rows know the nuisance to 3 tolerances at best: one of 40 is estimated within 2 of them."""
    random, clock = np.random.default_rng(1), Nuisance("clock", "a", "s", 0.01)
    rows = random.standard_normal((1100, 2))
    b = rows @ [off * clock.tolerance, 1.0] + random.standard_normal(1100)
    tracker = session_tracker(1, None, 1)
    tracker.begin(known_beforehand((clock,), 1))
    tracker.update(Rows(rows, b, np.ones(1100), np.arange(1100.0)))
    estimate = tracker.estimate()
    late = released(estimate, (clock,), estimate.covariance)
    if not given:
        np.testing.assert_array_equal(late.pi, estimate.pi)
        return
    assert late.pi[0] == pytest.approx(given, abs=0.1)
    assert late.std[0] == pytest.approx(0.03, rel=0.2)
    assert estimate.std[0] < 0.01


def test_nothing_is_known_of_a_nuisance_without_a_tolerance() -> None:
    np.testing.assert_array_equal(prior_rows(NUISANCES, 1), [[2.0, 0.0, 0.0, 0.0]])
    assert known_beforehand(NUISANCES, 1).rows == 1


@pytest.fixture(scope="module")
def exact() -> Block:
    """8 s of the planar example without noise."""
    blocks = list(sampled_blocks(planar(8.0), "0"))
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    return Block(t, blocks[0].channels, values)


def noisy(exact: Block, changed: dict[str, Array] | None = None, seed: int = 3) -> Block:
    """The samples with white noise of 1e-4 on positions and 0.01 N m on torques."""
    random = np.random.default_rng(seed)
    values = exact.values.copy()
    for name, column in (changed or {}).items():
        values[:, exact.channels.index(name)] = column
    torque = [name.startswith("tau") for name in exact.channels]
    values += np.where(torque, 1e-2, 1e-4) * random.standard_normal(values.shape)
    return Block(exact.t, exact.channels, values)


def estimated(block: Block) -> Estimator:
    """With the default tolerances."""
    system = load_system("paper-planar").model_copy(update={"tolerances": Tolerances()})
    return session_of(system, [block])


def evaluated(exact: Block, changed: dict[str, Array] | None = None, seed: int = 3) -> JudgedEvaluation:
    """Of noisy samples."""
    return JudgedEvaluation(statistics_of(estimated(noisy(exact, changed, seed))))


@pytest.fixture(scope="module")
def slightly_late(exact: Block) -> JudgedEvaluation:
    """A camera that is 100 µs late, two tolerances."""
    return evaluated(exact, late(exact, 1e-4))


@pytest.fixture(scope="module")
def very_late(exact: Block) -> Estimator:
    """A camera that is 4 ms late."""
    return estimated(noisy(exact, late(exact, 4e-3)))


def off(evaluation: JudgedEvaluation) -> Array:
    """Errors of the parameters over their bars."""
    base = evaluation.base
    return np.asarray((evaluation.estimate.pi - base.values(evaluation.model.nominal)) / evaluation.std)


def late(exact: Block, seconds: float) -> dict[str, Array]:
    """What base and markers read so much later."""
    seen = [name for name in exact.channels if name.startswith(("r_S", "theta_0", "link_"))]
    between = make_interp_spline(exact.t, exact.values[:, [exact.channels.index(name) for name in seen]], 5)
    return dict(zip(seen, between(exact.t - seconds).T, strict=True))


def of(evaluation: JudgedEvaluation, name: str, where: str) -> Calibration:
    (found,) = (each for each in evaluation.calibration if (each.name, each.where) == (name, where))
    return found


@pytest.mark.slow
def test_a_late_camera_within_tolerance_is_said_and_corrected(slightly_late: JudgedEvaluation) -> None:
    assert np.abs(off(slightly_late)).max() < 4.0
    for where in ("base", "markers"):
        clock = of(slightly_late, "clock", where)
        assert clock.estimate == pytest.approx(1e-4, abs=4.0 * clock.std)
        assert clock.std < 2e-5
        assert not clock.beyond
        assert str(clock).endswith("µs late")


@pytest.mark.slow
def test_a_camera_milliseconds_late_is_said_and_corrected(very_late: Estimator) -> None:
    """Rows that are linear about no lateness at all say 2.2 ms."""
    evaluation = JudgedEvaluation(statistics_of(very_late))
    assert np.abs(off(evaluation)).max() < 4.0
    for where in ("base", "markers"):
        clock = of(evaluation, "clock", where)
        assert clock.estimate == pytest.approx(4e-3, abs=4.0 * clock.std)
        assert clock.std < 2e-5


@pytest.mark.slow
def test_a_tracked_point_millimetres_off_is_corrected(exact: Block) -> None:
    """By 5 mm along both axes."""
    theta, x, y = (exact.values[:, exact.channels.index(name)] for name in ("theta_0", "r_S_x", "r_S_y"))
    by = 5e-3 * np.array([np.cos(theta) - np.sin(theta), np.sin(theta) + np.cos(theta)])
    evaluation = evaluated(exact, {"r_S_x": x + by[0], "r_S_y": y + by[1]})
    assert np.abs(off(evaluation)).max() < 4.0
    found = [each for each in evaluation.calibration if each.name == "tracked_point"]
    assert len(found) == 2
    for each in found:
        assert each.estimate == pytest.approx(5e-3, abs=4.0 * each.std)


@pytest.mark.long
def test_a_saved_session_goes_on_where_rows_are_linear(exact: Block, very_late: Estimator) -> None:
    """Restored after its rows were made anew and while more of them may be."""
    block = noisy(exact, late(exact, 4e-3))
    session = Session(very_late.system, block.channels)
    for piece in block.pieces(2500):
        session.update(piece)
        if session.estimator.samples > 4000:
            session = Session.restore(session.save())
    session.finish()
    np.testing.assert_array_equal(session.estimator.estimate().joint, very_late.estimate().joint)


@pytest.mark.slow
def test_noise_determines_no_unit_of_length(exact: Block) -> None:
    """Lengths, scale of the camera and masses together: only tolerances say anything of these."""
    stds = [
        [of(evaluation, "camera_scale", "base and markers").std, of(evaluation, "length", "link_1").std]
        for evaluation in (evaluated(exact, seed=seed) for seed in (3, 4))
    ]
    np.testing.assert_allclose(stds[0], stds[1], rtol=0.05)


@pytest.mark.slow
def test_a_change_beside_a_clock_that_may_have_moved_is_in_doubt(slightly_late: JudgedEvaluation) -> None:
    statistics = slightly_late.statistics
    change = Event(4.0, "payload", ("payload.mass",), ("kg",), (1.0,), (0.1,), 0)
    steady, changed = (JudgedEvaluation(replace(statistics, events=events)).trust for events in ((), (change,)))
    assert not any("tolerances" in reason for reason in steady.reasons)
    assert any("late: 2 tolerances" in reason for reason in changed.reasons)


@pytest.mark.slow
def test_a_camera_later_than_its_tolerance_is_not_trusted(exact: Block) -> None:
    """Five seconds of it."""
    whole = noisy(exact, late(exact, 5e-4))
    evaluation = JudgedEvaluation(statistics_of(estimated(next(iter(whole.pieces(5001))))))
    assert evaluation.trust.level == "doubt"
    assert any("late: " in reason and "tolerances" in reason for reason in evaluation.trust.reasons)
    assert any("latency" in warning for warning in evaluation.trust.warnings)


@pytest.mark.parametrize(
    ("name", "where", "part", "unit", "estimate", "std", "sentence"),
    [
        ("clock", "markers", "", "s", 4.8e-5, 1e-6, "markers 48.0 ± 1.0 µs late"),
        ("clock", "base", "", "s", -4e-3, 1e-5, "base 4.000 ± 0.010 ms early"),
        ("tracked_point", "base", "x", "m", -9e-4, 2e-4, "base: tracked point (x) -900 ± 200 µm off"),
        (
            "drive_gain",
            "joint_2",
            "against joint_1",
            "",
            1e-3,
            4e-5,
            "joint_2: gain of the torque (against joint_1) 0.1000 ± 0.0040 % off",
        ),
        (
            "gauge_low_pass",
            "gauges",
            "",
            "s²",
            -2.94e-5,
            6.3e-6,
            "gauges lead what bends them: low-pass -29.4 ± 6.3 ms² off",
        ),
    ],
)
def test_calibration_is_said_in_units_of_the_workshop(
    name: str, where: str, part: str, unit: str, estimate: float, std: float, sentence: str
) -> None:
    assert str(Calibration(name, where, part, unit, estimate, std, None)) == sentence


def test_what_no_sensor_does_is_not_to_be_tolerated() -> None:
    leading = Calibration("gauge_low_pass", "gauges", "", "s²", -3e-5, 1e-6, 2.5e-6)
    wide, usual = (Calibration("once_per_turn", "q_1", "sine", "rad", by, 1e-5, 5e-5) for by in (3e-3, 3e-4))
    assert not any("larger tolerances" in each.advice for each in (leading, wide))
    assert "larger tolerances" in usual.advice


def test_tolerances_none_says_that_all_is_exact() -> None:
    text = shipped_text("paper-planar")
    assert parse_system('tolerances = "none"\n' + text, "test").tolerances == EXACTLY
    assert parse_system(text + "\n[tolerances]\nclock = 1e-3\n", "test").tolerances.clock == 1e-3
    with pytest.raises(InputError, match=r"tolerances\.clok"):
        parse_system(text + "\n[tolerances]\nclok = 1e-3\n", "test")
    with pytest.raises(InputError, match=r"tolerances.*'nothing'"):
        parse_system('tolerances = "nothing"\n' + text, "test")
