"""What was sampled together in a log: raw stamps and numbers to increasing times and channel values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_adapters.capture import LARGEST, LATEST
from sms_adapters.conversion import Conversions
from sms_adapters.log_paths import NANOSECONDS
from sms_adapters.log_tables import NO_STAMP
from sms_adapters.units import si_factor
from sms_online.description.channels import channel_unit
from sms_online.description.schema import System
from sms_online.description.sources import LogSignal, LogSource, TableSource
from sms_online.errors import InputError
from sms_online.stream import Array

_SECOND = NANOSECONDS["s"]


@dataclass
class Origin:
    """Instant of t = 0 of a file, ns.

    It is the first stamp where that is a whole number or a date. Other stamps are kept.
    """

    nanoseconds: int | None = None

    def seconds(self, stamps: NDArray[Any], unit: str) -> Array:
        """Times (B,), s, of stamps (B,) in a unit, to the nearest double; NaN where there is none.

        Whole stamps beyond LATEST are returned as they are: they cannot be in this unit.
        """
        if stamps.dtype.kind == "M":
            stamps, unit = stamps.astype("datetime64[ns]").astype(np.int64), "ns"
        if stamps.dtype.kind in "iu":
            there = stamps != NO_STAMP
            rough = np.where(there, stamps * (NANOSECONDS[unit] / _SECOND), np.nan)
            if not there.any() or np.nanmax(np.abs(rough)) > LATEST:
                return rough  # in ns they might overflow
            whole = stamps.astype(np.int64) * NANOSECONDS[unit]
            if self.nanoseconds is None:
                self.nanoseconds = int(whole[there][0])
            return np.where(there, (whole - self.nanoseconds) / _SECOND, np.nan)
        if self.nanoseconds is None:
            self.nanoseconds = 0
        seconds = stamps.astype(np.float64) / (_SECOND // NANOSECONDS[unit])
        return seconds - self.nanoseconds / _SECOND if self.nanoseconds else seconds


class Lane:
    """Signals with common stamps: a table, or one topic of a bag.

    place: of the lane in messages, after the file's name. signals: by column or path. InputError for a unit that does
    not fit. implausible: samples left out before they came here, for their stamps cannot be true.
    """

    def __init__(
        self,
        path: Path,
        system: System,
        source: LogSource,
        place: str,
        signals: Mapping[str, LogSignal],
    ) -> None:
        self.path = path
        self.place = place
        self.source = source
        self.keys = tuple(signals)
        self.channels = tuple(signal.channel for signal in signals.values())
        self.implausible = 0
        # A message may come late; a row of a table that goes back is damage.
        self._strict = isinstance(source, TableSource)
        self._counters = {"non_finite": 0, "out_of_range": 0}
        plain = [_plain(system, source, key, signal) for key, signal in signals.items()]
        self._conversions = Conversions(plain, self._counters)
        self._last = -math.inf
        self._rows = 0
        self._unstamped = self._repeated = self._back = 0
        self._sampled = np.zeros(len(self.keys), dtype=np.bool_)

    def rows(self, origin: Origin, stamps: NDArray[Any], unit: str, numbers: Array) -> tuple[Array, Array]:
        """Times (K,), s, increasing, and values (K, C) of stamps (B,) and numbers (B, C), NaN where there is none."""
        t = origin.seconds(stamps, unit)
        if (np.abs(t) > LATEST).any():
            expected = f'seconds, or stamp_unit = "ms", "µs" or "ns" in source {self.source.name}'
            raise InputError(str(self.path), self.place, f"a stamp of {t[np.abs(t) > LATEST][0]:g} s", expected)
        there = ~np.isnan(t)
        read = self._rows + self._unstamped
        self._unstamped += int(np.count_nonzero(~there))
        t, numbers = t[there], numbers[there]
        # The newest time before each row, by which one that repeats it or goes back is known.
        before = np.maximum.accumulate(np.concatenate(([self._last], t)))[:-1]
        back = t < before
        if self._strict and back.any():
            row = read + int(np.flatnonzero(there)[back.argmax()]) + 1
            found = f"row {row} has the time {t[back][0]:g} s, before that of the row above"
            raise InputError(str(self.path), self.place, found, "times that do not go back")
        self._back += int(np.count_nonzero(back))
        self._repeated += int(np.count_nonzero(t == before))
        self._rows += t.size
        fresh = t > before
        t, numbers = t[fresh], numbers[fresh]
        if t.size:
            self._last = float(t[-1])
        values = self._conversions(numbers)
        self._sampled |= ~np.isnan(values).all(axis=0)
        return t - self.source.latency, values

    def check(self) -> None:
        """InputError where a column or path gave no number at all, at the end of the file."""
        if not self._rows:
            raise InputError(str(self.path), self.place, "no rows with a stamp", "samples")
        for key, sampled in zip(self.keys, self._sampled.tolist(), strict=True):
            if not sampled:
                raise InputError(str(self.path), f"{self.place}, {key}", "no number within its limits", "samples")

    @property
    def warnings(self) -> list[str]:
        """What was skipped so far, counted."""
        name = f"{self.path.name}, {self.place}"
        cells = self._rows * len(self.keys)
        counted = (
            (self._unstamped, "rows skipped, they have no stamp"),
            (self._repeated, "samples skipped, their time repeats the one before"),
            (self._back, "samples skipped, their time is before that of the one before"),
            (self.implausible, "samples skipped, their stamps cannot be true"),
            (self._counters["non_finite"], f"of {cells} cells empty, NaN or infinite"),
            (self._counters["out_of_range"], "values skipped, outside the limits of their channel"),
        )
        return [f"{name}: {count} {what}" for count, what in counted if count]


def _plain(system: System, source: LogSource, key: str, signal: LogSignal) -> LogSignal:
    """The signal with unit and gear in its scale, and limits that any number in SI units is within."""
    unit = channel_unit(system, signal.channel)
    place = f"source {source.name}, {key}"
    factor = 1.0 if signal.unit is None else si_factor(signal.unit, unit, system.name, place)
    limits = {"minimum": -LARGEST if signal.minimum is None else signal.minimum}
    limits["maximum"] = LARGEST if signal.maximum is None else signal.maximum
    return signal.model_copy(update={"scale": signal.scale * factor / signal.gear, **limits})
