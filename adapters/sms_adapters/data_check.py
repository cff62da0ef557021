"""A capture compared with its system file, before it is estimated from."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from sms_adapters.channel_check import UNIT_TOLERANCE, ChannelCheck, Remark
from sms_adapters.encoder_pairs import encoder_pairs, other_gears
from sms_online.data import Data, recorded_session
from sms_online.description.channels import channel_unit, drive_channels, sensed_channels
from sms_online.description.given import Given, given_system
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.grouping import grouped
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.outliers import LeftOut, Outliers
from sms_online.sample_faults import PIECE, StuckGuard, unit_of_stamps
from sms_online.stream import Array, Block
from sms_online.tables import Tabled, html_table, text_table
from sms_online.verdict.judged import evaluated
from sms_online.verdict.sample_reasons import MANY_OUTLIERS

SCHEMA = "sms-online/check/1"
UNDETERMINED = "not at all"
# From this relative standard deviation on, %, not even the sign of a parameter is known.
SIGN_UNKNOWN = 100.0
# Relative standard deviations, %, by which parameters are grouped, and what each group is called.
GROUPS = ((1.0, "within 1 %"), (10.0, "within 10 %"), (SIGN_UNKNOWN, "within 100 %"), (math.inf, "sign unknown"))
# What is the matter is said once so much of a session is there, s.
SOON = 5.0
NOT_EXPLAINED = (
    "the description explains less than half of every torque: where the motion was small, move faster and further; "
    "else run `sms-online diagnose`"
)
# Channels that one line names.
SHOWN = 4


@dataclass(frozen=True)
class CheckedChannel:
    """A channel as it was found.

    rate: Hz, None where it has too few samples. low, high: its values, in its unit.
    """

    name: str
    unit: str
    samples: int
    rate: float | None
    low: float
    high: float


@dataclass(frozen=True)
class Check(Tabled):
    """What a capture is worth to a system, before it is estimated from.

    channels: by name. remarks: what is the matter. determined: how well the motion and its sensors determine each
    parameter, its standard deviation relative to its size, % (inf: not at all); empty where the estimator cannot read
    the capture. passed: nothing grave is the matter.
    """

    system: str
    source: str
    duration: float
    channels: Mapping[str, CheckedChannel]
    remarks: tuple[Remark, ...]
    determined: Mapping[str, float]

    @property
    def passed(self) -> bool:
        """Whether nothing is the matter from which estimates will suffer."""
        return not any(remark.grave for remark in self.remarks)

    @property
    def lines(self) -> list[str]:
        """The remarks, grave ones first; channels with the same remark share a line."""
        return [line for _, line in joined(self.remarks)]

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """Headings, and a row of cells for each channel."""
        rows = [
            [c.name, c.unit, str(c.samples), "" if c.rate is None else f"{c.rate:.5g}", f"{c.low:.4g}", f"{c.high:.4g}"]
            for c in self.channels.values()
        ]
        return ["channel", "unit", "samples", "rate, Hz", "lowest", "highest"], rows

    def motion(self) -> list[str]:
        """A line for each group of parameters that are determined equally well."""
        groups: dict[str, list[str]] = {}
        for name, share in sorted(self.determined.items(), key=lambda each: each[1]):
            label = UNDETERMINED if math.isinf(share) else next(label for limit, label in GROUPS if share <= limit)
            groups.setdefault(label, []).append(name)
        return [f"{label}: {', '.join(names)}" for label, names in groups.items()]

    def document(self) -> dict[str, Any]:
        """The same as plain lists, dictionaries and numbers."""
        return {
            "schema": SCHEMA,
            "system": self.system,
            "source": self.source,
            "duration_s": self.duration,
            "passed": self.passed,
            "remarks": [vars(remark) for remark in self.remarks],
            "channels": [vars(channel) for channel in self.channels.values()],
            "determined_percent": dict(self.determined),
        }

    def __str__(self) -> str:
        return "\n".join([text_table(*self.rows(), left=2), "", *self.lines, *self.motion()])

    def _repr_html_(self) -> str:
        lines = "".join(f"<li>{escape(line)}</li>" for line in (*self.lines, *self.motion()))
        return f"{html_table(*self.rows())}<ul>{lines}</ul>"


def joined(remarks: Iterable[Remark]) -> list[tuple[bool, str]]:
    """Each remark as a line, with whether it is grave; grave ones first."""
    channels = grouped(((remark.grave, remark.text), remark.channel) for remark in remarks)
    found = []
    for (grave, text), names in sorted(channels.items(), key=lambda each: not each[0][0]):
        more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
        subject = ", ".join(filter(None, names[:SHOWN])) + more
        found.append((grave, f"{subject}: {text}" if subject else text))
    return found


class ChannelChecks:
    """All channels of a source, samples in order of time."""

    def __init__(self, system: System, channels: Sequence[str]) -> None:
        self.channels = tuple(channels)
        self.first = self.last = math.nan  # times, s
        described = {
            name: (sensor.rate or system.sample_rate, sensor.resolution)
            for sensor in reversed(system.sensors)
            for name in sensed_channels(system, sensor)
        }
        self.absent = tuple(name for name in described if name not in self.channels)
        self._described, self._tick = bool(described), 1.0 / system.sample_rate
        self.checks = []
        for name in self.channels:
            rate, resolution = described.get(name, (None, 0.0))
            period = None if rate is None else 1.0 / rate
            self.checks.append(ChannelCheck(name, channel_unit(system, name), period, resolution))
        self._waiting = np.empty((0, len(self.channels)))
        self._pairs = encoder_pairs(system, self.channels)
        self._gears = [remark for remark in other_gears(system) if remark.channel in self.channels]
        self._guard = StuckGuard([[k] for k in range(len(self.channels))])

    def push(self, block: Block) -> None:
        """Take a block."""
        if not block.t.size:
            return
        self.first = float(block.t[0]) if math.isnan(self.first) else self.first
        self.last = float(block.t[-1])
        there = ~np.isnan(block.values)
        for k, check in enumerate(self.checks):
            check.push(block.t[there[:, k]], block.values[there[:, k], k])
        for pair in self._pairs:
            pair.push(block.values)
        # In pieces of one size, so that it does not matter how the samples are cut into blocks.
        self._waiting = np.concatenate((self._waiting, block.values))
        while len(self._waiting) >= PIECE:
            values, self._waiting = self._waiting[:PIECE], self._waiting[PIECE:]
            self._hanging(values)

    def _hanging(self, values: Array) -> None:
        """Look for sensors that hang in rows (PIECE, C)."""
        kept = values.copy()
        self._guard.blank(kept, PIECE)
        there = ~np.isnan(values)
        hung = there & np.isnan(kept)
        for k, check in enumerate(self.checks):
            if hung[:, k].any():
                check.hung(values[hung[:, k], k])
            if there[:, k].any() and not hung[np.flatnonzero(there[:, k])[-1], k]:
                check.moved()

    def remarks(self) -> Iterator[Remark]:
        """What is the matter so far."""
        for check in self.checks:
            yield from check.remarks()
        for pair in self._pairs:
            yield from pair.remarks()
        yield from self._gears
        # Where a sensor says how often it samples, its channels are compared with that, and remarked upon already.
        if (unit := self.other_unit_of_time) is not None and not self._described:
            period = min(period for check in self.checks if (period := check.measured_period))
            yield Remark("", f"time in {unit}, not in s: a sample every {period:g}", True)

    @property
    def other_unit_of_time(self) -> str | None:
        """The unit that stamps are in where that is not s: one sensor at least samples as often as the system does."""
        periods = [period for check in self.checks if (period := check.measured_period)]
        if not periods:
            return None
        stamps = unit_of_stamps(min(periods) / self._tick, UNIT_TOLERANCE)
        return None if stamps is None else stamps[0]


class Checked:
    """Looks at blocks on their way to the estimator; what is grave is said soon, and what comes later at the end."""

    def __init__(self, checks: ChannelChecks, say: Callable[[str], None] = lambda line: None) -> None:
        self._checks = checks
        self._say = say
        self._said: set[str] = set()
        self._due = SOON

    def watch(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """The same blocks."""
        for block in blocks:
            self._checks.push(block)
            if self._checks.last - self._checks.first >= self._due:
                self._due = math.inf
                self._report()
            yield block
        self._report()

    @property
    def warnings(self) -> list[str]:
        """What is grave by now."""
        return [line for _, line in joined(remark for remark in self._checks.remarks() if remark.grave)]

    def _report(self) -> None:
        for line in self.warnings:
            if line not in self._said:
                self._said.add(line)
                self._say(line)


def check(system: Given, data: Data) -> Check:
    """Whether a capture is worth estimating from.

    It says what is the matter with its channels, and what its motion determines. system: described, or its name or
    file. data: a capture, the path of one, of a log or of a recording, or blocks of samples in order of time. Rates,
    stamps and resolutions are compared with the description; stuck, saturated and wrapped channels are named, those
    with outliers, encoders of one joint that do not turn alike, and channels that nobody reads. InputError where the
    data cannot be read.
    """
    system, folder = given_system(system)
    recorded = recorded_session(system, data, folder)
    source = recorded.source
    checks = ChannelChecks(system, source.channels)
    remarks: list[Remark] = []
    estimator: Estimator | None = None
    try:
        estimator = Estimator(system, tuple(source.channels), recorded.name)
        remarks += [Remark(name, "nobody reads it", False) for name in estimator.sensing.unused]
    except InputError as error:
        remarks.append(Remark("", f"cannot be estimated from: {error.found}; expected {error.expected}", True))
    remarks += [Remark(name, "described, but not there", False) for name in checks.absent]
    # A torque may jump for one sample: those of drives are counted here, the estimator leaves out the others.
    drives = drive_channels(system)
    outliers = Outliers(len(source.channels), [k for k, name in enumerate(source.channels) if name in drives])
    for block in source:
        checks.push(block)
        outliers.push(block.t, block.values)
        if checks.other_unit_of_time is not None:
            estimator = None  # it would interpolate a thousand samples between two, for minutes
        if estimator is not None:
            estimator.push(block)
    outliers.push(np.empty(0), np.empty((0, len(source.channels))), last=True)
    remarks += checks.remarks()
    remarks += [Remark("", warning, False) for warning in source.warnings]
    determined, explained = ({}, True) if estimator is None else _determined(estimator)
    remarks += _outlier_remarks({} if estimator is None else estimator.outliers, True)
    remarks += _outlier_remarks(outliers.found(source.channels), False)
    if estimator is not None and not any(share < SIGN_UNKNOWN for share in determined.values()):
        remarks.append(Remark("", "the motion determines no parameter", True))
    elif not explained:
        determined = {}
        remarks.append(Remark("", NOT_EXPLAINED, True))
    channels = {
        each.name: CheckedChannel(
            each.name,
            each.unit,
            each.samples,
            1.0 / each.measured_period if each.measured_period else None,
            each.low if each.samples else math.nan,
            each.high if each.samples else math.nan,
        )
        for each in checks.checks
    }
    return Check(system.name, recorded.name, checks.last - checks.first, channels, tuple(remarks), determined)


def _outlier_remarks(outliers: Mapping[str, LeftOut], left_out: bool) -> Iterator[Remark]:
    """Remarks on outliers by channel; left_out: of the estimate, which suffers where they are many."""
    for channel, found in outliers.items():
        what = "outliers left out" if left_out else "outliers"
        many = left_out and found.number > MANY_OUTLIERS * found.of
        yield Remark(channel, f"{found.number} {what}, the first at {found.first:.3f} s", many)


def _determined(estimator: Estimator) -> tuple[dict[str, float], bool]:
    """Standard deviation of each parameter relative to its size, %; and whether they explain any torque.

    inf where it is not determined.
    """
    estimator.finish()
    now = evaluated(estimator)
    estimate = now.estimate
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(estimate.determined, 100.0 * estimate.std / np.abs(estimate.pi), np.inf)
    names = [parameter.name for parameter in estimator.base.parameters]
    return dict(zip(names, share.tolist(), strict=True)), not now.explains_nothing
