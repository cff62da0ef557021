"""Forgetting: what fades and what does not, how a change is followed, and that nothing winds up meanwhile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sms_online.stream import Array
from sms_online.trackers import (
    Directional,
    Exponential,
    Forgetting,
    NoForgetting,
    Prior,
    RecursiveLeastSquares,
    Rows,
    SlidingWindow,
)
from sms_online.trackers.memory import BLOCK_ROWS
from tests.batch_solution import batch_least_squares
from tests.tracker_rows import (
    ALL_FORGETTING,
    PI_TRUE,
    TRACKERS,
    N,
    exciting_rows,
    ill_conditioned_rows,
    kalman,
    rows_of,
)


def test_exponential_forgetting_has_geometric_weights() -> None:
    rows, _ = ill_conditioned_rows(seed=18, count=3000, n=8, condition=1e4)
    tracker = RecursiveLeastSquares(8, Exponential(0.998))
    tracker.update(rows)
    weight = 0.998 ** (0.5 * np.arange(2999, -1, -1))
    expected = batch_least_squares(rows.Y, rows.b, rows.std / weight)
    estimate = tracker.estimate()
    np.testing.assert_allclose(estimate.pi, expected.pi, rtol=1e-8)
    np.testing.assert_allclose(estimate.covariance, expected.covariance, rtol=1e-6)
    np.testing.assert_allclose(estimate.rss, expected.rss, rtol=1e-6)
    np.testing.assert_allclose(estimate.rows, (weight**2).sum(), rtol=1e-12)


@pytest.mark.parametrize("count", [500, 1024, 5003])
def test_sliding_window_equals_lstsq_over_its_last_rows(count: int) -> None:
    rows, _ = ill_conditioned_rows(seed=19, count=count, n=8, condition=1e4)
    tracker = RecursiveLeastSquares(8, SlidingWindow(1024))
    tracker.update(rows)
    estimate = tracker.estimate()
    last = int(estimate.rows)
    assert min(count, 1024) <= last < 1024 + BLOCK_ROWS
    expected = batch_least_squares(rows.Y[-last:], rows.b[-last:], rows.std[-last:])
    np.testing.assert_allclose(estimate.pi, expected.pi, rtol=1e-8)
    np.testing.assert_allclose(estimate.covariance, expected.covariance, rtol=1e-6)


@pytest.mark.parametrize("name", ["Exponential", "SlidingWindow", "Directional", "KalmanTracker"])
def test_forgetting_follows_a_change_of_the_parameters(name: str) -> None:
    tracker = TRACKERS[name]()
    tracker.update(exciting_rows(seed=20, count=3000))
    changed = PI_TRUE * 1.2
    later = exciting_rows(seed=21, count=12_000 if name != "KalmanTracker" else 3000, pi=changed)
    tracker.update(Rows(later.Y, later.b, later.std, later.t + 3.0))
    estimate = tracker.estimate()
    assert (np.abs(estimate.pi - changed) < 5 * estimate.std).all()
    # A five-sigma bar much wider than the change would prove nothing.
    assert (5 * estimate.std < 0.2 * np.abs(PI_TRUE)).sum() >= N - 1


def test_directional_forgetting_keeps_what_is_no_longer_excited() -> None:
    tracker = RecursiveLeastSquares(N, Directional(0.99))
    tracker.update(exciting_rows(seed=22, count=2048))
    before = tracker.estimate()
    rng = np.random.default_rng(23)
    Y = np.zeros((20_000, N))
    Y[:, :2] = rng.normal(size=(20_000, 2))
    changed = PI_TRUE + np.array([0.1, 0.1, 0.0, 0.0, 0.0, 0.0])
    tracker.update(rows_of(Y, Y @ changed + 0.1 * rng.normal(size=20_000), 0.1))
    after = tracker.estimate()
    assert (np.abs(after.pi[:2] - changed[:2]) < 5 * after.std[:2]).all()
    # The change (ten sigma) shifts the others through their correlation, within their error bars.
    assert (np.abs(after.pi[2:] - PI_TRUE[2:]) < 5 * before.std[2:]).all()
    assert (after.std[2:] < 1.2 * before.std[2:]).all()


def check_no_wind_up(kind: Forgetting, count: int, quiet: Callable[[np.random.Generator, int], Array]) -> None:
    """Excitation, then `count` rows without, then excitation again with other parameters."""
    tracker = RecursiveLeastSquares(N, kind)
    rng = np.random.default_rng(24)
    tracker.update(exciting_rows(seed=25, count=2000))
    best_std = tracker.estimate().std
    chunk = 100_000
    for _ in range(count // chunk):
        Y = quiet(rng, chunk)
        tracker.update(rows_of(Y, Y @ PI_TRUE + 0.1 * rng.normal(size=chunk), 0.1))
        estimate = tracker.estimate()
        assert np.isfinite(estimate.pi).all()
        # Undetermined parameters have an honest infinite std, and no others.
        assert np.isfinite(estimate.std[estimate.determined]).all()
        assert np.isinf(estimate.std[~estimate.determined]).all()
        assert np.isfinite(estimate.rss)
        if not isinstance(kind, SlidingWindow):
            assert estimate.determined.all()
            assert (estimate.std <= 2e6 * best_std).all()
    pi = PI_TRUE if isinstance(kind, NoForgetting) else -PI_TRUE
    tracker.update(exciting_rows(seed=26, count=20_000, pi=pi))
    again = tracker.estimate()
    assert (np.abs(again.pi - pi) < 5 * again.std).all()
    assert (again.std <= 1.5 * best_std).all()


QUIET: dict[str, Callable[[np.random.Generator, int], Array]] = {
    "zero": lambda rng, count: np.zeros((count, N)),
    "constant": lambda rng, count: np.tile([1.0, 2.0, 3.0, 0.0, 0.0, 1e-3], (count, 1)),
}
SELECTED = [NoForgetting(), Exponential(0.999), SlidingWindow(2000), Directional(0.999)]


@pytest.mark.parametrize("quiet", QUIET)
@pytest.mark.parametrize("kind", SELECTED, ids=lambda kind: type(kind).__name__)
def test_no_wind_up_without_excitation(kind: Forgetting, quiet: str) -> None:
    check_no_wind_up(kind, 100_000, QUIET[quiet])


@pytest.mark.long
@pytest.mark.parametrize("quiet", QUIET)
@pytest.mark.parametrize("kind", SELECTED, ids=lambda kind: type(kind).__name__)
def test_no_wind_up_in_a_million_rows_without_excitation(kind: Forgetting, quiet: str) -> None:
    """A weight of 0.999 a row is 5e-435 of itself by then, less than the smallest number above zero."""
    check_no_wind_up(kind, 1_000_000, QUIET[quiet])


def test_directional_forgetting_keeps_unexcited_error_bars() -> None:
    tracker = RecursiveLeastSquares(N, Directional(0.99))
    tracker.update(exciting_rows(seed=27, count=2048))
    before = tracker.estimate()
    tracker.update(rows_of(np.zeros((100_000, N)), np.zeros(100_000)))
    after = tracker.estimate()
    np.testing.assert_allclose(after.pi, before.pi, rtol=1e-12)
    np.testing.assert_allclose(after.std, before.std, rtol=1e-12)


def test_the_walk_of_a_kalman_tracker_stops_at_its_initial_std() -> None:
    tracker = kalman(initial_std=3.0, process_std=1.0)
    tracker.update(exciting_rows(seed=28, count=300))
    assert tracker.estimate().determined.all()
    quiet = Rows(np.zeros((2000, N)), np.zeros(2000), np.ones(2000), 1.0 + 10.0 * np.arange(2000, dtype=np.float64))
    tracker.update(quiet)
    lost = tracker.estimate()
    assert not lost.determined.any()
    np.testing.assert_allclose(np.diag(tracker.state.P), 1.0, rtol=1e-12)
    again = exciting_rows(seed=29, count=300, pi=-PI_TRUE)
    tracker.update(Rows(again.Y, again.b, again.std, again.t + 30_000.0))
    estimate = tracker.estimate()
    assert (np.abs(estimate.pi + PI_TRUE) < 5 * estimate.std).all()


@pytest.mark.parametrize("kind", ALL_FORGETTING, ids=lambda kind: type(kind).__name__)
def test_a_prior_decides_without_rows_and_never_ages(kind: Forgetting) -> None:
    value, std = np.full(N, np.nan), np.full(N, np.nan)
    value[5], std[5] = 1.6, 0.2
    tracker = RecursiveLeastSquares(N, kind, Prior(value, std))
    rng = np.random.default_rng(31)
    Y = rng.normal(size=(20_000, N))
    Y[:, 4:] = 0.0
    tracker.update(rows_of(Y, Y @ PI_TRUE + 0.1 * rng.normal(size=20_000), 0.1))
    estimate = tracker.estimate()
    np.testing.assert_allclose([estimate.pi[5], estimate.std[5]], [1.6, 0.2], rtol=1e-9)
    assert list(estimate.determined) == [True, True, True, True, False, True]


@pytest.mark.parametrize("factor", [0.0, 1.0, 1.5, np.nan])
def test_forgetting_out_of_range_is_refused(factor: float) -> None:
    with pytest.raises(ValueError, match="forgetting factor"):
        Exponential(factor)
    with pytest.raises(ValueError, match="forgetting factor"):
        Directional(factor)
    with pytest.raises(ValueError, match="window"):
        SlidingWindow(0)
