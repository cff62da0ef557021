"""The times of samples: every device has its own clock, and delays that scatter."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from sms_adapters.clock_lanes import lanes, merger
from sms_adapters.clock_line import LARGEST_DRIFT, DeviceClock, likely_line
from sms_adapters.clock_merge import Merger
from sms_adapters.clock_samples import CountedTime, NumberedTime
from sms_adapters.recording import tick_time
from sms_online.sample_faults import StuckGuard
from sms_online.stream import Array
from tests.bus_streams import AxisBus, axis_testbed, estimated, merged, ticks

TICK = 0.02
LATENCY, JITTER = 0.004, 0.002


def corrected(clock: DeviceClock, device: Array, arrival: Array) -> Array:
    """Times of all samples, pushed by the tick."""
    edges = np.searchsorted(arrival, np.arange(0.0, arrival[-1] + 2 * TICK, TICK))
    parts = [clock.push(device[a:b], arrival[a:b]) for a, b in pairwise(edges)]
    return np.concatenate([*parts, clock.finish()])


def pairs(rate: float, seconds: float, drift: float, offset: float, seed: int) -> tuple[Array, Array, Array]:
    """Instants, device times and arrivals of samples whose transport keeps their order."""
    random = np.random.default_rng(seed)
    t = 1.0 + np.arange(round(rate * seconds)) / rate
    device = (t - offset) / (1.0 + drift)
    return t, device, np.maximum.accumulate(t + LATENCY + random.uniform(0.0, JITTER, t.size))


@pytest.mark.parametrize("seed", range(3))
def test_two_devices_agree_within_30_microseconds_and_1_ppm(seed: int) -> None:
    errors, clocks = [], []
    for rate, drift, offset in ((1000.0, 0.0, 0.0), (240.0, 50e-6, 0.3)):
        t, device, arrival = pairs(rate, 60.0, drift, offset, seed)
        clocks.append(DeviceClock(LATENCY))
        times = corrected(clocks[-1], device, arrival)
        assert times.size == t.size
        after = t > 31.0
        errors.append(np.sqrt(np.mean((times - t)[after] ** 2)))
    assert np.hypot(*errors) < 30e-6
    assert abs((clocks[1].drift - 50e-6) - clocks[0].drift) < 1e-6
    # From the first line on, which a second of samples gives, and which is good to a tenth of a millisecond.
    assert clocks[1].gained - clocks[0].gained == pytest.approx(50e-6 * 59.0, abs=2e-4)


def test_no_sample_waits_longer_than_the_first_second() -> None:
    t, device, arrival = pairs(240.0, 10.0, 50e-6, 0.3, seed=1)
    clock = DeviceClock(LATENCY)
    given_out = 0
    for k in range(0, t.size, 5):
        given_out += clock.push(device[k : k + 5], arrival[k : k + 5]).size
        assert given_out == (0 if not clock.known else k + device[k : k + 5].size)
        assert clock.known == (t[k : k + 5][-1] >= 2.1) or 1.9 < t[k] < 2.1


@pytest.mark.parametrize("jump", [2.0, -2.0, 0.06])
def test_a_jump_of_the_devices_clock_is_found_and_bridged(jump: float) -> None:
    t, device, arrival = pairs(1000.0, 20.0, 50e-6, 0.3, seed=2)
    clock = DeviceClock(LATENCY)
    times = corrected(clock, device + np.where(t > 11.0, jump, 0.0), arrival)
    assert clock.counters.jumps == 1
    assert clock.last_jump == pytest.approx(jump, abs=1e-3)
    assert clock.gained == pytest.approx(50e-6 * 19.0 - jump, abs=1e-3)
    assert clock.counters.corrupt == 0
    np.testing.assert_allclose(times, t, rtol=0, atol=1e-4)


def test_jumps_that_come_in_one_piece_lose_and_invent_no_sample() -> None:
    """There and back within samples that are pushed together, as a loop with a backlog does."""
    clock = DeviceClock(LATENCY)
    t, device, arrival = pairs(1000.0, 8.0, 0.0, 0.0, seed=3)
    jumped = device + np.where((t > 5.0) & (t < 5.1), 2.0, 0.0)
    early = t < 4.5
    times = [clock.push(jumped[part], arrival[part]) for part in (early, ~early)]
    assert clock.counters.jumps == 2
    found = np.concatenate((*times, clock.finish()))
    # Those between the jumps, too few for a line of their own, have no time.
    np.testing.assert_array_equal(np.isnan(found), jumped != device)


@pytest.mark.parametrize("wrong", [1e6, -1e6, 5.0, -5.0, 0.2, -0.2])
def test_corrupt_stamps_are_dropped_and_move_nothing(wrong: float) -> None:
    t, device, arrival = pairs(200.0, 8.0, 20e-6, 0.1, seed=9)
    spoilt = np.sort(np.random.default_rng(9).choice(np.arange(400, t.size), 20, replace=False))
    device[spoilt] += wrong
    clock = DeviceClock(LATENCY)
    times = corrected(clock, device, arrival)
    assert np.flatnonzero(np.isnan(times)).tolist() == spoilt.tolist()
    assert (clock.counters.corrupt, clock.counters.jumps, clock.counters.steps) == (20, 0, 0)
    assert np.nanmax(np.abs(times - t)) < 1e-4


def test_a_stall_of_the_transport_moves_no_time() -> None:
    # Half a second in which nothing comes, then all at once.
    t, device, arrival = pairs(1000.0, 20.0, 0.0, 0.0, seed=3)
    stalled = np.where((arrival > 8.0) & (arrival < 8.5), 8.5, arrival)
    clock = DeviceClock(LATENCY)
    np.testing.assert_allclose(corrected(clock, device, stalled), t, rtol=0, atol=1e-4)
    assert (clock.counters.jumps, clock.counters.steps) == (0, 0)


def test_seconds_of_load_move_no_time() -> None:
    t, device, arrival = pairs(1000.0, 30.0, 50e-6, 0.3, seed=4)
    loaded = np.maximum.accumulate(arrival + np.where((t > 12.0) & (t < 16.0), 0.02, 0.0))
    clock = DeviceClock(LATENCY)
    np.testing.assert_allclose(corrected(clock, device, loaded), t, rtol=0, atol=1e-4)


def test_a_sender_that_paused_is_placed_again_in_two_seconds() -> None:
    t, device, arrival = pairs(1000.0, 30.0, 50e-6, 0.3, seed=10)
    t, arrival = (x + np.where(t > 11.0, 0.5, 0.0) for x in (t, arrival))
    clock = DeviceClock(LATENCY)
    times = corrected(clock, device, arrival)
    assert clock.counters.steps == 1
    after = t > 13.5
    np.testing.assert_allclose(times[after], t[after], rtol=0, atol=1e-4)


def test_a_backlog_that_is_worked_off_moves_no_time() -> None:
    # Half a second late, and for three seconds ever less.
    t, device, arrival = pairs(1000.0, 30.0, 50e-6, 0.3, seed=11)
    backlog = np.maximum(arrival, np.where(t > 11.0, 11.5 + (t - 11.0) * 5.0 / 6.0, 0.0))
    clock = DeviceClock(LATENCY)
    np.testing.assert_allclose(corrected(clock, device, np.maximum.accumulate(backlog)), t, rtol=0, atol=1e-4)


@pytest.mark.parametrize("longest", [2.0, 0.02])
def test_half_a_minute_of_load_moves_no_time(longest: float) -> None:
    # Nothing comes undelayed, and every quarter of a second has another delay.
    t, device, arrival = pairs(1000.0, 60.0, 20e-6, 0.3, seed=12)
    delay = longest * (0.1 + 0.9 * np.interp(t, t[::250], np.random.default_rng(12).uniform(size=t.size // 250)))
    loaded = np.maximum.accumulate(arrival + np.where((t > 21.0) & (t < 51.0), delay, 0.0))
    clock = DeviceClock(LATENCY)
    np.testing.assert_allclose(corrected(clock, device, loaded), t, rtol=0, atol=1e-4)
    assert (clock.counters.jumps, clock.counters.steps) == (0, 0)


def test_a_lasting_change_of_latency_is_followed_and_counted() -> None:
    t, device, arrival = pairs(240.0, 60.0, 0.0, 0.0, seed=5)
    later = np.maximum.accumulate(arrival + np.where(t > 21.0, 0.01, 0.0))
    clock = DeviceClock(LATENCY)
    times = corrected(clock, device, later)
    assert clock.counters.steps == 1
    np.testing.assert_allclose(times[t > 33.0], t[t > 33.0] + 0.01, rtol=0, atol=1e-4)


@given(st.lists(st.tuples(st.floats(1e-3, 1.0), st.floats(0.0, 2e-3)), min_size=1, max_size=60))
@settings(max_examples=100, deadline=None)
def test_the_line_is_below_all_points(steps: list[tuple[float, float]]) -> None:
    gaps, delays = np.array(steps).T
    x = np.cumsum(gaps)
    y = x * (1.0 + 30e-6) + delays
    slope, offset = likely_line(x, y)
    assert np.min(y - slope * x - offset) > -1e-12
    assert abs(slope - 1.0) <= LARGEST_DRIFT


def test_the_mean_line_predicts_better_than_the_closest_below() -> None:
    random = np.random.default_rng(12)
    errors = []
    for _ in range(200):
        drift, count = 3e-5 * random.standard_normal(), int(random.integers(4, 20))
        x = 0.25 * np.arange(count) + random.uniform(0.0, 0.25, count)
        y = (1.0 + drift) * x + random.exponential(1e-4, count)
        # The line below with the least sum of distances, as a linear program.
        columns = np.column_stack((x, np.ones(count)))
        closest = linprog(-columns.sum(axis=0), A_ub=columns, b_ub=y, bounds=[(None, None)] * 2).x
        errors.append(
            [np.dot(line, (x[-1] + 1.0, 1.0)) - (1.0 + drift) * (x[-1] + 1.0) for line in (likely_line(x, y), closest)]
        )
    # All devices are late by a constant alike, which moves nothing.
    likely, closest = np.std(errors, axis=0)
    assert likely < 0.6 * closest


@pytest.mark.parametrize("modulus", [256, 65536])
def test_a_count_gives_times_through_roll_overs_and_losses(modulus: int) -> None:
    random = np.random.default_rng(6)
    n = np.arange(200_000)
    arrival: Array = n * 1e-3 + random.uniform(0.0, 2e-3, n.size)
    kept = (random.uniform(size=n.size) > 0.1) & ~((n > 50_000) & (n < 51_000 + 2 * modulus))
    time = CountedTime(modulus, 1e-3)
    parts = np.array_split(np.flatnonzero(kept), 997)
    times = np.concatenate([time(n[part] % modulus, arrival[part]) for part in parts])
    np.testing.assert_array_equal(np.rint(times / 1e-3), n[kept] - n[kept][0])


def test_frames_that_overtake_each_other_keep_their_own_times() -> None:
    counts = np.array([254, 255, 1, 0, 2, 4, 3, 5])
    times = CountedTime(256, 0.5)(counts, np.linspace(0.0, 3.5, 8))
    assert times.tolist() == [0.0, 0.5, 1.5, 1.0, 2.0, 3.0, 2.5, 3.5]


def test_unmarked_samples_are_numbered_and_holes_counted() -> None:
    arrival = np.concatenate((np.arange(10) * 0.01, 1.0 + np.arange(10) * 0.01))
    times = NumberedTime(0.01)(arrival)
    assert np.rint(times / 0.01).tolist() == [*range(10), *range(100, 110)]


@pytest.mark.long
def test_pi_is_as_good_as_on_one_clock(tmp_path: Path) -> None:
    # Offset 0.3 s, drifts of 20 and -30 ppm (50 between the devices), delays up to 2 ms, against none of them.
    system = axis_testbed(tmp_path)
    std, error = [], []
    for bus in (
        AxisBus(seconds=30.0, seed=7, jitter=0.0),
        AxisBus(seconds=30.0, seed=7, drift=(2e-5, -3e-5), offset=0.3),
    ):
        merger, blocks = merged(system, tmp_path, bus.drive(), bus.encoder(system))
        assert merger.warnings == []
        pi, sigma = estimated(system, blocks, merger.channels)
        std.append(sigma)
        error.append(np.abs(pi - [0.3, 0.1]))
    assert (std[1] < 1.5 * std[0]).all()
    assert (error[1] < 4.0 * std[1]).all()


def test_rows_come_in_the_estimators_portions_and_none_late(tmp_path: Path) -> None:
    """Against a merger that decodes at every tick: what a portion lacks is known from the items that wait."""
    system = axis_testbed(tmp_path)
    bus = AxisBus(seconds=8.0)
    in_step, eager = merger(system, tmp_path), Merger(lanes(system, tmp_path))
    steps = in_step.steps
    assert steps is not None
    out: list[tuple[Array, Array]] = []  # times of the rows, and ticks at which they come
    portions = []
    for ours in (in_step, eager):
        t, came = [], []
        for k, items in enumerate(ticks(bus.drive(), bus.encoder(system)), start=1):
            block = ours.advance(tick_time(k), items)
            if block is not None:
                t.append(block.t)
                came.append(np.full(block.t.size, k))
        out.append((np.concatenate(t), np.concatenate(came)))
        portions.append(len(t))
    (t, came), (_, could) = out
    ends = t[0] + steps.first + steps.period * np.arange(round(2.0 / steps.period), round(6.0 / steps.period))
    rows = np.searchsorted(t, ends) - 1  # the last of each portion
    assert np.mean(came[rows] - could[rows]) < 0.2
    assert np.max(came[rows] - could[rows]) <= 1
    # A few are asked for in vain, for delays scatter.
    assert portions[0] < 1.5 * (t[-1] - t[0]) / steps.period < portions[1]


def test_a_stuck_sensor_is_noticed_but_no_coarse_encoder() -> None:
    random = np.random.default_rng(8)
    t = np.arange(4000) / 1000.0
    fine = np.sin(t) + 1e-4 * random.standard_normal(t.size)
    fine[2000:2500] = fine[2000]
    coarse = np.round(np.sin(3 * t) / 1e-3) * 1e-3
    values = np.column_stack((fine, coarse))
    guard = StuckGuard([(0, 1)])
    for k in range(0, t.size, 20):
        guard.blank(values[max(k - 20, 0) : k + 20], min(20, t.size - k))
    assert guard.blanked.tolist() == [499, 0]
    assert np.isnan(values[2001:2500, 0]).all()
    assert not np.isnan(values[2500:, 0]).any()


def test_an_axis_that_friction_stops_is_not_stuck() -> None:
    """A fine encoder stops from several counts there; stuck at full speed it stops from far more."""
    t = np.arange(8000) / 500.0
    speed = np.clip(20.0 * np.abs(np.sin(2.0 * t)) - 3.0, 0.0, 3.0) * np.sign(np.sin(2.0 * t))
    count = 2.0 * np.pi / 131072
    angle = np.round(np.cumsum(speed) / 500.0 / count) * count
    healthy, stuck = angle[:, None].copy(), angle[:, None].copy()
    begin = int(np.argmax(np.abs(speed[6000:7000]))) + 6000
    stuck[begin : begin + 200] = stuck[begin]
    for values in (healthy, stuck):
        guard = StuckGuard([(0,)])
        for k in range(0, t.size, 50):
            guard.blank(values[: k + 50], 50)
    assert np.isfinite(healthy).all()
    assert np.flatnonzero(np.isnan(stuck[:, 0])).tolist() == list(range(begin + 1, begin + 200))
