"""A tracker that learns drifts: what it costs, and hours of it on a steady arm; run on demand:

pytest tests/bench/test_bench_drift.py --override-ini addopts= -s -k "cost or 1_hour"
"""

from __future__ import annotations

import resource
from collections.abc import Callable
from time import process_time
from unittest.mock import patch

import numpy as np
import pytest

import sms_online as sms
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.tracker_bank import TrackerBank
from sms_online.state import collect, encode
from sms_online.stream import Array
from sms_online.trackers import Prior, Rows
from sms_online.trackers.drift import LearnedTrend
from tests.exactly_known import exactly_known

LEARNED = "kalman:drift=learned"
# Of the arm's motion, s, and of the sessions whose cost is measured.
PERIOD, MEASURED = 60.0, 20.0
HOUR = 3600.0
# Largest error of a parameter, in standard deviations, of some hundred looks at sixteen.
LARGEST_ERROR = 5.0
# Of the process's peak memory after the first quarter of an hour, MB: pages that the allocator keeps.
LARGEST_GROWTH = 5.0


def seconds(tracker: str, data: sms.Capture) -> float:
    session = sms.Session(sms.load_system("paper-planar"), data.channels, tracker=tracker)
    begun = process_time()
    for block in data:
        session.update(block)
    session.finish()
    return process_time() - begun


def test_cost_of_learning_beside_filterpy() -> None:
    """Of a core at 1 kHz, more than least squares; and of a row of a filter of filterpy of as many parameters."""
    data = sms.simulate(sms.load_system("paper-planar"), duration=MEASURED, grade="B")
    for tracker in ("rls:forgetting=exponential,memory=5", "kalman", LEARNED):
        shares = [100.0 * (seconds(tracker, data) - seconds("rls", data)) / MEASURED for _ in range(3)]
        print(f"\n{tracker}: {np.median(shares):.2f} % of a core more than rls at 1 kHz")
    period = steady_rows(sms.load_system("paper-planar"), data)
    n, rows = period[0].Y.shape[1], sum(len(each.b) for each in period)
    for name, run in {"learned": learned(n), "filterpy": with_filterpy(n)}.items():
        begun = process_time()
        for each in period:
            run(each)
        print(f"{name}: {1e6 * (process_time() - begun) / rows:.1f} µs a row of {n} unknowns")


def learned(n: int) -> Callable[[Rows], None]:
    return steady_tracker(n, 16).update


def with_filterpy(n: int) -> Callable[[Rows], None]:
    from filterpy.kalman import KalmanFilter

    kf = KalmanFilter(dim_x=n, dim_z=1)

    def run(rows: Rows) -> None:
        for y, b in zip(rows.Y, rows.b, strict=True):
            kf.predict()
            kf.update(b, R=1.0, H=y[None])

    return run


def steady_rows(system: sms.System, data: sms.Capture) -> list[Rows]:
    """Whitened rows of a session, as its chosen trackers get them."""
    seen: list[Rows] = []
    update = TrackerBank.update

    def watched(bank: TrackerBank, rows: Rows, quiet: bool, moves: bool) -> None:
        seen.append(rows)
        update(bank, rows, quiet, moves)

    with patch.object(TrackerBank, "update", watched):
        sms.estimate(system, data, tracker=LEARNED)
    return seen


def steady_tracker(n: int, parameters: int) -> LearnedTrend:
    """Of n unknowns, the last of which are parameters that may drift."""
    nothing = np.zeros(n)
    groups = [(k,) for k in range(n - parameters, n)]
    known = Prior(np.zeros(n), np.where(np.arange(n) < n - parameters, 1e-2, np.nan))
    return LearnedTrend(n, groups, nothing, nothing, known)


@pytest.mark.parametrize("hours", [1, 8], ids=["1_hour", "8_hours"])
def test_hours_of_a_steady_arm(hours: int) -> None:
    """Rows of one period again and again, each time with noise of its own; the arm's parameters stay."""
    system = exactly_known(sms.load_system("paper-planar"))
    period = steady_rows(system, sms.simulate(system, duration=PERIOD, grade="B"))
    n, rng = period[0].Y.shape[1], np.random.default_rng(8)
    count = find_base_parameters(build_model(system)).n
    tracker = steady_tracker(n, count)
    sizes: list[int] = []
    peaks: list[float] = []  # MB
    stds: list[Array] = []
    begun, suspicions = process_time(), 0
    for lap in range(round(hours * HOUR / PERIOD)):
        for rows in period:
            b = rng.standard_normal(rows.b.size)  # of parameters zero, from which none may drift
            tracker.update(Rows(rows.Y, b, rows.std, rows.t + lap * PERIOD, rows.ramp))
        suspicions += tracker.state.suspected is not None
        estimate = tracker.estimate()
        error = np.abs(estimate.pi[-count:]) / estimate.std[-count:]
        assert error.max() < LARGEST_ERROR, f"lap {lap}: {error.max():.1f} standard deviations"
        if (lap + 1) % round(HOUR / PERIOD) == 0 or lap == round(0.25 * HOUR / PERIOD):
            sizes.append(len(encode(collect(tracker))))
            stds.append(estimate.std[-count:])
            peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
            print(f"\n{(lap + 1) * PERIOD / HOUR:.2f} h: state {sizes[-1]:,} bytes, peak {peaks[-1]:.1f} MB, ", end="")
            print(f"largest error {error.max():.1f} σ, {process_time() - begun:.0f} s of one core", flush=True)
    print(f"drifts found: {len(tracker.found)}, laps with a suspicion: {suspicions}")
    assert tracker.found == ()
    assert sizes[-1] < 1.1 * sizes[0]
    assert peaks[-1] < peaks[0] + LARGEST_GROWTH
    # Bars shrink with the root of time: none winds up.
    assert (stds[-1] < 1.05 * stds[0] / np.sqrt(hours / 0.27)).all()
