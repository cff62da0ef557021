"""Constant latencies of sources that a system file does not state, estimated by the momentum balance.

Samples that are δ later than their times say read x - ẋ δ, so a row's residual changes by δ ∫ c ẋ dt, with the c of
`row_noise`. Such a column beside those of the parameters gives δ with an error bar. When all sources are equally late
nothing changes, so that a source is late against the others, and the column of the one that delivers the torque is that
of all the others with its sign changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.calibration.nuisance import Nuisance
from sms_online.description.sources import CanopenSource, CanSource, source_channels
from sms_online.effects.delay import late_keys
from sms_online.pipeline.sensing import Sensing
from sms_online.state import Stage, State
from sms_online.stream import Array
from sms_online.trackers.factor import triangular_factor

# A latency is reported from so many of its standard deviations on: no accident in any number of sessions, and what rows
# leave for other reasons is rarely so large a part of them.
EVIDENCE = 6.0
# And from here on, s: what clocks are off by at worst is less, and what it does to the parameters too.
LEAST = 2e-4
# By how much a device's clock may be off in one window and not in another, 1σ, s. Beside programs that take all cores
# it is that much, on a quiet host a tenth of it (docs/validation/live.md). Tests of what rows leave allow for it.
WANDER = 2e-4
# Two sources of which either may be late explain the rows alike, up to rounding: then nobody is early.
ALIKE = 0.99


@dataclass(frozen=True)
class SourceGroup:
    """Position sensors (indices) and torques (joints from 1) that come from one source. channels: those used."""

    name: str
    sensors: tuple[int, ...]
    joints: tuple[int, ...]
    channels: tuple[str, ...]


@dataclass(frozen=True)
class Latency:
    """A source whose samples are `size` ± `std` s later than the system file states; effects: it is known as these.

    Less than zero where all others are late by the same, which cannot be distinguished from one early source.
    """

    source: str
    size: float
    std: float
    effects: tuple[str, ...]


def _group(sensing: Sensing, name: str, channels: Sequence[str]) -> SourceGroup:
    """A source's channels that are used."""
    positions = [sensing.channels[column] for column in sensing.position_columns]
    mine = [channel for channel in channels if channel in sensing.channels]
    sensors = tuple(positions.index(channel) for channel in mine if channel in positions)
    joints = tuple(int(channel.rsplit("_", 1)[1]) for channel in mine if channel.startswith(("tau_", "force_")))
    return SourceGroup(name, sensors, joints, tuple(mine))


def source_groups(sensing: Sensing) -> tuple[SourceGroup, ...]:
    """The sources of a session whose latencies are distinguishable; none where not exactly one delivers torques."""
    every = [_group(sensing, source.name, source_channels(source)) for source in sensing.model.system.sources]
    groups = [group for group in every if group.sensors or group.joints]
    positions = len(sensing.position_columns)
    whole = sorted(index for group in groups for index in group.sensors) == list(range(positions))
    if len(groups) < 2 or not whole or sum(bool(group.joints) for group in groups) != 1:
        return ()
    return tuple(groups)


def clock_groups(sensing: Sensing) -> tuple[SourceGroup, ...]:
    """What has a clock of its own: the senders on a bus, each with messages of its name, other devices, logs."""
    members: dict[tuple[str, str], list[str]] = {}
    for source in sensing.model.system.sources:
        if isinstance(source, CanSource | CanopenSource):
            for key, signal in source.signals.items():
                members.setdefault((source.name, key.partition(".")[0]), []).append(signal.channel)
        else:
            members[source.name, ""] = source_channels(source)
    every = [_group(sensing, name, channels) for (name, _), channels in members.items()]
    groups = tuple(group for group in every if group.sensors or group.joints)
    return groups if len(groups) > 1 else ()


def wandering_clocks(sensing: Sensing, nuisances: Sequence[Nuisance]) -> tuple[int, ...]:
    """Which nuisances are clocks of devices that have their own: those wander, as the host that stamps them is late."""
    own = bool(clock_groups(sensing))
    return tuple(k for k, each in enumerate(nuisances) if own and each.name == "clock")


class LatencyState(State):
    """The information of rows about latencies.

    factor (n + G + 1, n + G + 1): of rows with columns of the latencies; rows: how many.
    """

    factor: Array
    rows: int = 0


class Latencies(Stage):
    """Information on the latency of each of G sources, beside that on n parameters."""

    def __init__(self, groups: Sequence[SourceGroup], n: int) -> None:
        self.groups = tuple(groups)
        size = n + len(groups) + 1
        self.state = LatencyState(np.zeros((size, size)))

    def add(self, Y: Array, columns: Array) -> None:
        """Take in white rows [Y b] (M, n + 1) with the columns (M, G) of the latencies."""
        if self.groups:
            self.state.factor = triangular_factor(
                self.state.factor, np.concatenate((Y[:, :-1], columns, Y[:, -1:]), axis=1)
            )
            self.state.rows += len(Y)

    @property
    def found(self) -> Latency | None:
        """The source that is late against the others, the most certain one; None where there is none."""
        G = len(self.groups)
        n = len(self.state.factor) - G - 1
        freedom = self.state.rows - n - 1
        if not G or freedom <= 0:
            return None
        # What the parameters leave of the columns and of the right-hand side.
        left = self.state.factor[n:, n:]
        information = np.sum(left[:, :G] ** 2, axis=0)
        known = information > 0.0
        size = np.divide(left[:, :G].T @ left[:, -1], information, out=np.zeros(G), where=known)
        gain = size**2 * information
        # Where rows leave more than noise for other reasons, the answer is less certain by as much.
        excess = np.maximum(1.0, (np.sum(left[:, -1] ** 2) - gain) / freedom)
        std = np.sqrt(np.divide(excess, information, out=np.full(G, np.inf), where=known))
        certain = (np.abs(size) > EVIDENCE * std) & (np.abs(size) > LEAST)
        if not certain.any():
            return None
        best = np.flatnonzero(certain & (gain >= ALIKE * gain[certain].max()))
        k = int(best[np.argmax(size[best])])
        group = self.groups[k]
        positions = [name for name in group.channels if not name.startswith(("tau_", "force_"))]
        return Latency(group.name, float(size[k]), float(std[k]), tuple(late_keys(group.joints, positions)))


class LatencyColumns:
    """Columns of rows for the latencies of groups of sensors."""

    def __init__(self, groups: Sequence[SourceGroup]) -> None:
        self._sensors = [list(group.sensors) for group in groups]
        self._torque = [k for k, group in enumerate(groups) if group.joints]

    def __len__(self) -> int:
        return len(self._sensors)

    def of(self, by_sensor: Array) -> Array:
        """Columns (n_v, G) of a window's rows, from those of each sensor's own latency (n_v, sensors)."""
        columns = np.stack([by_sensor[:, own].sum(axis=1) for own in self._sensors], axis=1)
        for k in self._torque:
            columns[:, k] = -np.delete(columns, k, axis=1).sum(axis=1)
        return columns
