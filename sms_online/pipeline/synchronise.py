"""Samples of many channels, each with its own instants, onto one uniform grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sms_online.grouping import sampled_together
from sms_online.pipeline.periods import LONGEST_HOLE, Periods
from sms_online.state import Stage, State
from sms_online.stream import Array, Block, Indices, Mask

# A sample this close to a grid point, in grid periods, lies on it. At 1 kHz that is 0.1 µs, in which 1 rad/s moves a
# hundredth of a good encoder's noise; measured captures round their stamps to 0.03 µs.
ON_GRID = 1e-4
# Nodes of an interpolation on either side: degree 5 errs by at most 1e-5 of an oscillation that is sampled 18 times a
# period.
SIDE = 3
# Longest interval between two samples of a channel that is bridged, in periods of the channel, rounded: four
# samples lost. White noise of the nodes then reaches the middle of the hole 2.8 times; beyond that the hole ends
# the segment.
GAP_LIMIT = 5
# Grid index of a row that lies on no grid point.
NOWHERE = -2


@dataclass(frozen=True)
class GridSamples:
    """B consecutive grid points of one gap-free segment.

    index: (B,) grid index k, time t0 + k / sample_rate. values: (B, C) SI units. segment: number of the segment,
    from 0.
    """

    index: Indices
    values: Array
    segment: int


class SyncCounters(State):
    """What happened to the samples so far.

    duplicates: samples dropped because their channel already had one at that instant. interpolated_cells: cells
    delivered by interpolation. gaps: breaks between segments. lost_samples: grid points from the first sample to the
    last delivered one (after the flush: to the last received) that were not delivered, in gaps or beside them, but for
    the pause before a resumption.
    """

    duplicates: int = 0
    interpolated_cells: int = 0
    gaps: int = 0
    lost_samples: int = 0


@dataclass(frozen=True)
class _Group:
    """Channels that were sampled at the same instants: `rows` of the buffer, at times `ts`.

    last: (K,) position in `ts` of the last sample not after each grid point, -1 before the first. hit: (K,) that
    sample lies on the grid point.
    """

    columns: Indices
    rows: Indices
    ts: Array
    last: Indices
    hit: Mask


class SynchroniserState(State):
    """What a synchroniser keeps.

    time (B,), values (B, C): rows that are still needed, time in s after t0. last_time (C,): of each channel's last
    sample. next: first grid point that is not decided yet; delivered: last one delivered.
    """

    time: Array
    values: Array
    last_time: Array
    counters: SyncCounters
    t0: float = np.nan
    next: int = 0
    delivered: int = -1


class Synchroniser(Stage):
    """Uniform grid t0 + k / sample_rate from the first sample's time t0, the same for every channel.

    A sample on a grid point passes bit for bit. Elsewhere a channel is interpolated from its own samples by the
    polynomial of degree 5 through the six nearest, three on each side. Off-centre or lower-degree interpolation at
    the borders of a segment would have another error and another noise there, unknown to whoever whitens the
    samples, so grid points without a full stencil are not delivered. Runs of three and more samples on neighbouring
    grid points pass up to the border, and what is interpolated beside them has its stencil in them.
    A segment is a run of grid points at which every channel has a value; a hole in any channel ends it. Whatever the
    blocks, the values are the same bits. Limitation: a channel faster than the grid is picked, not averaged.

    channels: names, in the order of the columns. sample_rate: of the grid, Hz.
    """

    def __init__(self, channels: Sequence[str], sample_rate: float) -> None:
        count = len(channels)
        self.channels = tuple(channels)
        self.sample_rate = sample_rate
        self._periods = Periods(count, GAP_LIMIT)
        self.resumed = np.nan  # time of the last sample before the session was resumed, s
        nothing = np.empty(0), np.empty((0, count))
        self.state = SynchroniserState(*nothing, np.full(count, -np.inf), SyncCounters())

    @property
    def last_time(self) -> Array:
        """Time of each channel's last sample (C,), s; -inf where there is none."""
        return np.asarray(self.state.last_time + np.nan_to_num(self.state.t0))

    @property
    def counters(self) -> SyncCounters:
        """What happened to the samples so far."""
        return self.state.counters

    @property
    def periods(self) -> Array:
        """Sample period of each channel (C,), s, from its first intervals; NaN while it is not known."""
        return self._periods.known.copy()

    @property
    def start_time(self) -> float:
        """t0, the time of grid index 0, s; NaN before the first sample."""
        return float(self.state.t0)

    def push(self, block: Block) -> list[GridSamples]:
        """Take a block, in order of time, and return the grid points that it completes, a piece for each segment.

        Raises ValueError when the block's channels are not those of the synchroniser.
        """
        if block.channels != self.channels:
            raise ValueError(f"block with channels {block.channels} pushed into a synchroniser of {self.channels}")
        if block.t.size == 0:
            return []
        if np.isnan(self.state.t0):
            self.state.t0 = float(block.t[0])
        time = block.t - self.state.t0
        if self._continues_complete(time, block.values):
            return self._pass(time, block.values)
        values = self._admit(time, block.values)
        self.state.time = np.concatenate([self.state.time, time])
        self.state.values = np.concatenate([self.state.values, values])
        return self._advance(final=False)

    def flush(self) -> list[GridSamples]:
        """End of the capture: return what can still be delivered."""
        if self.state.time.size == 0:
            return []
        pieces = self._advance(final=True)
        self.state.counters.lost_samples += self.state.next - 1 - self.state.delivered
        return pieces

    @property
    def _tolerance(self) -> float:
        """Distance within which two instants are one, s; epoch times are rounded to 0.2 µs."""
        return ON_GRID / self.sample_rate + 4.0 * float(np.spacing(abs(self.state.t0)))

    def _continues_complete(self, time: Array, values: Array) -> bool:
        """Whether everything before is delivered and every row lies on the next grid point with all its cells."""
        tail = self.state.values[-SIDE:]
        return (
            self.state.delivered == self.state.next - 1
            and tail.shape[0] == SIDE
            and self._on_consecutive_points(self.state.time[-SIDE:], self.state.next - SIDE)
            and not np.isnan(self._periods.known).any()
            and not np.isnan(tail).any()
            and not np.isnan(values).any()
            and self._on_consecutive_points(time, self.state.next)
        )

    def _on_consecutive_points(self, time: Array, first: int) -> bool:
        grid = np.arange(first, first + time.size) / self.sample_rate
        return bool(np.all(np.abs(time - grid) <= self._tolerance))

    def _pass(self, time: Array, values: Array) -> list[GridSamples]:
        """The common case of `_advance`, 0.03 instead of 0.8 µs a sample: each row is its own grid point."""
        k = np.arange(self.state.next, self.state.next + time.size, dtype=np.int64)
        self.state.last_time = np.full(len(self.channels), time[-1])
        self.state.next += time.size
        self.state.time = np.concatenate([self.state.time[-SIDE:], time[-SIDE:]])[-SIDE:]
        self.state.values = np.concatenate([self.state.values[-SIDE:], values[-SIDE:]])[-SIDE:]
        return self._deliver(k, values)

    def _admit(self, time: Array, values: Array) -> Array:
        """Drop duplicates (as NaN), and count them, and learn the period of each channel from its first intervals."""
        missing = np.isnan(values)
        before = self.state.time[-1] if self.state.time.size else -np.inf
        apart = np.diff(time, prepend=before) > self._tolerance
        # Only among rows at one instant, the last ones before this block included, can a channel have two samples.
        starts = np.flatnonzero(apart)
        twice = (~missing[: starts[0] if starts.size else None]).any(axis=0)
        if 0 < starts.size < time.size:
            twice |= np.add.reduceat(~missing, starts, axis=0, dtype=np.int64).max(axis=0) > 1
        judged = np.flatnonzero(twice | np.isnan(self._periods.known))
        if judged.size:
            values = values.copy()
            for channel in judged.tolist():
                rows = np.flatnonzero(~missing[:, channel])
                interval = np.diff(time[rows], prepend=self.state.last_time[channel])
                duplicate = interval <= self._tolerance
                self.state.counters.duplicates += int(np.count_nonzero(duplicate))
                values[rows[duplicate], channel] = np.nan
                self._periods.learn(channel, interval[~duplicate & np.isfinite(interval)])
        sampled = ~missing.all(axis=0)
        last_row = time.size - 1 - np.argmin(missing[::-1], axis=0)
        self.state.last_time = np.where(sampled, time[last_row], self.state.last_time)
        return values

    def _advance(self, final: bool) -> list[GridSamples]:
        """Decide grid points as far as the samples allow; deliver those that every channel has."""
        silent = self.state.time[-1] - self.state.last_time > LONGEST_HOLE
        for channel in np.flatnonzero(np.isnan(self._periods.known) & (silent | final)).tolist():
            self._periods.decide(channel)
        k = self._candidates()
        decided = np.ones(k.size, dtype=bool)
        complete = np.ones(k.size, dtype=bool)
        nearest = np.rint(self.state.time * self.sample_rate).astype(np.int64)
        on_grid = np.abs(self.state.time - nearest / self.sample_rate) <= self._tolerance
        row_index = np.where(on_grid, nearest, NOWHERE)
        groups = []
        periods = (period.tobytes() for period in self._periods.known)
        for columns, rows in sampled_together(self.state.values, periods):
            group, sure, possible = self._judge(k, columns, rows, row_index[rows], final)
            decided &= sure
            complete &= possible
            groups.append(group)
        end = k.size if decided.all() else int(np.argmin(decided))
        chosen = np.flatnonzero(complete[:end])
        values = self._fill(k[chosen], chosen, groups)
        if end:
            self.state.next = int(k[end - 1]) + 1
        self._forget(groups)
        return self._deliver(k[chosen], values)

    def _candidates(self) -> Indices:
        """Undecided grid points up to the latest row, leaving out those in holes of all channels together."""
        reach = self._tolerance
        hole = np.flatnonzero(np.diff(self.state.time) > LONGEST_HOLE)
        first = np.ceil((self.state.time[hole + 1] - reach) * self.sample_rate).astype(np.int64)
        last = np.floor((self.state.time[[*hole, -1]] + reach) * self.sample_rate).astype(np.int64)
        starts = np.maximum([self.state.next, *first], self.state.next)
        return np.concatenate([np.arange(a, b + 1, dtype=np.int64) for a, b in zip(starts, last, strict=True)])

    def _judge(
        self, k: Indices, columns: Indices, rows: Indices, row_index: Indices, final: bool
    ) -> tuple[_Group, Mask, Mask]:
        """Which grid points k of a group are decided, and which of those have a value."""
        ts, now = self.state.time[rows], self.state.time[-1]
        grid = k / self.sample_rate
        late = grid + self._tolerance
        last = np.searchsorted(ts, late, side="right") - 1
        if np.all(row_index == NOWHERE):  # as those of any device whose clock is not the grid's
            hit = passes = np.zeros(k.size, dtype=bool)
        else:
            padded = np.concatenate([[NOWHERE], row_index])
            hit = padded[last + 1] == k
            passes = hit & (_run_length(padded)[last + 1] >= SIDE)
        group = _Group(columns, rows, ts, last, hit)
        if passes.all():
            return group, passes, passes

        # Six samples without a gap between them, as far as they have arrived.
        begin, arrived = last >= SIDE - 1, last < ts.size - SIDE
        gap = self._periods.is_gap(ts[1:] - ts[:-1], columns[0])
        broken = np.zeros_like(begin)
        if gap.any():
            gaps = np.concatenate([[0], np.cumsum(gap)])
            first, stop = np.maximum(last - (SIDE - 1), 0), np.minimum(last + SIDE, ts.size - 1)
            broken = gaps[np.maximum(stop, 0)] > gaps[np.minimum(first, ts.size - 1)]
        stencil = begin & arrived & ~broken & ~np.isnan(self._periods.known[columns[0]])
        silent = final or (ts.size > 0 and bool(self._periods.is_gap(now - ts[-1:], columns[0])[0]))
        past = final | (now > late)
        no_stencil = (~begin & past) | broken | (~arrived & silent)
        no_run = past
        if hit.any():
            no_run = final | (now > np.where(hit, grid + (SIDE - 1) / self.sample_rate + self._tolerance, late))
        return group, passes | stencil | (no_stencil & no_run), passes | stencil

    def _fill(self, k: Indices, chosen: Indices, groups: list[_Group]) -> Array:
        """Values at the chosen candidates k: (len(k), C)."""
        values = np.empty((k.size, len(self.channels)))
        for group in groups:
            if chosen.size == 0:
                break
            last, hit = group.last[chosen], group.hit[chosen]
            if hit.any():
                if group.columns.size == values.shape[1]:
                    np.take(self.state.values, group.rows[last], axis=0, out=values)
                else:
                    values[:, group.columns] = self.state.values[group.rows[last][:, None], group.columns]
            between = np.flatnonzero(~hit)
            if between.size:
                nodes = last[between, None] + np.arange(1 - SIDE, 1 + SIDE)
                x = group.ts[nodes] - (k[between] / self.sample_rate)[:, None]
                weight = _lagrange_weights_at_zero(x)
                samples = weight.T[:, :, None] * self.state.values[group.rows[nodes.T][:, :, None], group.columns]
                # One node after the other: a matrix product's bits depend on its shape.
                values[between[:, None], group.columns] = np.add.reduce(samples, axis=0)
                self.state.counters.interpolated_cells += samples[0].size
        return values

    def _forget(self, groups: list[_Group]) -> None:
        """Drop the rows that no undecided grid point can need; the last row stays, for its time is the latest."""
        needed = self.state.time.size - 1
        due = self.state.next / self.sample_rate
        for group in groups:
            if group.ts.size == 0:
                continue
            gone = group.ts[-1] < due - self._tolerance and self.state.time[-1] - group.ts[-1] > LONGEST_HOLE
            if not gone:
                oldest = int(np.searchsorted(group.ts, due + self._tolerance, side="right")) - SIDE
                needed = min(needed, int(group.rows[max(oldest, 0)]))
        self.state.time, self.state.values = self.state.time[needed:].copy(), self.state.values[needed:].copy()

    def _deliver(self, k: Indices, values: Array) -> list[GridSamples]:
        """Cut into segments and number them."""
        pieces = []
        breaks = np.flatnonzero(np.diff(k, prepend=self.state.delivered) != 1)
        bounds = sorted({0, k.size, *breaks.tolist()}) if k.size else []
        for a, b in pairwise(bounds):
            skipped = int(k[a]) - self.state.delivered - 1
            # A session that was ended and resumed has not lost what it did not listen to.
            last = np.rint((self.resumed - self.state.t0) * self.sample_rate)
            paused = skipped > LONGEST_HOLE * self.sample_rate and self.state.delivered <= last < k[a]
            self.state.counters.lost_samples += 0 if paused else skipped
            self.state.counters.gaps += int(skipped > 0 and self.state.delivered >= 0)
            self.state.delivered = int(k[b - 1])
            pieces.append(GridSamples(k[a:b], values[a:b], self.state.counters.gaps))
        return pieces


def _run_length(row_index: Indices) -> Indices:
    """Number of rows on consecutive grid points around each row, itself included; 1 off the grid."""
    run = np.cumsum(np.diff(row_index, prepend=NOWHERE) != 1)
    length: Indices = np.bincount(run)[run]
    return length


def _lagrange_weights_at_zero(x: Array) -> Array:
    """Weights (K, n) of the polynomial through nodes x (K, n), read at 0."""
    node = np.arange(x.shape[1])
    at = x.T[:, :, None]
    apart = at - x  # (j, K, i)
    apart[node, :, node] = 1.0
    factor = at / apart
    factor[node, :, node] = 1.0
    return np.asarray(np.multiply.reduce(factor, axis=0))
