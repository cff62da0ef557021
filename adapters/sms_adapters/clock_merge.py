"""From the raw items of several devices to rows on one clock: decoded, timed, and merged in order of time.

The work goes in ticks of the session's clock. What arrived before a tick is decoded, its times are corrected, and the
rows that nothing older can still overtake are given out. So the rows are a function of the raw items and their arrivals
alone, whoever calls and whenever: a recording replayed gives the rows of the session.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_adapters.can_signals import WantedMessage, raw_word
from sms_adapters.clock_line import DeviceClock
from sms_adapters.clock_samples import CountedTime, NumberedTime
from sms_adapters.conversion import TurnsState
from sms_adapters.faults import sentences
from sms_adapters.raw import CanFrames, DecodedSamples, Decoder, Raw, concatenate_frames
from sms_online.sample_faults import StuckGuard
from sms_online.state import Stage, State
from sms_online.stream import Array, Block

# Items are taken so often, µs: the tick adds half of itself to the latency.
TICK_MICROSECONDS = 10_000
TICK = TICK_MICROSECONDS * 1e-6
# Rows wait so much longer than the slowest source's newest one, s: frames of one bus overtake each other by less, and a
# sensor that sticks is noticed within it.
REORDERING = 0.01
# Rows wait so long after their arrival for a source that lags, s; a sender that stumbles loses nothing within it.
# Where the whole host is late, all sources are, and none has to wait for another.
PATIENCE = 0.3
# A source from which nothing comes for so long is silent, s: its device may be gone without the bus saying so.
SILENCE = 1.0
# At the start all wait until the clocks of all sources are known, at most so long, s.
START_PATIENCE = 3.0
# Rows are asked for this much before they are due by the delays of the last ones, s: half of what delays scatter by,
# for asking in vain costs as much as asking, and asking late costs a tick.
EARLY = 1e-3
# What arrives is left aside no longer than this, s, whatever is still missing: how long it has waited counts from then.
LONGEST_ASIDE = 0.2


@dataclass(frozen=True)
class Steps:
    """Rows are of use in portions: up to `first` s after the first row, then every `period` s."""

    first: float
    period: float

    def after(self, t: float) -> float:
        """The first end of a portion later than t, s after the first row."""
        return self.first + self.period * (max(-1, math.floor((t - self.first) / self.period)) + 1)


@dataclass(frozen=True)
class Stream:
    """What comes periodically from one sender on one clock: a message of a CAN bus, or a serial line.

    columns: of its source's channels. period: nominal, s. message: the CAN message with a counter, if it is one.
    """

    columns: tuple[int, ...]
    period: float
    message: WantedMessage | None = None


class SourceLane:
    """One source: raw items in order of arrival to rows with times of the session's clock.

    name: of the source. latency: from the instant of a sample to its arrival, s. streams: every channel of the decoder
    in one of them. newest: (streams,) latest time of each, -inf before its clock is known.
    """

    def __init__(self, name: str, decoder: Decoder, streams: Sequence[Stream], latency: float) -> None:
        self.name = name
        self.decoder = decoder
        self.clocks = [DeviceClock(latency) for _ in streams]
        self.newest = np.full(len(streams), -np.inf)
        self.unplaced = 0
        self.streams = tuple(streams)
        self._stream_of = np.zeros(len(decoder.channels), dtype=np.intp)
        for k, stream in enumerate(streams):
            self._stream_of[list(stream.columns)] = k
        self._counted = {
            stream.message.id: (stream.message, CountedTime(1 << stream.message.counter.length, stream.period))
            for stream in streams
            if stream.message is not None and stream.message.counter is not None
        }
        self._numbered = [NumberedTime(stream.period) for stream in streams]
        self._held = [np.empty((0, len(decoder.channels))) for _ in streams]  # rows whose time is not known yet

    def push(self, items: Sequence[Raw]) -> tuple[Array, Array]:
        """Times (K,) and values (K, C) of the samples whose time has become known with these items."""
        samples = self._decode(items)
        t, values = [np.empty(0)], [np.empty((0, len(self.decoder.channels)))]
        if samples.t_arrival.size:
            arrival, device, rows = samples.t_arrival, samples.t_device, samples.values
            stream = self._stream_of[np.argmin(np.isnan(rows), axis=1)]
            for k in np.unique(stream).tolist():
                mine = stream == k
                times, timed = self._time(k, arrival[mine], device[mine], rows[mine])
                t.append(times)
                values.append(timed)
        return np.concatenate(t), np.concatenate(values)

    def _decode(self, items: Sequence[Raw]) -> DecodedSamples:
        """Samples of all items, together, as arrays are for many."""
        frames = [item for item in items if isinstance(item, CanFrames)]
        if frames:
            return self.decoder.push(self._stamped(concatenate_frames(frames)))
        return self.decoder.push(*items)

    def _stamped(self, frames: CanFrames) -> CanFrames:
        """Frames of senders that count them, with stamps by their count, which knows no jitter as a kernel's does."""
        if not self._counted:
            return frames
        stamp = frames.stamp.copy()
        for id_, (message, time) in self._counted.items():
            assert message.counter is not None
            rows = np.flatnonzero((frames.id == id_) & (frames.length == message.length) & (frames.flags & 3 == 0))
            counts = raw_word(message.counter, message.words(frames.data, rows)).astype(np.int64)
            stamp[rows] = time(counts, frames.arrival[rows])
        return CanFrames(frames.arrival, stamp, frames.id, frames.length, frames.data, frames.flags)

    def _time(self, k: int, arrival: Array, device: Array, values: Array) -> tuple[Array, Array]:
        """Times and rows of stream k that have become known."""
        unmarked = np.isnan(device)
        if unmarked.any():
            device = device.copy()
            device[unmarked] = self._numbered[k](arrival[unmarked])
        return self._timed(k, self.clocks[k].push(device, arrival), values)

    def finish(self) -> tuple[Array, Array]:
        """Times and rows that are held back, at the end of the session."""
        nothing = np.empty((0, len(self.decoder.channels)))
        parts = [self._timed(k, clock.finish(), nothing) for k, clock in enumerate(self.clocks)]
        return np.concatenate([t for t, _ in parts]), np.concatenate([rows for _, rows in parts])

    def _timed(self, k: int, t: Array, values: Array) -> tuple[Array, Array]:
        """Rows of stream k, new ones appended, that the times t belong to."""
        waiting = np.concatenate((self._held[k], values))
        rows, self._held[k] = waiting[: t.size], waiting[t.size :]
        good = ~np.isnan(t)
        self.unplaced += int(np.count_nonzero(~good))
        t, rows = t[good], rows[good]
        self.newest[k] = max(self.newest[k], t.max(initial=-np.inf))
        return t, rows

    @property
    def warnings(self) -> list[str]:
        """What was wrong with this source so far, counted, one sentence for each kind."""
        found = sentences(self.name, self.decoder.counters)
        jumps = sum(clock.counters.jumps for clock in self.clocks)
        steps = sum(clock.counters.steps for clock in self.clocks)
        if jumps:
            last = next(clock.last_jump for clock in self.clocks if clock.counters.jumps)
            found.append(f"{self.name}: {jumps} jumps of its clock, the last by {last:+.3f} s")
        if steps:
            found.append(f"{self.name}: {steps} steps of its clock or latency by more than a millisecond")
        if self.unplaced:
            found.append(f"{self.name}: {self.unplaced} samples skipped, their stamps cannot be true")
        return found


def _arrivals(item: Raw) -> tuple[float, float]:
    """Arrivals of the first and the last sample that an item holds, s."""
    if isinstance(item, CanFrames):
        return float(item.arrival[0]), float(item.arrival[-1])
    return item.arrival, item.arrival


class MergerState(State):
    """What a resumed session goes on with: the turns of every channel that wraps. Clocks are fitted anew."""

    turns: dict[str, TurnsState]


class Merger(Stage):
    """Rows of all sources in order of time, from raw items by the tick.

    lanes: the sources; their channels, one after the other, are those of the blocks. start: time of the session's clock
    zero in the blocks, s. steps: when rows are of use; in between items are left as they are, for arrays are cheaper
    the longer they are.
    """

    def __init__(self, lanes: Sequence[SourceLane], start: float = 0.0, steps: Steps | None = None) -> None:
        self.lanes = tuple(lanes)
        self.channels = tuple(channel for lane in lanes for channel in lane.decoder.channels)
        self._turns = {channel: turns for lane in lanes for channel, turns in lane.decoder.turns.items()}
        self.state = MergerState({channel: turns.state for channel, turns in self._turns.items()})
        self.late = [0 for _ in lanes]
        self.missed = [0 for _ in lanes]  # late ones just after a silence
        self._returned = [-np.inf for _ in lanes]  # tick at which the last silence of each ended
        self._now = 0.0  # the last tick, s
        self.silences = [0 for _ in lanes]
        self._heard = [np.inf for _ in lanes]  # tick of the last item of each source
        self._start = start
        self._first = np.inf  # arrival of the first item
        self._silent = [False for _ in lanes]
        self._started = False
        self._given = -np.inf  # time up to which rows are out
        self._came = deque([(-np.inf, -np.inf)])  # ticks with the newest row decoded by then
        self._patient = -np.inf  # time of the newest row that has waited for PATIENCE
        self._guards = [StuckGuard([stream.columns for stream in lane.streams]) for lane in lanes]
        self.steps = steps
        self._first_row: float | None = None  # its time
        self._lag = [np.inf for _ in lanes]  # from the newest sample of each source to its last item
        self._items: list[list[Raw]] = [[] for _ in lanes]
        self._waiting = [(np.empty(0), np.empty((0, len(lane.decoder.channels)))) for lane in lanes]

    def renew(self) -> None:
        """See Stage."""
        for channel, turns in self._turns.items():
            turns.state = self.state.turns[channel]

    def advance(self, now: float, items: Sequence[Sequence[Raw]]) -> Block | None:
        """Take what arrived up to the tick `now`, s, of each source, and return the rows that are in order by now."""
        self._now = now
        for k, raw in enumerate(items):
            if not raw:
                # Counted once, when it has been too long.
                too_long = now - self._heard[k] > SILENCE
                self.silences[k] += int(too_long and not self._silent[k])
                self._silent[k] = too_long
            else:
                self._returned[k] = now if self._silent[k] else self._returned[k]
                self._heard[k], self._silent[k] = now, False
                self._first = min(self._first, _arrivals(raw[0])[0])
                self._items[k] += raw
        while len(self._came) > 1 and self._came[0][0] <= now - PATIENCE:
            self._patient = max(self._patient, self._came.popleft()[1])
        if self.steps is not None and self._first_row is not None:
            wanted = self._first_row + self.steps.after(self._given - self._first_row)
            if self._expected() < wanted - EARLY and now - self._came[-1][0] < LONGEST_ASIDE:
                return None
        self._decode()
        return self._give(self._due(now))

    def _expected(self) -> float:
        """What `_due` will be once the items are decoded, if they are as much delayed as the last ones were."""
        newest = [
            _arrivals(raw[-1])[1] - lag if raw else float(lane.newest.min())
            for lane, raw, lag in zip(self.lanes, self._items, self._lag, strict=True)
        ]
        return max(min(newest) - REORDERING, self._patient)

    def _decode(self) -> None:
        """Decode the items that are there."""
        for k, lane in enumerate(self.lanes):
            raw, self._items[k] = self._items[k], []
            if raw:
                self._admit(k, *lane.push(raw))
                self._lag[k] = _arrivals(raw[-1])[1] - float(lane.newest.min())
        # No row is of the future, whatever its stamp.
        self._came.append((self._now, min(self._now, max(float(lane.newest.max()) for lane in self.lanes))))

    def finish(self) -> Block | None:
        """The rows that are left at the end of the session."""
        self._decode()
        for k, lane in enumerate(self.lanes):
            self._admit(k, *lane.finish())
        return self._give(np.inf)

    def _admit(self, k: int, t: Array, values: Array) -> None:
        """Put rows among those that wait, in order of time; those whose time has passed are late."""
        late = t <= self._given
        if late.any():
            # A device that returns sends first what it has kept, and its clock has to be found again.
            returning = self._now - self._returned[k] < START_PATIENCE
            counts = self.missed if returning else self.late
            counts[k] += int(np.count_nonzero(late))
            t, values = t[~late], values[~late]
        if t.size == 0:
            return
        waiting_t, waiting = self._waiting[k]
        values = np.concatenate((waiting, values))
        self._guards[k].blank(values, t.size)
        t = np.concatenate((waiting_t, t))
        order = np.argsort(t, kind="stable")
        self._waiting[k] = t[order], values[order]

    def _due(self, now: float) -> float:
        """The time that nothing older can still be overtaken by."""
        newest = np.concatenate([lane.newest for lane in self.lanes])
        if not self._started:
            self._started = bool(np.isfinite(newest).all()) or now > self._first + START_PATIENCE
        if not self._started:
            return -np.inf
        return max(float(newest.min()) - REORDERING, self._patient)

    def _give(self, due: float) -> Block | None:
        if due <= self._given:
            return None
        self._given = due if np.isfinite(due) else self._given
        parts_t, parts = [], []
        column = 0
        for k, (t, values) in enumerate(self._waiting):
            count = int(np.searchsorted(t, due, side="right"))
            wide = np.full((count, len(self.channels)), np.nan)
            wide[:, column : column + values.shape[1]] = values[:count]
            column += values.shape[1]
            parts_t.append(t[:count])
            parts.append(wide)
            self._waiting[k] = t[count:], values[count:]
        t = np.concatenate(parts_t)
        if t.size == 0:
            return None
        self._first_row = float(t.min()) if self._first_row is None else self._first_row
        order = np.argsort(t, kind="stable")
        rows = np.concatenate(parts)[order]
        filled = ~np.isnan(rows).all(axis=1)
        return Block(t[order][filled] + self._start, self.channels, rows[filled])

    @property
    def clock_offsets(self) -> dict[str, float]:
        """How far the session's clock has gained on each device's, ms, by source and, of several, number of the stream.

        Of the clocks that are known.
        """
        offsets = {}
        for lane in self.lanes:
            for k, clock in enumerate(lane.clocks, start=1):
                if clock.known:
                    offsets[lane.name if len(lane.clocks) == 1 else f"{lane.name} {k}"] = 1e3 * clock.gained
        return offsets

    def silent(self, now: float) -> list[str]:
        """Names of the sources that are silent at the tick `now`, s, or have been since the session began."""
        return [
            lane.name
            for lane, heard in zip(self.lanes, self._heard, strict=True)
            if now - heard > SILENCE or (math.isinf(heard) and now > START_PATIENCE)
        ]

    @property
    def warnings(self) -> list[str]:
        """What was wrong so far, counted, one sentence each."""
        found = []
        for k, (lane, guard) in enumerate(zip(self.lanes, self._guards, strict=True)):
            found += lane.warnings
            if math.isinf(self._heard[k]) and self._now > START_PATIENCE:
                found.append(f"{lane.name}: nothing was received")
            if self.silences[k]:
                found.append(f"{lane.name}: silent for more than {SILENCE:g} s, {self.silences[k]} times")
            if self.missed[k]:
                found.append(f"{lane.name}: {self.missed[k]} samples skipped, they came late after it had been silent")
            if self.late[k]:
                late = f"{self.late[k]} samples skipped, they came more than {PATIENCE:g} s after the others"
                found.append(f"{lane.name}: {late}: the machine is too slow, or the source")
            for channel, blanked in zip(lane.decoder.channels, guard.blanked.tolist(), strict=True):
                if blanked:
                    found.append(f"{channel}: {blanked} samples skipped, the sensor stood still or at its limit")
        return found
