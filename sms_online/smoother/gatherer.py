"""Samples of a session that a smoother has yet to fit, gathered into spans."""

from __future__ import annotations

import numpy as np

from sms_online.model.model import Model
from sms_online.pipeline.synchronise import GridSamples, Synchroniser
from sms_online.state import Stage, State
from sms_online.stream import Array, Block, Indices

# Where a gap of the motion is at its end, a span goes on to the end of the gap, at most for this time, s.
LATER_END = 5.0


class GatheredState(State):
    """What is gathered.

    values (B, channels): readings at t (B,), s. torque (K, joints): at index (K, 2), grid index and segment. motion
    (M, n_x + n_v): as the pipeline took it from the sensors, at grid indices `moved`.
    """

    t: Array
    values: Array
    index: Indices
    torque: Array
    moved: Indices
    motion: Array


class Gatherer(Stage):
    """Gathers torques, readings of so many channels, and the motion as the sensors alone give it.

    A span is named by how many torques it has: it begins with the first one that is gathered.
    """

    def __init__(self, model: Model, channels: int) -> None:
        self._rate, joints = model.system.sample_rate, len(model.system.joints)
        self._synchroniser = Synchroniser([f"n_tau_{i}" for i in range(1, joints + 1)], self._rate)
        self.state = GatheredState(
            t=np.empty(0),
            values=np.empty((0, channels)),
            index=np.empty((0, 2), dtype=np.int64),
            torque=np.empty((0, joints)),
            moved=np.empty(0, dtype=np.int64),
            motion=np.empty((0, model.layout.n_x + model.layout.n_v)),
        )

    def resume(self, end: float) -> None:
        """Count nothing as lost from `end`, s, to the next sample: the session did not listen."""
        self._synchroniser.resumed = end

    @property
    def lost(self) -> int:
        """Samples without a torque."""
        return self._synchroniser.counters.lost_samples

    @property
    def periods(self) -> Array:
        """Sample period of each torque (joints,), s, NaN while it is not known."""
        return self._synchroniser.periods

    def push(self, t: Array, torque: Array, values: Array) -> None:
        """Take samples at t (B,), s, in order of time: n τ (B, joints), readings (B, channels), else NaN."""
        now = self.state
        now.t, now.values = np.concatenate((now.t, t)), np.concatenate((now.values, values))
        for piece in self._synchroniser.push(Block(t, self._synchroniser.channels, torque)):
            self._keep(piece)

    def move(self, index: Indices, x: Array, v: Array) -> None:
        """Take the motion at grid samples (B,): x (B, n_x), v (B, n_v)."""
        now = self.state
        now.moved = np.concatenate((now.moved, index))
        now.motion = np.concatenate((now.motion, np.concatenate((x, v), axis=1)))

    def finish(self) -> None:
        """No more samples come."""
        for piece in self._synchroniser.flush():
            self._keep(piece)

    def _keep(self, piece: GridSamples) -> None:
        now = self.state
        index = np.stack((piece.index, np.full(piece.index.size, piece.segment)), axis=1)
        now.index, now.torque = np.concatenate((now.index, index)), np.concatenate((now.torque, piece.values))

    def complete(self, longest: int, last: bool) -> int:
        """Torques of the first span, of `longest` without a gap, and its motion is there; 0 where more may come.

        last: no more samples come.
        """
        count = self._first(longest, last)
        moved = self.state.moved[-1] if self.state.moved.size else -1
        return count if last or not count or moved >= self.state.index[count - 1, 0] else 0

    def _first(self, longest: int, last: bool) -> int:
        segment = self.state.index[:, 1]
        run = int(np.searchsorted(segment, segment[0], side="right")) if segment.size else 0
        most = longest + round(LATER_END * self._rate)
        if run < longest:
            return run if last or run < segment.size else 0
        # A span ends, and the next one begins, where the motion is known: a first state that is guessed rings.
        known = np.flatnonzero(np.isin(self.state.index[longest - 1 : min(run, most), 0], self.state.moved))
        if known.size:
            return longest + int(known[0])
        moved = self.state.moved[-1] if self.state.moved.size else -1
        over = last or run < segment.size or (run >= most and moved >= self.state.index[most - 1, 0])
        return longest if over else 0

    def _time(self, index: Indices) -> Array:
        return np.asarray(self._synchroniser.start_time + index / self._rate)

    def span(self, count: int) -> tuple[float, float, Array, Array]:
        """Begin and end of a span, s, and t (M,) and values (M, channels) of its readings."""
        now = self.state
        begin, end = self._time(now.index[[0, count - 1], 0]).tolist()
        inside = (now.t >= begin) & (now.t <= end)
        return begin, end, now.t[inside], now.values[inside]

    def torques(self, count: int) -> tuple[Array, Array]:
        """Times (count,), s, of a span's torques, and these (count, joints)."""
        return self._time(self.state.index[:count, 0]), self.state.torque[:count]

    def motion(self, count: int) -> tuple[Array, Array]:
        """Times (M,), s, of the motion as far as it is known in a span, and x and v (M, n_x + n_v)."""
        now = self.state
        inside = (now.moved >= now.index[0, 0]) & (now.moved <= now.index[count - 1, 0])
        return self._time(now.moved[inside]), now.motion[inside]

    def forget(self, count: int) -> bool:
        """Drop a span; whether the next one goes on from it, beginning with the sample that ends it."""
        now = self.state
        goes_on = bool(count < len(now.index) and now.index[count, 1] == now.index[count - 1, 1])
        dropped = count - 1 if goes_on else count
        end = now.index[count - 1, 0]
        now.index, now.torque = now.index[dropped:], now.torque[dropped:]
        kept = now.t > self._time(end)
        now.t, now.values = now.t[kept], now.values[kept]
        kept = now.moved >= end
        now.moved, now.motion = now.moved[kept], now.motion[kept]
        return goes_on
