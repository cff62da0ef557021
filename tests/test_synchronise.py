"""Samples come onto one uniform grid: bits pass, holes are bridged or end a segment, and blocks do not matter."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from sms_online.description.parse import parse_system
from sms_online.pipeline.synchronise import GAP_LIMIT, GridSamples, Synchroniser
from sms_online.stream import Array, Block
from tests.axis import AXIS, axis_block
from tests.evaluated import results_document
from tests.sessions_of import session_of

RATE = 1000.0
CHANNELS = ("theta_m_1", "q_1", "link_1.marker_1.u_y")


def signal(t: Array) -> Array:
    """Three smooth channels, (B, 3); at most 4 Hz."""
    return np.column_stack([np.sin(2 * np.pi * f * t + f) for f in (1.0, 2.5, 4.0)])


def run(
    t: Array, values: Array, cuts: Iterable[int] = (), rate: float = RATE
) -> tuple[list[GridSamples], Synchroniser]:
    stage = Synchroniser(CHANNELS[: values.shape[1]], rate)
    pieces = []
    bounds = [0, *cuts, t.size]
    for a, b in pairwise(bounds):
        pieces += stage.push(Block(t[a:b], stage.channels, values[a:b]))
    return pieces + stage.flush(), stage


def joined(pieces: list[GridSamples]) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    """Index, values and segment number of every delivered grid point."""
    return (
        np.concatenate([p.index for p in pieces]),
        np.concatenate([p.values for p in pieces]),
        np.concatenate([np.full(p.index.size, p.segment) for p in pieces]),
    )


@pytest.mark.parametrize("start", [0.0, 12.345, 1.7e9])
def test_a_clean_capture_passes_bit_for_bit(start: float) -> None:
    t = start + np.arange(3000) / RATE
    values = np.random.default_rng(1).standard_normal((3000, 3))
    pieces, stage = run(t, values, cuts=(1, 5, 1700))
    index, out, segment = joined(pieces)
    assert np.array_equal(index, np.arange(3000))
    assert np.array_equal(out, values)
    assert not segment.any()
    assert stage.start_time == start
    assert msgspec.structs.asdict(stage.counters) == {
        "duplicates": 0,
        "interpolated_cells": 0,
        "gaps": 0,
        "lost_samples": 0,
    }


def test_finely_rounded_stamps_still_lie_on_the_grid() -> None:
    t = np.arange(1000) / RATE
    values = signal(t)
    _, out, _ = joined(run(t + np.tile([0.0, 16e-9, 32e-9, 8e-9], 250), values)[0])
    assert np.array_equal(out, values)


def test_lone_missing_samples_are_interpolated_and_counted() -> None:
    t = np.arange(2000) / RATE
    values = signal(t)
    values[100, 0] = values[700:702, 1] = values[1500] = np.nan
    pieces, stage = run(t, values)
    index, out, segment = joined(pieces)
    assert np.array_equal(index, np.arange(2000))
    assert not segment.any()
    assert stage.counters.interpolated_cells == 6
    # The error of degree 5 beside two lost samples is 144 / 720 of (2 pi f h)^6, 5e-11 at 4 Hz.
    np.testing.assert_allclose(out, signal(t), atol=1e-10, rtol=0)
    kept = ~np.isnan(values)
    assert np.array_equal(out[kept], values[kept])


def test_polynomials_of_degree_five_are_exact_despite_jitter() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(1000) / RATE
    t[1:] += rng.uniform(-3e-4, 3e-4, 999)
    coefficients = rng.standard_normal(6)

    def polynomial(s: Array) -> Array:
        return np.vander(s, 6) @ coefficients[:, None]

    pieces, stage = run(t, polynomial(t))
    index, out, _ = joined(pieces)
    np.testing.assert_allclose(out, polynomial(index / RATE), rtol=0, atol=1e-13 * np.abs(coefficients).sum())
    # Three samples on either side of every point: the first two points and the last few have none.
    assert index[0] == 2
    assert index[-1] in (996, 997)
    assert np.array_equal(np.diff(index), np.ones(index.size - 1))
    assert stage.counters.interpolated_cells == index.size


def test_a_channel_of_a_tenth_of_the_rate_is_interpolated() -> None:
    t = np.arange(2000) / RATE
    values = signal(t)
    slow = np.arange(2000) % 10 != 3
    values[slow, 0] = np.nan
    index, out, segment = joined(run(t, values)[0])
    # From the third slow sample (row 23) to just before the third from the end (row 1973).
    assert (index[0], index[-1]) == (23, 1972)
    assert not segment.any()
    np.testing.assert_allclose(out, signal(index / RATE), atol=1e-5)
    assert np.array_equal(out[:, 1:], values[index, 1:])


@pytest.mark.parametrize("lost", [GAP_LIMIT - 1, GAP_LIMIT])
def test_a_hole_beyond_the_gap_limit_ends_the_segment(lost: int) -> None:
    t = np.arange(2000) / RATE
    kept = np.ones(2000, dtype=bool)
    kept[1000 : 1000 + lost] = False
    pieces, stage = run(t[kept], signal(t[kept]))
    index, out, segment = joined(pieces)
    if lost < GAP_LIMIT:
        assert np.array_equal(index, np.arange(2000))
        assert not segment.any()
        assert stage.counters.interpolated_cells == 3 * lost
    else:
        assert np.array_equal(index, np.flatnonzero(kept))
        assert np.array_equal(segment, (index > 1000).astype(int))
        assert (stage.counters.gaps, stage.counters.lost_samples) == (1, lost)
    np.testing.assert_allclose(out, signal(index / RATE), atol=1e-8)


def test_a_hole_in_one_channel_ends_the_segment_of_all() -> None:
    t = np.arange(2000) / RATE
    values = signal(t)
    values[500:600, 1] = np.nan
    index, out, segment = joined(run(t, values)[0])
    assert np.array_equal(index, np.r_[0:500, 600:2000])
    assert np.array_equal(segment, (index >= 600).astype(int))
    assert np.array_equal(out, values[index])


def test_a_grid_point_needs_three_samples_on_either_side() -> None:
    """A missing sample next to a gap cannot be interpolated from both sides, so it is left out with its neighbours."""
    t = np.r_[0:1000, 1100:2000] / RATE
    values = signal(t)
    values[1001, 2] = np.nan
    index, _, segment = joined(run(t, values)[0])
    assert np.array_equal(index, np.r_[0:1000, 1102:2000])
    assert segment[-1] == 1


def test_a_clock_that_drifts_off_the_grid_starts_no_new_segment() -> None:
    t = np.linspace(0.0, 1999 * (1 + 4e-5) / RATE, 2000)
    index, out, segment = joined(run(t, signal(t), cuts=range(1, 50))[0])
    assert not segment.any()
    assert np.array_equal(index, np.arange(index[0], index[0] + index.size))
    np.testing.assert_allclose(out, signal(index / RATE), atol=1e-5)


def test_a_jump_of_the_clock_costs_no_memory() -> None:
    t = np.r_[0:1000, 10**12 : 10**12 + 1000] / RATE
    pieces, stage = run(t, signal(np.arange(2000) / RATE))
    index, _, segment = joined(pieces)
    assert index.size == 2000
    assert segment[-1] == 1
    assert stage.counters.lost_samples == 10**12 - 1000


def test_a_silent_channel_holds_nothing_back_for_ever() -> None:
    t = np.arange(50_000) / RATE
    values = signal(t)
    values[5000:, 0] = np.nan
    stage = Synchroniser(CHANNELS, RATE)
    delivered = 0
    for a in range(0, t.size, 500):
        delivered += sum(p.index.size for p in stage.push(Block(t[a : a + 500], CHANNELS, values[a : a + 500])))
        assert stage.state.time.size <= 2000
    assert delivered == 5000


def test_rows_of_sensors_at_one_instant_make_one_grid_point() -> None:
    """A CAN log has a row per frame, several with one stamp."""
    t = np.repeat(np.arange(1000) / RATE, 3)
    full = np.repeat(signal(np.arange(1000) / RATE), 3, axis=0)
    values = np.where(np.arange(3000)[:, None] % 3 == np.arange(3), full, np.nan)
    index, out, _ = joined(run(t, values, cuts=(1000, 1001, 2000))[0])
    assert np.array_equal(index, np.arange(1000))
    assert np.array_equal(out, signal(index / RATE))


def test_a_second_sample_at_an_instant_is_dropped_and_counted() -> None:
    t = np.insert(np.arange(1000) / RATE, 500, 499 / RATE)
    values = signal(t)
    values[500] = 1e6
    for cuts in ((), (500,)):
        pieces, stage = run(t, values, cuts)
        assert stage.counters.duplicates == 3
        assert np.array_equal(joined(pieces)[1], np.delete(values, 500, axis=0))


def test_dropped_samples_are_reported() -> None:
    block = axis_block(coulomb=0.0)
    t, values = (np.insert(part, 500, part[499], axis=0) for part in (block.t, block.values))
    session = session_of(parse_system(AXIS, "axis.toml"), [Block(t, block.channels, values)])
    said = "2 samples dropped: their channel had one at that instant already"
    assert said in results_document(session)["warnings"]


def untidy_capture(seed: int) -> tuple[Array, Array]:
    """Jittered stamps, a slow channel, lone losses, a gap, duplicates."""
    rng = np.random.default_rng(seed)
    t = np.arange(3000) / RATE
    t[600:1500] += rng.uniform(-2e-4, 2e-4, 900)
    keep = rng.random(3000) > 0.01
    keep[2000:2050] = False
    t = np.sort(np.r_[t[keep], t[700]])
    values = signal(t)
    values[np.arange(t.size) % 4 != 0, 2] = np.nan
    values[rng.random(values.shape) < 0.01] = np.nan
    return t, values


def test_a_hole_before_the_period_is_independent_of_blocks() -> None:
    """Seven samples of a slow channel, then everything is silent for longer than any period."""
    t = np.arange(400) / RATE
    t[80:] += 1.5
    t[2:60:7] += 1e-4
    values = signal(t)
    values[np.arange(400) % 11 != 0, 2] = np.nan
    reference = joined(run(t, values)[0])
    assert reference[0][0] == 22
    assert reference[2].max() == 1
    found = joined(run(t, values, range(1, 400))[0])
    assert all(np.array_equal(a, b) for a, b in zip(found, reference, strict=True))


@pytest.mark.parametrize("seed", [3, 4])
def test_blocks_do_not_change_a_bit(seed: int) -> None:
    t, values = untidy_capture(seed)
    rng = np.random.default_rng(seed + 100)
    pieces, whole = run(t, values)
    reference = joined(pieces)
    assert reference[0].size > 2000
    for cuts in (range(2, t.size, 3), np.sort(rng.integers(0, t.size, 40)).tolist(), range(64, t.size, 64)):
        pieces, stage = run(t, values, cuts)
        assert all(np.array_equal(a, b) for a, b in zip(joined(pieces), reference, strict=True))
        assert stage.counters == whole.counters


def test_blocks_of_other_channels_are_refused() -> None:
    with pytest.raises(ValueError, match="pushed into"):
        Synchroniser(CHANNELS, RATE).push(Block(np.zeros(1), ("q_1",), np.zeros((1, 1))))
