"""Rows of a whole session for its diagnosis, and the arithmetic of evidence."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_adapters.system_file import load_system
from sms_online.description.schema import Effect
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.constants import corrected, deviations, improved, possible
from sms_online.diagnosis.evidence import basis, free_of, gain, threshold
from sms_online.diagnosis.followed import FollowedMotion
from sms_online.diagnosis.online_search import LateColumns
from sms_online.diagnosis.record import SampleRecord, Segment, excerpts
from sms_online.diagnosis.residuals import RowResidual
from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.unexplained import describe_residual
from sms_online.diagnosis.weak_windows import WeakWindows, WindowPlaces
from sms_online.effects.build import build_model
from sms_online.model.effect import Inputs
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.momentum_windows import EXPONENT, HOPS, INSTANTS
from sms_online.row_types import row_types
from sms_online.stream import Array
from sms_online.trackers.factor import solve
from sms_sim.simulate import sampled_blocks, simulate
from tests.campaigns.blind import angle
from tests.evaluated import standard_deviation
from tests.exactly_known import exactly_known


@cache
def session() -> tuple[Estimator, SessionRows]:
    """Four seconds of the planar example at grade B (seed 2)."""
    system = exactly_known(load_system("paper-planar"))
    blocks = list(sampled_blocks(simulate(system, 4.0, position_tolerance=1e-8), "B", seed=2))
    estimator = Estimator(system, blocks[0].channels, "test")
    record = SampleRecord(system.sample_rate)
    estimator.observers.append(record)
    for block in blocks:
        estimator.push(block)
    estimator.finish()
    assert estimator.momentum is not None
    assert estimator.momentum.sensor_noise is not None
    noise, beta = estimator.momentum.sensor_noise, estimator.estimate().pi
    return estimator, SessionRows(estimator.model, estimator.base, estimator.sensing, noise, record.segments(), beta)


@pytest.mark.long
def test_columns_are_evaluated_as_the_balance_evaluates_them() -> None:
    """The parameters' own columns, through the windows of the diagnosis: to the rounding of sums."""
    _, rows = session()

    def model(motion: object) -> tuple[Array, Array]:
        inputs = Inputs(motion.torque, np.zeros((len(motion.x), 0)))  # type: ignore[attr-defined]
        return rows.model.momentum_columns(motion.x, motion.v, inputs=inputs)  # type: ignore[attr-defined]

    Y = rows.base.columns(rows.weak.columns(model))
    assert_allclose(Y, rows.Y, atol=1e-9 * np.abs(rows.Y).max())


@pytest.mark.slow
def test_whitened_rows_give_the_estimate_of_the_stream() -> None:
    """Their weights are those of the last estimate, the stream's of its time: half a deviation apart."""
    estimator, rows = session()
    found = solve(rows.white(np.concatenate((rows.Y, rows.b[..., None]), axis=2)))
    difference = (found.pi - estimator.estimate().pi) / standard_deviation(estimator)
    assert np.abs(difference).max() < 1.0
    assert np.sqrt(np.mean(difference**2)) < 0.5
    assert found.rss / (rows.b.size - rows.base.n) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(
    ("effect", "linear"),
    [
        (Effect(name="encoder_offset", where="q_1", coefficients={"offset": 1e-3}), 1e-3),
        (Effect(name="sensor_lag", where="theta_m_2", coefficients={"corner": 150.0}), np.sqrt(2.0) / (300.0 * np.pi)),
        (Effect(name="torque_delay", where="joint_2", coefficients={"time": 5e-4}), 5e-4),
        (Effect(name="actuator_delay", where="joint_*", coefficients={"time": 5e-4}), 5e-4),
    ],
)
@pytest.mark.slow
def test_a_channels_column_is_the_change_of_corrected_rows(effect: Effect, linear: float) -> None:
    """Residuals of rows from corrected samples against those of the session: first order, so to 3 %."""
    _, rows = session()
    system = rows.model.system.model_copy(update={"effects": (effect,)})
    parts = [corrected(system, rows.sensing.channels, segment) for segment in rows.segments]
    moved = SessionRows(rows.model, rows.base, rows.sensing, rows.noise, parts, rows.beta)
    inner = slice(5, -5)  # corrections begin at the record's ends
    change = ((moved.Y - rows.Y) @ rows.beta - (moved.b - rows.b))[inner]
    same = (moved.weak.windows.half_width == rows.weak.windows.half_width)[inner]
    column = CandidateColumns(rows, rows.model.system).of(effect.model_copy(update={"coefficients": {}})).columns
    expected = column[inner, :, 0] * linear
    scale = np.sqrt(np.mean(expected**2))
    assert np.sqrt(np.mean((change[same] - expected[same]) ** 2)) < 0.03 * scale


def test_internal_states_follow_a_motion_from_its_first_sample() -> None:
    """A liquid in a base that is pushed off with 0.1 m/s²: p - r_S = -a (1 - cos ω t) / ω².

    But for what the base moves in the four samples that the narrowest filter misses, 2.6e-3 of a / ω².
    """
    estimator, rows = session()
    effect = Effect(name="slosh", where="base", coefficients={"mass": 1.0, "stiffness": 324.0})
    model = build_model(rows.model.system.model_copy(update={"effects": (effect,)}))
    index = np.arange(4000, dtype=np.int64)
    t, a = index / 1000.0, 0.1
    values = np.zeros((t.size, len(estimator.sensing.channels)))
    values[:, estimator.sensing.position_columns[0]] = a * t**2 / 2.0
    followed = FollowedMotion(estimator.sensing, [Segment(index, values)], 1000.0)
    relative = followed.states(model, 0)[:, 0] - a * t**2 / 2.0
    seen = slice(10, -100)
    assert_allclose(relative[seen], -a * (1.0 - np.cos(18.0 * t[seen])) / 18.0**2, atol=4e-3 * a / 18.0**2)


def test_the_unexplained_acts_on_the_row_that_keeps_residual() -> None:
    """A substitute that cleared most of joint 2 and threw link 1 off, which had been near its noise."""
    _, rows = session()
    residual = np.random.default_rng(3).standard_normal(rows.b.shape)
    layout = rows.model.layout
    residual[:, layout.theta_m[1]] *= 3.0
    residual[:, layout.q_f[0]] *= 6.0
    before = {name: RowResidual(300.0 if name == "joint_2" else 1.5, 1.2) for name in row_types(layout)}
    found = describe_residual(rows, rows.Y, residual, before)
    assert (found.row, found.speed) == ("joint_2", "theta_m_2")
    level = {name: RowResidual(10.0, 1.2) for name in before}
    assert describe_residual(rows, rows.Y, residual, level).row == "link_1"


def test_a_residual_like_a_found_effect_belongs_to_its_row() -> None:
    """A gear's error, taken for a cogging of the motor alone, is left in the link's rows; another course is not."""
    _, rows = session()
    layout = rows.model.layout
    candidate = CandidateColumns(rows, rows.model.system).of(
        Effect(name="cogging", where="joint_1", coefficients={"order": 4.0})
    )
    columns = np.concatenate((rows.Y, candidate.columns), axis=2)
    course = candidate.columns[:, layout.theta_m[0]] @ [0.6, -0.8] / rows.std[:, layout.q[0]]
    random = np.random.default_rng(4)
    for force, more, row in (
        (course, "joint_1", "joint_1"),
        (random.permuted(course), "joint_1", "link_1"),
        (course, "link_1", "link_1"),
    ):
        residual = random.standard_normal(rows.b.shape)
        residual[:, layout.q[0]] += 20.0 * force / np.std(force)
        before = {name: RowResidual(20.0 if name == more else 10.0, 1.2) for name in row_types(layout)}
        found = describe_residual(rows, columns, residual, before)
        assert (found.row, found.speed) == (row, "q_1")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shape", "coefficients", "both"),
    [
        ("cogging", {"order": 18.0}, [80.0, 50.0], False),
        ("torque_ripple", {"order": 24.0}, [0.2, -0.1], False),
        ("kinematic_error", {"order": 4.0}, [30.0, 40.0], True),
        ("viscous_friction", {}, [20.0], False),
    ],
)
def test_noise_of_a_phase_is_predicted_to_first_order(
    name: str, shape: dict[str, float], coefficients: list[float], both: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against sixty draws of the sensors' noise: in all to 5 %, and single rows as a χ² of so many scatters."""
    _, rows = session()
    make = CandidateColumns(rows, rows.model.system)
    candidate = make.of(Effect(name=name, where="joint_1", coefficients=shape))
    predicted = make.unmodelled(candidate, np.array(coefficients)).own
    monkeypatch.setattr("sms_online.diagnosis.rows.NOISES", 60)
    drawn = [make.within(weak).of(candidate.effect).columns - candidate.columns for weak in rows.noisy()]
    acts = [rows.model.layout.q[0], rows.model.layout.theta_m[0]] if both else [rows.model.layout.theta_m[0]]
    ratio = np.mean(np.square(drawn @ np.array(coefficients)), axis=0)[:, acts] / predicted[:, acts]
    assert_allclose(np.mean(ratio, axis=0), 1.0, atol=0.05)
    assert np.all(np.std(ratio, axis=0) < 1.3 * np.sqrt(2.0 / 60.0))
    assert np.flatnonzero(predicted.any(axis=0)).tolist() == acts


@pytest.mark.slow
def test_a_model_is_made_once_for_all_noisy_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a session, and while one runs."""
    _, rows = session()
    built: list[int] = []
    real = build_model
    monkeypatch.setattr("sms_online.diagnosis.candidates.build_model", lambda system: built.append(1) or real(system))
    effect = Effect(name="viscous_friction", where="joint_1")
    for make in (CandidateColumns(rows, rows.model.system), LateColumns(rows, rows.model.system, 0)):
        built.clear()
        copies = [make.within(weak) for weak in rows.noisy()]
        for each in (make, *copies):
            each.of(effect)
        assert len(built) == 1
        assert all(type(copy) is type(make) for copy in copies)


def test_a_gain_is_what_least_squares_takes_off_the_residual() -> None:
    rng = np.random.default_rng(5)
    Y, Z = rng.normal(size=(200, 4)), rng.normal(size=(200, 2))
    b = Y @ rng.normal(size=4) + Z @ [0.3, -0.2] + rng.normal(size=200)
    Q = basis(Y)
    found = gain(Q, free_of(Q, b[:, None])[:, 0], Z)
    without, with_both = (np.linalg.lstsq(A, b)[1][0] for A in (Y, np.column_stack((Y, Z))))
    assert found.gain == pytest.approx(without - with_both)
    both = np.column_stack((Y, Z))
    assert_allclose(found.coefficients, np.linalg.lstsq(both, b)[0][4:])
    assert_allclose(found.covariance, np.linalg.inv(both.T @ both)[4:, 4:])


def test_a_column_that_the_model_has_gains_nothing() -> None:
    rng = np.random.default_rng(6)
    Y = rng.normal(size=(50, 3))
    Q = basis(Y)
    found = gain(Q, free_of(Q, rng.normal(size=(50, 1)))[:, 0], Y @ [[1.0], [2.0], [0.0]])
    assert (found.gain, found.seen) == (0.0, False)


def test_angles_are_those_beside_the_model() -> None:
    Q = np.eye(4)[:, :1]
    first, second = np.array([[5.0, 1.0, 0.0, 0.0]]).T, np.array([[-3.0, 1.0, 1.0, 0.0]]).T
    assert angle(Q, first, second) == pytest.approx(np.pi / 4)


def test_absent_candidates_pass_the_threshold_rarely_as_stated() -> None:
    """4000 draws of 20 candidates at 5 % (seed 7): 3.9 to 6.1 % pass, four standard deviations of the count."""
    rng = np.random.default_rng(7)
    best = (rng.normal(size=(4000, 20)) ** 2).max(axis=1)
    assert np.mean(best > threshold(0.05, 20, 1)) == pytest.approx(0.05, abs=0.014)


def test_excerpts_are_spread_evenly_and_keep_what_fits() -> None:
    segment = Segment(np.arange(1000), np.zeros((1000, 1)))
    assert excerpts([segment], 100, 1000) == [segment]
    parts = excerpts([segment], 100, 300)
    assert [part.index[0] for part in parts] == [0, 450, 900]
    assert all(part.index.size == 100 for part in parts)


def test_constants_are_improved_by_what_is_left_of_them() -> None:
    lag = improved(Effect(name="sensor_lag", where="q_1"), np.array([0.01]))
    assert improved(lag, np.array([0.002])).coefficients["corner"] == pytest.approx(np.sqrt(2.0) / (2 * np.pi * 0.012))
    late = improved(Effect(name="torque_delay", where="joint_1"), np.array([0.02]))
    assert improved(late, np.array([-0.004])).coefficients == {"time": pytest.approx(0.016)}
    assert not possible(improved(late, np.array([-0.03])), 1000.0)
    disc = improved(Effect(name="encoder_eccentricity", where="q_1"), np.array([3e-3, 0.0]))
    disc = improved(disc, np.array([0.0, 4e-3]))
    assert disc.coefficients["amplitude"] == pytest.approx(5e-3)
    assert np.sin(disc.coefficients["phase"]) == pytest.approx(0.8)
    # σ of the two parts is σ of the radius, and of the angle over it.
    stds = deviations(disc, np.diag([1e-8, 1e-8]))
    assert stds == {"amplitude": pytest.approx(1e-4), "phase": pytest.approx(0.02)}


@pytest.mark.parametrize("half_hop", [1, 3])
def test_rows_share_a_force_that_is_off_at_every_sample(half_hop: int) -> None:
    """Against sums over samples: windows of two segments, seen through filters of two widths."""
    width, rate = INSTANTS * half_hop, 100.0
    segment = np.array([0] * 14 + [1] * 5)
    start = np.concatenate([np.arange(count) * 2 * half_hop + 10 for count in (14, 5)])
    half_width = np.array([4, 4, 7, 7, 7, 4, 4, 4, 7, 7, 4, 4, 4, 4, 4, 4, 7, 7, 4])
    windows = WindowPlaces(segment, start, half_width, width, EXPONENT, lambda M: 1)
    sensing: Any = SimpleNamespace(coordinates=lambda values: values[:, :2], inputs=lambda values: values[:, 2:])
    layout: Any = SimpleNamespace(n_v=2, n_x=2, speeds=lambda x, x_dot: x_dot)
    samples = [Segment(np.arange(200), np.zeros((200, 3))) for _ in range(2)]
    squares = np.random.default_rng(1).random((2, 200, 2))
    weak = WeakWindows(windows, layout, sensing, samples, rate)
    found = weak.shared(np.sqrt(weak.squares(lambda m: squares[m.segment, m.samples])))
    phi = np.zeros((segment.size, 200))
    for row, first in zip(phi, start.tolist(), strict=True):
        row[first : first + width + 1] = (1.0 - np.linspace(-1.0, 1.0, width + 1) ** 2) ** EXPONENT / rate
    for k, lag in np.ndindex(segment.size, HOPS):
        same = lag <= k and segment[k - lag] == segment[k]
        expected = (phi[k] * phi[k - lag]) @ squares[segment[k]] if same else np.zeros(2)
        assert_allclose(found[k, lag], expected, rtol=0.0, atol=0.01 * np.sum(phi[k] ** 2))
