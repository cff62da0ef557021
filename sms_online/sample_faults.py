"""What samples show to be wrong by themselves: sensors that are stuck or wrapped, stamps in another unit of time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sms_online.stream import Array, Mask, increments

# Chance that a healthy sensor repeats itself so many times in a row, given how often it has repeated itself so far.
FALSE_ALARM = 1e-12
# A channel is judged once so many of its samples are known.
LEARNT = 200
# Samples of a recording in which stuck sensors are looked for at once: what was healthy before them is known then.
PIECE = 256
# Fewest repetitions that can be an alarm: a sensor read twice as often as it samples repeats each value once.
LEAST_RUN = 8
# A coarse encoder that turns back rests too, but creeps there by single steps; what stops from a change of more
# than this many of its smallest steps has stopped all at once.
SUDDEN = 3.0
# Friction stops a fine encoder from several steps, too, but not from a change of more than this multiple of what its
# changes usually differ by from one to the next: their median, rounded up to a power of two.
USUAL_STOP = 4.0
# So it is for readings whose changes differ by so many of their smallest steps at most.
NOISELESS = 8.0
# Exponents of two that such differences are counted by.
EXPONENTS = (-60, 20)
# Turns at which readings wrap, in rad and degrees: a step within this share of one, where others are far smaller.
TURNS, TURN_TOLERANCE = (2.0 * np.pi, np.pi, 360.0), 0.1
# A reading that wraps elsewhere steps by more than this multiple of its usual steps, every time by the same within
# this share.
JUMP, SAME_STEP = 20.0, 0.05
# Samples on either side of such a step that its size is found from.
BESIDE_JUMP = 25
# Units of time that stamps may be in by mistake, by how many of them are a second.
CLOCKS = {"ms": 1e3, "µs": 1e6, "ns": 1e9}


def unit_of_stamps(ratio: float, tolerance: float) -> tuple[str, float] | None:
    """The unit that stamps are in and how many of it are a second; None where they are in seconds.

    ratio: of the time between samples to the described one. tolerance: factor by which rates may differ.
    """
    close = ((unit, factor) for unit, factor in CLOCKS.items() if 1.0 / tolerance < ratio / factor < tolerance)
    return next(close, None)


def wrapped_at(steps: Array) -> tuple[float, int] | None:
    """At what a reading wraps, and how often, by its steps (B,) from sample to sample; None where it does not."""
    size = np.abs(steps)
    usual = float(np.quantile(size, 0.9)) if size.size else np.inf
    for turn in TURNS:
        found = int(np.count_nonzero(np.abs(size / turn - 1.0) < TURN_TOLERANCE))
        if found and usual < TURN_TOLERANCE * turn:
            return turn, found
    jumps = np.flatnonzero(size > JUMP * max(usual, 1e-12))
    if jumps.size and size[jumps].min() > (1.0 - SAME_STEP) * size[jumps].max():
        ends = np.concatenate(([-1], jumps, [steps.size]))
        sizes = [_jump(steps[a + 1 : c], b - a - 1) for a, b, c in zip(ends[:-2], jumps, ends[2:], strict=True)]
        return float(np.median(np.abs(sizes))), jumps.size
    return None


def _jump(steps: Array, at: int) -> float:
    """Size of the jump in a reading's steps (B,) from sample to sample at index `at`, beside a cubic that it follows.

    From some samples on either side: the noise of the two at the jump would stay in all readings behind it.
    """
    first = max(0, at - BESIDE_JUMP)
    near = steps[first : at + BESIDE_JUMP + 1]
    behind = np.arange(near.size + 1) > at - first
    along = np.linspace(-1.0, 1.0, behind.size)
    shape = np.vander(along, min(4, near.size))
    return float(np.linalg.lstsq(np.column_stack((behind, shape)), np.append(0.0, np.cumsum(near)))[0][0])


def stuck_samples(values: Array) -> Mask:
    """Where a recorded reading (B,), all finite, is stuck, as `StuckGuard` finds it."""
    kept, guard = values[:, None].copy(), StuckGuard([[0]])
    for start in range(0, len(kept), PIECE):
        seen = kept[: start + PIECE]
        guard.blank(seen, len(seen) - start)
    return np.isnan(kept[:, 0])


class StuckGuard:
    """Takes the samples of sensors that are stuck, or at the end of their range, out of the rows of one source.

    A real sensor's last digits move, even at rest. A value that comes again and again is thus none, unless that is the
    sensor's way (a coarse encoder at rest): so the share of repetitions in each channel's healthy past sets how many in
    a row are an alarm. The samples of a run are blanked from its second one on, as far as they are still here.
    Limitation: a sensor that has nearly always repeated itself is never called stuck.

    groups: columns of the rows that are sampled together. blanked: (C,) samples taken out so far.
    """

    def __init__(self, groups: Sequence[Sequence[int]]) -> None:
        channels = sum(len(group) for group in groups)
        self.blanked = np.zeros(channels, dtype=np.int64)
        self._groups = [np.array(group) for group in groups]
        self._last = np.full(channels, np.nan)
        self._run = np.zeros(channels, dtype=np.int64)  # how often the last value was repeated
        self._change = np.zeros(channels)  # size of the last change
        self._quantum = np.full(channels, np.inf)  # size of the smallest change
        self._seen = np.zeros(channels, dtype=np.int64)
        self._repeated = np.zeros(channels, dtype=np.int64)
        # How often changes differed by so much from one to the next.
        self._bends = np.zeros((channels, EXPONENTS[1] - EXPONENTS[0] + 1), dtype=np.int64)

    def blank(self, values: Array, new: int) -> None:
        """Blank, in place, what is stuck in rows (K, C), of which the last `new` are seen for the first time."""
        start = values.shape[0] - new
        for group in self._groups:
            present = ~np.isnan(values[start:, group])
            rows = start + np.flatnonzero(present.any(axis=1))
            if rows.size == 0:
                continue
            whole = np.count_nonzero(present) == rows.size * group.size
            changes = np.abs(increments(values[rows[:, None], group], self._last[None, group]))
            if whole and changes.all():
                # Everything moved all the time, NaN before the first sample included.
                self._quantum[group] = np.fmin(self._quantum[group], np.fmin.reduce(changes, axis=0))
                for channel, own in zip(group.tolist(), changes.T, strict=True):
                    self._count_bends(channel, own)
                self._last[group], self._run[group] = values[rows[-1], group], 0
                self._change[group] = changes[-1]
                self._seen[group] += rows.size
                continue
            for column, channel in enumerate(group.tolist()):
                self._blank_channel(channel, values[:, channel], start + np.flatnonzero(present[:, column]))

    def _blank_channel(self, channel: int, column: Array, rows: NDArray[np.intp]) -> None:
        if rows.size == 0:
            return
        samples = column[rows]
        change = np.abs(increments(samples, self._last[channel]))
        same = change == 0.0
        moved = change[change > 0.0]
        self._quantum[channel] = min(self._quantum[channel], moved.min(initial=np.inf))
        # Repetitions up to each sample, since the last change: one of this batch, or the one before it.
        number = np.arange(samples.size)
        changed = np.maximum.accumulate(np.where(same, -1, number))
        run = np.where(changed >= 0, number - changed, number + 1 + self._run[channel])
        size = np.where(changed >= 0, change[changed], self._change[channel])
        limit = self._limit(channel)
        stuck = (run >= limit) & (size > self._sudden(channel))
        self._count_bends(channel, change)
        self._last[channel], self._run[channel] = samples[-1], run[-1]
        self._change[channel] = size[-1]
        # What is stuck teaches nothing about the sensor's ways.
        self._seen[channel] += np.count_nonzero(~stuck)
        self._repeated[channel] += np.count_nonzero(same & ~stuck)
        for first in np.flatnonzero(stuck & (run == limit)).tolist():
            earlier = np.flatnonzero(~np.isnan(column[: rows[first]]))[1 - limit :]
            self.blanked[channel] += earlier.size
            column[earlier] = np.nan
            self._seen[channel] -= limit - 1
            self._repeated[channel] -= limit - 1
        self.blanked[channel] += np.count_nonzero(stuck)
        column[rows[stuck]] = np.nan

    def _sudden(self, channel: int) -> float:
        """The largest change from which the sensor may come to rest all at once."""
        least = SUDDEN * float(self._quantum[channel])
        counts = np.cumsum(self._bends[channel])
        if not self._repeated[channel] or not counts[-1]:
            return least
        usual = 2.0 ** (int(np.searchsorted(counts, 0.5 * counts[-1])) + EXPONENTS[0])
        # Noise of more steps moves a sensor at rest, too.
        return max(least, USUAL_STOP * usual) if usual <= NOISELESS * self._quantum[channel] else least

    def _count_bends(self, channel: int, change: Array) -> None:
        """Count what changes (B,) differ by from one to the next, the first from the last one so far; none at rest."""
        bends = np.abs(np.diff(change, prepend=self._change[channel]))
        exponents = np.frexp(bends[bends > 0.0])[1]
        np.add.at(self._bends[channel], np.clip(exponents, *EXPONENTS) - EXPONENTS[0], 1)

    def _limit(self, channel: int) -> int:
        """Repetitions in a row that are an alarm."""
        if self._seen[channel] < LEARNT:
            return int(np.iinfo(np.int64).max)
        share = (self._repeated[channel] + 1.0) / (self._seen[channel] + 2.0)
        return max(LEAST_RUN, int(np.ceil(np.log(FALSE_ALARM) / np.log(share))))
