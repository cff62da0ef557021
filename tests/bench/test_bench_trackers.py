"""Cost of a row in each tracker, 16 parameters, beside filterpy, padasip and numpy; run on demand:

pytest tests/bench/test_bench_trackers.py --override-ini addopts= -s
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sms_online.trackers import (
    Directional,
    Exponential,
    KalmanTracker,
    NoForgetting,
    Prior,
    RecursiveLeastSquares,
    Rows,
    SlidingWindow,
    Tracker,
)

N = 16
ROWS = 50  # rows of one call, as the balances deliver them
CALLS = 20


def rows(count: int) -> Rows:
    rng = np.random.default_rng(1)
    Y = rng.normal(size=(count, N))
    return Rows(Y, Y @ np.arange(1.0, N + 1) + 0.1 * rng.normal(size=count), np.full(count, 0.1), np.zeros(count))


def run_filterpy() -> Callable[[Rows], None]:
    from filterpy.kalman import KalmanFilter

    kf = KalmanFilter(dim_x=N, dim_z=1)

    def run(block: Rows) -> None:
        for y, b in zip(block.Y, block.b, strict=True):
            kf.predict()
            kf.update(b, R=0.01, H=y[None])

    return run


def run_padasip() -> Callable[[Rows], None]:
    padasip = pytest.importorskip("padasip")
    rls = padasip.filters.FilterRLS(n=N, mu=0.999)

    def run(block: Rows) -> None:
        for y, b in zip(block.Y, block.b, strict=True):
            rls.adapt(b, y)

    return run


def run_lstsq() -> Callable[[Rows], None]:
    """A window of 1000 rows solved anew at each call of 50 rows."""
    window = rows(1000)

    def run(block: Rows) -> None:
        np.linalg.lstsq(window.Y, window.b, rcond=None)

    return run


def run_tracker(tracker: Tracker, estimate: bool = False) -> Callable[[Rows], None]:
    def run(block: Rows) -> None:
        tracker.update(block)
        if estimate:
            tracker.estimate()

    return run


CASES: dict[str, Callable[[], Callable[[Rows], None]]] = {
    "rls none": lambda: run_tracker(RecursiveLeastSquares(N, NoForgetting())),
    "rls none, estimate each call": lambda: run_tracker(RecursiveLeastSquares(N, NoForgetting()), estimate=True),
    "rls exponential": lambda: run_tracker(RecursiveLeastSquares(N, Exponential(0.999))),
    "rls window 1000": lambda: run_tracker(RecursiveLeastSquares(N, SlidingWindow(1000))),
    "rls window 1000, estimate each call": lambda: run_tracker(
        RecursiveLeastSquares(N, SlidingWindow(1000)), estimate=True
    ),
    "rls directional": lambda: run_tracker(RecursiveLeastSquares(N, Directional(0.999))),
    "kalman": lambda: run_tracker(KalmanTracker(N, np.full(N, 0.01), Prior(np.zeros(N), np.full(N, 10.0)))),
    "filterpy KalmanFilter": run_filterpy,
    "padasip FilterRLS": run_padasip,
    "numpy lstsq of 1000, each call": run_lstsq,
}


@pytest.mark.parametrize("case", CASES)
def test_cost_of_a_row(benchmark, case: str) -> None:  # type: ignore[no-untyped-def]
    run = CASES[case]()
    block = rows(ROWS)
    benchmark.pedantic(run, args=(block,), rounds=CALLS, iterations=5, warmup_rounds=2)
    if benchmark.stats is not None:
        print(f"\n{case}: {benchmark.stats.stats.median / ROWS * 1e6:.2f} µs a row")


def test_peer_winds_up_without_excitation_and_ours_does_not() -> None:
    padasip = pytest.importorskip("padasip")
    peer = padasip.filters.FilterRLS(n=N, mu=0.99)
    ours = RecursiveLeastSquares(N, Exponential(0.99))
    start = rows(1000)
    for y, b in zip(start.Y, start.b, strict=True):
        peer.adapt(b, y)
    ours.update(start)
    before = np.trace(peer.R), np.trace(ours.estimate().covariance)
    for _ in range(20_000):
        peer.adapt(0.0, np.zeros(N))
    ours.update(Rows(np.zeros((20_000, N)), np.zeros(20_000), np.ones(20_000), np.zeros(20_000)))
    after = np.trace(peer.R), np.trace(ours.estimate().covariance)
    print(f"\ntrace of the covariance, before and after: padasip {before[0]:.1e} {after[0]:.1e}, ", end="")
    print(f"ours {before[1]:.1e} {after[1]:.1e}")
    assert after[0] > 1e50 * before[0]
    # The floor: std at most 1e6 times the best.
    assert after[1] < 1e13 * before[1]
