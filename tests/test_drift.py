"""Drifts that are learned: the filter is the dense solution, ramps are found and followed, and nothing else is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sms_online.pipeline.drift_line import DriftLine
from sms_online.stream import Array
from sms_online.trackers import Prior, RecursiveLeastSquares, Rows
from sms_online.trackers.drift import LearnedTrend
from sms_online.trackers.drift_filter import STEP
from sms_online.trackers.drift_search import Break
from tests.saved import resumed

N = 4
TRUE = np.array([3.0, -1.0, 2.0, 0.5])
RATE = 20.0  # rows/s
NOTHING = Prior(np.zeros(N), np.full(N, np.nan))


def steady(t: Array) -> Array:
    return np.zeros((t.size, N))


def learned(groups: tuple[tuple[int, ...], ...] = ((0,), (1,), (2,), (3,))) -> LearnedTrend:
    return LearnedTrend(N, groups, np.zeros(N), np.zeros(N), NOTHING)


def rows(duration: float, change: Callable[[Array], Array] = steady, seed: int = 0, noise: float = 0.1) -> Rows:
    """Instant rows of unit variance, of parameters that change from TRUE by `change` (t) (B, N)."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * RATE)) / RATE + 0.013
    Y = rng.normal(size=(t.size, N)) / noise
    b = np.sum(Y * (TRUE + change(t)), axis=1) + rng.normal(size=t.size)
    return Rows(Y, b, np.ones(t.size), t)


def only(column: int, values: Array) -> Array:
    out = np.zeros((values.size, N))
    out[:, column] = values
    return out


def part(whole: Rows, first: int, end: int) -> Rows:
    return Rows(whole.Y[first:end], whole.b[first:end], whole.std[first:end], whole.t[first:end])


def test_without_drift_it_is_least_squares_to_rounding() -> None:
    squares, trend = RecursiveLeastSquares(N), learned()
    given = rows(20.0)
    squares.update(given)
    trend.update(given)
    expected, found = squares.estimate(), trend.estimate()
    assert trend.found == ()
    np.testing.assert_allclose(found.pi, expected.pi, rtol=1e-10)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-8, atol=1e-12)
    assert found.rss == pytest.approx(expected.rss)


def test_motion_and_not_rest_ends_the_wait_for_a_drift() -> None:
    trend, given = learned(), rows(40.0)
    half = given.t.size // 2
    trend.update(part(given, 0, half))
    assert trend.patient
    for k in range(half, given.t.size):
        trend.state.moves = True
        trend.update(part(given, k, k + 1))
    assert not trend.patient


@pytest.mark.parametrize(("trend", "walk"), [(0.3, 0.0), (0.0, 0.2), (0.3, 0.2)])
def test_trends_and_walks_are_the_dense_solution(trend: float, walk: float) -> None:
    given, column = rows(6.0), 1
    tracker = LearnedTrend(N, (), only(column, np.array([trend]))[0], only(column, np.array([walk]))[0], NOTHING)
    tracker.update(given)
    # Unknowns: parameters and a rate at the first step, then each later step's jumps of rate and value.
    steps = np.floor(given.t / STEP).astype(int)
    later = int(steps[-1])
    design = np.zeros((given.t.size, N + 1 + 2 * later))
    design[:, :N] = given.Y
    design[:, N] = given.Y[:, column] * given.t
    for k in range(1, later + 1):
        since = np.maximum(given.t - k * STEP, 0.0)
        design[:, N + k] = given.Y[:, column] * since
        design[:, N + later + k] = given.Y[:, column] * (steps >= k)
    jumps = np.concatenate((np.full(later, trend), np.full(later, walk))) * np.sqrt(STEP)
    free = np.concatenate((np.ones(N), [float(trend > 0.0)], jumps))
    used = free > 0.0
    prior = np.zeros((jumps.size, design.shape[1]))
    prior[:, N + 1 :] = np.eye(jumps.size)
    A = np.concatenate((design * free, prior))[:, used]
    x, *_ = np.linalg.lstsq(A, np.concatenate((given.b, np.zeros(jumps.size))), rcond=None)
    to_now = np.eye(N, design.shape[1])
    to_now[column, N] = given.t[-1]
    to_now[column, N + 1 : N + 1 + later] = given.t[-1] - STEP * np.arange(1, later + 1)
    to_now[column, N + 1 + later :] = 1.0
    to_now = (to_now * free)[:, used]
    estimate = tracker.estimate()
    np.testing.assert_allclose(estimate.pi, to_now @ x, rtol=1e-9)
    np.testing.assert_allclose(estimate.covariance, to_now @ np.linalg.inv(A.T @ A) @ to_now.T, rtol=1e-7, atol=1e-10)


def test_a_ramp_is_found_and_followed_within_its_bars() -> None:
    tracker, given = learned(), rows(60.0, lambda t: only(2, 0.02 * np.maximum(t - 10.0, 0.0)))
    z, first = [], np.inf
    for k in range(0, given.t.size, 10):
        tracker.update(part(given, k, k + 10))
        now = given.t[min(k + 9, given.t.size - 1)]
        if tracker.found:
            first = min(first, now)
            estimate = tracker.estimate()
            z.append((estimate.pi[2] - TRUE[2] - 0.02 * (now - 10.0)) / estimate.std[2])
    assert [drift.column for drift in tracker.found] == [2]
    assert 10.0 < first < 25.0
    assert tracker.found[0].since == pytest.approx(10.0, abs=5.0)
    assert tracker.found[0].rate == pytest.approx(0.02, abs=4.0 * tracker.found[0].std)
    assert np.mean(np.abs(z) < 2.5) > 0.9


def test_a_rate_that_may_be_another_widens_its_own_bar() -> None:
    """Two seconds of a rate that may have ended are an error of two seconds times the rate."""
    tracker = learned()
    tracker.update(rows(20.0, lambda t: only(2, 0.5 * t)))
    sure, unsure = tracker.estimate_at(20.0), tracker.estimate_at(20.0, unsure=2.0)
    np.testing.assert_array_equal(unsure.pi, sure.pi)
    assert unsure.std[2] == pytest.approx(1.0, rel=0.1)
    others = [0, 1, 3]
    np.testing.assert_array_equal(unsure.std[others], sure.std[others])


def test_what_decays_is_followed_as_decaying() -> None:
    tracker, given = learned(), rows(60.0, lambda t: only(0, 3.0 * (np.exp(-t / 30.0) - 1.0)), noise=0.02)
    tracker.update(given)
    tracker.state.until = 60.0
    estimate = tracker.estimate()
    assert [drift.column for drift in tracker.found] == [0]
    assert tracker.state.moving[0].decay == pytest.approx(1.0 / 30.0, rel=0.5)
    assert estimate.pi[0] == pytest.approx(3.0 * np.exp(-2.0), abs=4.0 * estimate.std[0])
    assert tracker.found[0].rate == pytest.approx(-0.1 * np.exp(-2.0), rel=0.1)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_end_of_a_drift_is_seen_within_three_seconds(seed: int) -> None:
    """At the old rate the value would be off by 0.3 by then; its error bar is a tenth of that."""
    end, behind = 30.5, 33.5
    tracker, given = learned(), rows(45.0, lambda t: only(2, 0.1 * np.minimum(t, end)), seed)
    for span in ((0.0, behind), (behind, 45.0)):
        tracker.update(part(given, *(round(t * RATE) for t in span)))
        estimate = tracker.estimate()
        assert estimate.std[2] < 0.03
        assert estimate.pi[2] == pytest.approx(TRUE[2] + 0.1 * end, abs=4.0 * estimate.std[2])
    (drift,) = tracker.found
    assert drift.changed == pytest.approx(end, abs=1.0)
    assert drift.rate == pytest.approx(0.0, abs=4.0 * drift.std)
    assert drift.std < 0.01


@pytest.mark.slow
def test_changes_of_a_rate_are_kept_for_half_a_minute() -> None:
    """The rate turns every 12 s; what is no more looked back at is forgotten, but for the last turn."""
    tracker = learned()

    def turning(t: Array) -> Array:
        return only(2, np.asarray(np.interp(t % 24.0, [0.0, 12.0, 24.0], [3.6, 0.0, 3.6]), dtype=np.float64))

    tracker.update(rows(180.0, turning, noise=0.05))
    (moving,) = tracker.state.moving
    assert 1 <= len(moving.bends) <= 4
    assert min(moving.bends) > tracker.state.anchor.knot
    assert moving.changed == pytest.approx(168.0, abs=2.0)
    assert moving.remembered(10**6).changed == moving.changed


def test_an_alarm_behind_the_end_of_a_drift_is_of_that_end() -> None:
    """It was taken for a change of the rate before the alarm came, and is broken off there."""
    tracker, given = learned(), rows(40.0, lambda t: only(2, 0.5 * np.minimum(t, 20.5)), noise=0.05)
    tracker.update(part(given, 0, round(22.0 * RATE)))
    assert [each.bends != () for each in tracker.state.moving] == [True]
    change = tracker.break_between(21.0, 21.2, [part(given, k, k + 1) for k in range(430, 520)]).drift
    assert change is not None
    assert change.columns == (2,)
    assert change.rates[0] == pytest.approx(-0.5, abs=0.02)


def behind_alarm(change: Callable[[Array], Array], seed: int = 0) -> Break:
    """Whether 4.4 s of rows from an alarm at 20 s on are of a drift of column 1 that had begun before it."""
    tracker, given = learned(), rows(24.4, lambda t: only(1, change(t)), seed, noise=0.05)
    first = round(20.0 * RATE)
    tracker.update(part(given, 0, first))
    assert tracker.state.moving == []
    behind = [part(given, k, k + 1) for k in range(first, given.t.size)]
    assert tracker.break_between(18.0, 20.0, behind).drift is None
    return tracker.ramp_before(18.0, 20.0, behind)


def test_a_drift_may_begin_before_its_alarm() -> None:
    found = behind_alarm(lambda t: 0.02 * np.maximum(0.0, t - 17.0))
    assert found.drift is not None
    assert found.drift.columns == (1,)
    assert found.drift.since * STEP == pytest.approx(17.0, abs=1.5)
    assert found.drift.rates[0] == pytest.approx(0.02, abs=0.005)


@pytest.mark.parametrize("size", [0.02, 0.04, 0.1])
@pytest.mark.parametrize("at", [18.3, 18.9, 19.5])
def test_a_step_before_its_alarm_is_no_drift(at: float, size: float) -> None:
    """Wherever in a block of a second it is, so that no step of those that are tried is quite the one."""
    found = [behind_alarm(lambda t: size * (t > at), seed) for seed in range(4)]
    assert [each.drift for each in found] == [None] * 4
    assert size < 0.1 or found == [Break()] * 4


def test_a_step_is_no_drift() -> None:
    tracker = learned()
    tracker.update(rows(40.0, lambda t: only(1, 0.3 * (t > 20.0).astype(np.float64)), noise=0.02))
    assert tracker.found == ()


def test_what_moves_together_is_one_drift() -> None:
    tracker = learned(((0, 1), (2,), (3,)))
    tracker.update(rows(30.0, lambda t: np.outer(t, [0.02, -0.01, 0.0, 0.0])))
    assert sorted(drift.column for drift in tracker.found) == [0, 1]
    assert [each.columns for each in tracker.state.moving] == [(0, 1)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_ten_minutes_without_drift_move_nothing(seed: int) -> None:
    tracker = learned()
    tracker.update(rows(600.0, seed=seed))
    assert tracker.found == ()
    estimate = tracker.estimate()
    assert np.max(np.abs(estimate.pi - TRUE) / estimate.std) < 4.0
    assert len(tracker.state.blocks) <= 32


def test_no_drift_is_named_where_rows_leave_more() -> None:
    tracker = learned()
    tracker.state.quiet = False
    tracker.update(rows(30.0, lambda t: only(2, 0.02 * t)))
    assert tracker.found == ()


def test_drifts_do_not_depend_on_how_rows_come() -> None:
    given = rows(30.0, lambda t: only(2, 0.02 * t))
    whole, cut = learned(), learned()
    whole.update(given)
    for k in range(given.t.size):
        cut.update(part(given, k, k + 1))
        if k == given.t.size // 2:
            cut = resumed(learned(), cut)
    assert whole.found == cut.found != ()
    assert np.array_equal(whole.estimate().pi, cut.estimate().pi)
    assert np.array_equal(whole.estimate().covariance, cut.estimate().covariance)


def test_a_known_drift_goes_on_as_it_decays() -> None:
    line = DriftLine(np.array([1.0, 1.0]), np.array([2.0, 2.0]), np.array([0.1, 0.0]), 3.0, 4.0)
    later = line.at(8.0)
    np.testing.assert_allclose(later.moved, [1.0 + 20.0 * (1.0 - np.exp(-0.5)), 11.0])
    np.testing.assert_allclose(later.rate, [2.0 * np.exp(-0.5), 2.0])
    np.testing.assert_allclose(line.at(5.0).at(8.0).moved, later.moved)


def test_whitened_rows_are_free_of_a_drift_that_decays() -> None:
    """A row looks back for 2 s, a fifteenth of the time in which the rate decays: what is left is of third order."""
    line = DriftLine(np.array([1.0]), np.array([-2.0]), np.array([1.0 / 30.0]), 50.0, 51.0)
    rng = np.random.default_rng(0)
    back, weights = -np.arange(0.0, 2.0, 0.1), rng.normal(size=20)
    Y, path = rng.normal(size=20), np.array([line.at(50.0 + t).moved[0] for t in back])
    rows = np.array([[weights @ Y, weights @ (Y * path)]])
    ramp, bend = (np.array([[weights @ (Y * part)]]) for part in (back, 0.5 * back**2))
    straight, bent = (abs(float(line.removed(rows, ramp, each)[0, 1])) for each in (None, bend))
    third = 2.0 * (1.0 / 30.0) ** 2 * float(np.abs(weights * Y) @ np.abs(back) ** 3) / 6.0
    assert bent < third
    assert straight > 20.0 * bent
