"""Trackers: the recursive answer is the batch answer, bit for bit the same however rows arrive, and its bars hold."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import msgspec
import numpy as np
import pytest
from scipy.signal import lfilter

from sms_online.state import snapshot
from sms_online.stream import Array
from sms_online.trackers import (
    Directional,
    Exponential,
    Forgetting,
    Information,
    KalmanTracker,
    NoForgetting,
    Prior,
    RecursiveLeastSquares,
    Rows,
    SlidingWindow,
    Tracker,
)
from sms_online.trackers.memory import BLOCK_ROWS
from tests.batch_solution import batch_least_squares
from tests.saved import resumed
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


def split(rows: Rows, seed: int, longest: int) -> Iterator[Rows]:
    """The same rows in calls of random length, none included."""
    rng = np.random.default_rng(seed)
    start = 0
    while start < rows.b.size:
        part = slice(start, start + int(rng.integers(0, longest + 1)))
        yield Rows(rows.Y[part], rows.b[part], rows.std[part], rows.t[part])
        start = part.stop


def assert_same_bits(one: Tracker, other: Tracker) -> None:
    a, b = one.estimate(), other.estimate()
    assert np.array_equal(a.pi, b.pi)
    assert np.array_equal(a.covariance, b.covariance)
    assert (a.covariance_robust is None) == (b.covariance_robust is None)
    if a.covariance_robust is not None and b.covariance_robust is not None:
        assert np.array_equal(a.covariance_robust, b.covariance_robust)
    assert np.array_equal(a.determined, b.determined)
    assert (a.condition_number, a.rows, a.rss, a.dof) == (b.condition_number, b.rows, b.rss, b.dof)


@pytest.mark.parametrize("condition", [1e2, 1e5])
def test_recursive_equals_lstsq_on_ill_conditioned_columns(condition: float) -> None:
    rows, _ = ill_conditioned_rows(seed=1, count=5003, n=16, condition=condition)
    tracker = RecursiveLeastSquares(16)
    for part in split(rows, seed=2, longest=300):
        tracker.update(part)
    estimate = tracker.estimate()

    A, c = rows.Y / rows.std[:, None], rows.b / rows.std
    scale = np.linalg.norm(A, axis=0)
    expected, rss, _, s = np.linalg.lstsq(A / scale, c, rcond=None)
    np.testing.assert_allclose(estimate.pi, expected / scale, rtol=1e-8)
    np.testing.assert_allclose(estimate.rss, rss[0], rtol=1e-6)
    np.testing.assert_allclose(estimate.condition_number, s[0] / s[-1], rtol=1e-8)
    _, R = np.linalg.qr(A / scale)
    inverse = np.linalg.inv(R) / scale[:, None]
    np.testing.assert_allclose(estimate.std, np.linalg.norm(inverse, axis=1), rtol=1e-6)
    assert estimate.determined.all()
    assert (estimate.rows, estimate.dof) == (5003, 5003 - 16)


def test_batch_solution_is_lstsq_and_the_recursive_solution() -> None:
    rows, _ = ill_conditioned_rows(seed=3, count=700, n=16, condition=1e4)
    batch = batch_least_squares(rows.Y, rows.b, rows.std)
    tracker = RecursiveLeastSquares(16)
    tracker.update(rows)
    recursive = tracker.estimate()
    np.testing.assert_allclose(batch.pi, recursive.pi, rtol=1e-8)
    np.testing.assert_allclose(batch.covariance, recursive.covariance, rtol=1e-6)


def test_batch_without_std_scales_covariance_by_the_residual() -> None:
    rows = exciting_rows(seed=4, count=4000, noise=0.3)
    unweighted = batch_least_squares(rows.Y, rows.b)
    weighted = batch_least_squares(rows.Y, rows.b, rows.std)
    np.testing.assert_allclose(unweighted.pi, weighted.pi, rtol=1e-10)
    np.testing.assert_allclose(unweighted.std, weighted.std, rtol=0.05)


def test_an_exactly_determined_batch_has_no_error_bar() -> None:
    rows = exciting_rows(seed=5, count=N)
    assert np.isinf(batch_least_squares(rows.Y, rows.b).std).all()
    assert np.isfinite(batch_least_squares(rows.Y, rows.b, rows.std).std).all()


@pytest.mark.parametrize("name", TRACKERS)
def test_how_rows_are_split_never_changes_a_bit(name: str) -> None:
    rows = exciting_rows(seed=6, count=1501)
    whole = TRACKERS[name]()
    whole.update(rows)
    for seed, longest in ((7, 1), (8, 50), (9, 200), (10, 1500)):
        parts = TRACKERS[name]()
        for part in split(rows, seed, longest):
            parts.update(part)
            if longest > 100:
                parts.estimate()  # looking must not touch
        assert_same_bits(whole, parts)


def test_partition_changes_no_bit_while_clusters_merge() -> None:
    rng = np.random.default_rng(11)
    Y = rng.normal(size=(40_000, 2))
    rows = rows_of(Y, Y @ [1.0, 2.0] + rng.normal(size=40_000))
    whole, parts = RecursiveLeastSquares(2), RecursiveLeastSquares(2)
    whole.update(rows)
    for part in split(rows, seed=12, longest=999):
        parts.update(part)
    assert_same_bits(whole, parts)


@pytest.mark.parametrize("name", TRACKERS)
def test_a_restored_tracker_continues_bit_for_bit(name: str) -> None:
    rows = exciting_rows(seed=13, count=1777)
    first = Rows(rows.Y[:1000], rows.b[:1000], rows.std[:1000], rows.t[:1000])
    rest = Rows(rows.Y[1000:], rows.b[1000:], rows.std[1000:], rows.t[1000:])
    original = TRACKERS[name]()
    original.update(first)
    restored = resumed(TRACKERS[name](), original)
    assert_same_bits(original, restored)
    original.update(rest)
    restored.update(rest)
    assert_same_bits(original, restored)


@pytest.mark.parametrize("other", [Exponential(0.99), SlidingWindow(100)])
def test_the_state_of_another_kind_of_tracker_is_refused(other: Forgetting) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"missing required field|states of|no state"):
        resumed(RecursiveLeastSquares(N), RecursiveLeastSquares(N, other))


@pytest.mark.parametrize("name", TRACKERS)
def test_a_snapshot_stays_while_its_tracker_goes_on(name: str) -> None:
    tracker, alike = TRACKERS[name](), TRACKERS[name]()
    for each in (tracker, alike):
        each.update(exciting_rows(seed=14, count=1777))
    then = snapshot(tracker)
    tracker.update(exciting_rows(seed=30, count=1777))
    assert_same_bits(then, alike)


@pytest.mark.parametrize("name", TRACKERS)
def test_what_a_tracker_knows_takes_further_rows(name: str) -> None:
    """Its factor is upper triangular, as further rows need it."""
    tracker = TRACKERS[name]()
    tracker.update(exciting_rows(seed=31, count=640))
    assert not np.tril(tracker.information.factor, -1).any()


@pytest.mark.parametrize("name", TRACKERS)
def test_a_tracker_goes_on_from_what_others_know(name: str) -> None:
    """As when a session goes on with further parameters: what was known of the old ones is known to a new tracker."""
    rows = exciting_rows(seed=18, count=640)
    known = Information.none(N - 1).with_rows(rows.whitened(N)[:, 1:]).widened(1)
    tracker = TRACKERS[name]()
    tracker.update(exciting_rows(seed=19, count=100, pi=-PI_TRUE))
    tracker.begin(known)
    estimate, expected = tracker.estimate(), known.solution()
    assert list(estimate.determined) == [True] * (N - 1) + [False]
    np.testing.assert_allclose(estimate.pi[:-1], expected.pi[:-1], rtol=1e-4)
    np.testing.assert_allclose(estimate.std[:-1], np.sqrt(np.diag(expected.covariance()))[:-1], rtol=1e-4)
    assert estimate.rows == 640
    restored = resumed(TRACKERS[name](), tracker)
    later = exciting_rows(seed=20, count=320)
    for each in (tracker, restored):
        each.update(later)
    assert_same_bits(tracker, restored)
    assert tracker.estimate().determined.all()
    with pytest.raises(ValueError, match=f"information of {N - 1} parameters"):
        tracker.begin(Information.none(N - 1))


@pytest.mark.parametrize("build", [TRACKERS["NoForgetting"], partial(kalman, process_std=0.0)])
def test_rows_known_beforehand_count_like_rows_taken_in(build: Callable[[], Tracker]) -> None:
    before, after = exciting_rows(seed=21, count=96), exciting_rows(seed=22, count=64)
    begun, taken = build(), build()
    begun.begin(Information.none(N).with_rows(before.whitened(N)))
    taken.update(before)
    for each in (begun, taken):
        each.update(after)
    one, other = begun.estimate(), taken.estimate()
    np.testing.assert_allclose(one.pi, other.pi, rtol=1e-10)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(one.rss, other.rss, rtol=1e-9)
    assert (one.rows, one.dof) == (other.rows, other.dof)


def test_a_window_forgets_what_was_known_beforehand() -> None:
    tracker, fresh = (RecursiveLeastSquares(N, SlidingWindow(100)) for _ in range(2))
    tracker.begin(Information.none(N).with_rows(exciting_rows(seed=23, count=64, pi=-PI_TRUE).whitened(N)))
    later = exciting_rows(seed=24, count=200)
    for each in (tracker, fresh):
        each.update(later)
    assert_same_bits(tracker, fresh)


@pytest.mark.parametrize("name", TRACKERS)
def test_a_new_beginning_forgets_all_rows(name: str) -> None:
    tracker, fresh = TRACKERS[name](), TRACKERS[name]()
    rows = exciting_rows(seed=15, count=333)
    tracker.update(exciting_rows(seed=16, count=500, pi=-PI_TRUE))
    tracker.begin(Information.none(N))
    assert not tracker.estimate().determined.any()
    tracker.update(rows)
    fresh.update(rows)
    assert_same_bits(tracker, fresh)


def test_kalman_without_process_noise_is_rls_with_its_prior() -> None:
    rows, pi = ill_conditioned_rows(seed=30, count=400, n=5, condition=1e2)
    prior = Prior(0.5 * pi, np.abs(pi))
    rls = RecursiveLeastSquares(5, prior=prior)
    kalman_tracker = KalmanTracker(5, np.zeros(5), prior)
    noisy = Rows(rows.Y, rows.b, 1e4 * rows.std, rows.t)  # so that the prior counts
    rls.update(noisy)
    kalman_tracker.update(noisy)
    one, other = rls.estimate(), kalman_tracker.estimate()
    np.testing.assert_allclose(other.pi, one.pi, rtol=1e-6)
    np.testing.assert_allclose(other.std[other.determined], one.std[other.determined], rtol=1e-6)
    np.testing.assert_allclose(other.condition_number, one.condition_number, rtol=1e-6)
    # The sum of squared normalised innovations is the least-squares minimum, prior included.
    np.testing.assert_allclose(other.rss, one.rss, rtol=1e-6)


def test_only_what_the_rows_cannot_separate_is_flagged() -> None:
    rng = np.random.default_rng(32)
    Y = rng.normal(size=(500, N)) * 10.0 ** np.linspace(-6, 6, N)
    Y[:, 3] = 1e5 * Y[:, 1]  # only π_1 + 1e5 π_3 acts
    Y[:, 4] = 0.0
    pi = PI_TRUE / 10.0 ** np.linspace(-6, 6, N)
    tracker = RecursiveLeastSquares(N)
    tracker.update(rows_of(Y, Y @ pi))
    estimate = tracker.estimate()
    assert list(estimate.determined) == [True, False, True, False, False, True]
    assert list(np.isinf(estimate.std)) == [False, True, False, True, True, False]
    determined = estimate.determined
    np.testing.assert_allclose(estimate.pi[determined], pi[determined], rtol=1e-9)
    np.testing.assert_allclose(estimate.pi[1] + 1e5 * estimate.pi[3], pi[1] + 1e5 * pi[3], rtol=1e-9)
    assert estimate.pi[4] == 0.0
    assert np.isinf(estimate.condition_number)
    # The pseudo-inverse's error bars equal those of the model without the surplus columns.
    reduced = batch_least_squares(Y[:, [0, 1, 2, 5]], Y @ pi, np.ones(500))
    np.testing.assert_allclose(estimate.std[[0, 2, 5]], reduced.std[[0, 2, 3]], rtol=1e-9)


def test_before_any_row_nothing_is_determined() -> None:
    for build in TRACKERS.values():
        estimate = build().estimate()
        assert not estimate.determined.any()
        assert np.isinf(estimate.std).all()
        assert np.array_equal(estimate.pi, np.zeros(N))
        assert (estimate.rows, estimate.rss, estimate.dof) == (0, 0, 0)


def test_wrong_rows_are_refused_by_number_and_leave_no_trace() -> None:
    good = exciting_rows(seed=33, count=10)
    for name in ("Y", "b", "std", "t"):
        arrays = {"Y": good.Y.copy(), "b": good.b.copy(), "std": good.std.copy(), "t": good.t.copy()}
        arrays[name][7] = np.nan
        with pytest.raises(ValueError, match=f"row 7: {name} is not finite"):
            Rows(**arrays)
    with pytest.raises(ValueError, match="row 3: std"):
        Rows(good.Y, good.b, np.where(np.arange(10) == 3, 0.0, good.std), good.t)
    with pytest.raises(ValueError, match="rows do not fit"):
        Rows(good.Y, good.b[:9], good.std, good.t)
    huge = Rows(np.full((2, N), 1e300), np.ones(2), np.array([1.0, 1e-20]), np.zeros(2))
    for build in TRACKERS.values():
        tracker, untouched = build(), build()
        for wrong in (Rows(good.Y[:, :4], good.b, good.std, good.t), huge):
            with pytest.raises(ValueError, match=r"row [01]"):
                tracker.update(wrong)
        tracker.update(good)
        untouched.update(good)
        assert_same_bits(tracker, untouched)


def autoregressive(rng: np.random.Generator, count: int, width: int, coefficient: float) -> Array:
    """Stationary AR(1) series of unit variance, (count, width)."""
    drive = rng.normal(size=(count, width)) * np.sqrt(1 - coefficient**2)
    drive[0] = rng.normal(size=width)
    return np.asarray(lfilter([1.0], [1.0, -coefficient], drive, axis=0))


@pytest.mark.long
@pytest.mark.parametrize("kind", [NoForgetting(), SlidingWindow(8192)], ids=lambda kind: type(kind).__name__)
def test_robust_intervals_cover_autocorrelated_errors(kind: Forgetting) -> None:
    rng = np.random.default_rng(34)
    pi = np.array([1.0, -2.0, 0.5])
    hits, classic_hits, intervals = 0, 0, 0
    for _ in range(250):
        Y = autoregressive(rng, 8192, 3, 0.9)
        b = Y @ pi + 0.1 * autoregressive(rng, 8192, 1, 0.9)[:, 0]
        tracker = RecursiveLeastSquares(3, kind)
        tracker.update(rows_of(Y, b, 0.1))
        estimate = tracker.estimate()
        error = np.abs(estimate.pi - pi)
        assert estimate.covariance_robust is not None
        hits += int((error < 1.96 * np.sqrt(np.diag(estimate.covariance_robust))).sum())
        classic_hits += int((error < 1.96 * estimate.std).sum())
        intervals += 3
    # 750 intervals: the coverage itself is known to ±0.8 %.
    assert 0.925 < hits / intervals < 0.975
    assert classic_hits / intervals < 0.6


def test_robust_covariance_equals_the_stated_one_of_white_rows() -> None:
    rng = np.random.default_rng(35)
    Y = rng.normal(size=(60_000, 4)) * [1e-6, 1.0, 1e3, 1e6]
    pi = np.array([1e6, 1.0, -1e-3, 2e-6])
    tracker = RecursiveLeastSquares(4)
    tracker.update(rows_of(Y, Y @ pi + 0.1 * rng.normal(size=60_000), 0.1))
    estimate = tracker.estimate()
    assert estimate.covariance_robust is not None
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance_robust)), estimate.std, rtol=0.2)


def test_robust_covariance_equals_its_formula_written_out() -> None:
    rng = np.random.default_rng(36)
    count = BLOCK_ROWS * 100
    Y = rng.normal(size=(count, 3)) + np.sin(np.arange(count) / 200.0)[:, None]
    b = Y @ [1.0, 2.0, 3.0] + autoregressive(rng, count, 1, 0.99)[:, 0]
    prior = Prior(np.array([0.9, 0.0, 0.0]), np.array([0.01, np.nan, np.nan]))
    tracker = RecursiveLeastSquares(3, prior=prior)
    tracker.update(rows_of(Y, b, 0.5))
    estimate = tracker.estimate()

    A, c = Y / 0.5, b / 0.5
    information = A.T @ A
    information[0, 0] += 1 / 0.01**2
    meat = np.zeros((3, 3))
    for cluster in np.split(np.arange(count), 100):
        score = A[cluster].T @ (c[cluster] - A[cluster] @ estimate.pi)
        meat += np.outer(score, score)
    meat *= 100 / 99 * (count - 1) / (count - 3)
    meat[0, 0] += 1 / 0.01**2
    inverse = np.linalg.inv(information)
    assert estimate.covariance_robust is not None
    np.testing.assert_allclose(estimate.covariance_robust, inverse @ meat @ inverse, rtol=1e-8)


def test_robust_covariance_needs_enough_unfaded_clusters() -> None:
    for kind in ALL_FORGETTING:
        tracker = RecursiveLeastSquares(N, kind)
        tracker.update(exciting_rows(seed=37, count=BLOCK_ROWS * N - 1))
        assert tracker.estimate().covariance_robust is None
        tracker.update(exciting_rows(seed=38, count=BLOCK_ROWS * N))
        assert (tracker.estimate().covariance_robust is None) == isinstance(kind, Exponential | Directional)
