"""Captures in memory: samples of named channels, from files, tables or arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sms_online.description.explain import expected_channel
from sms_online.errors import InputError
from sms_online.stream import Array, Block, Mask

# Samples of a block that a capture is handed on in: few enough to show progress, many enough to cost nothing.
PIECE = 1024
TIME = "t"


@dataclass(frozen=True, eq=False)
class Capture:
    """N samples of C channels, in order of time; iterating gives them as blocks.

    t (N,): s, not decreasing. channels: C names, such as "tau_1" or "link_1.marker_2.u_y". values (N, C): SI
    units, NaN where a channel was not sampled at that instant. Both arrays are read-only. source: where it comes from,
    for messages. warnings: what was skipped or repaired when it was read. truth: of a simulation, as beside its file.
    Raises InputError where shapes do not fit, a channel has no name or comes twice, times go back, or a value is
    infinite.
    """

    t: Array
    channels: tuple[str, ...]
    values: Array
    source: str = "capture"
    warnings: tuple[str, ...] = ()
    truth: Mapping[str, Any] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        t, values = (_numbers(getattr(self, name), self.source, name) for name in ("t", "values"))
        channels = tuple(self.channels)
        if t.ndim != 1 or values.shape != (t.size, len(channels)):
            found = f"t of shape {t.shape} and values of shape {values.shape}"
            raise InputError(self.source, "", found, f"(N,) and (N, {len(channels)}), for {len(channels)} channels")
        if t.size == 0:
            raise InputError(self.source, "", "no samples", "at least one")
        for channel in channels:
            if not isinstance(channel, str) or not channel or channel == TIME or channels.count(channel) > 1:
                raise InputError(self.source, "channels", f"{channel!r}", "names of channels, each once, without t")
        _check_times(t, np.diff(t, prepend=-np.inf) < 0.0, self.source, "finite times that do not go back")
        infinite = np.argwhere(np.isinf(values))
        if infinite.size:
            at, column = infinite[0].tolist()
            expected = "a finite number, or NaN where there is no sample"
            raise InputError(self.source, f"sample {at + 1}, channel {channels[column]}", "an infinite value", expected)
        for array in (t, values):
            array.flags.writeable = False
        for name, value in (("t", t), ("values", values), ("channels", channels)):
            object.__setattr__(self, name, value)

    @staticmethod
    def from_arrays(t: ArrayLike, channels: Mapping[str, ArrayLike], source: str = "arrays") -> Capture:
        """A capture of arrays (N,) by channel name, sampled at t (N,), s.

        Raises InputError where lengths differ or times do not increase, and as `Capture` does.
        """
        times = _numbers(t, source, TIME)
        if times.ndim != 1:
            raise InputError(source, TIME, f"times of shape {times.shape}", "(N,)")
        columns = {name: _numbers(column, source, f"channel {name}") for name, column in channels.items()}
        for name, column in columns.items():
            if column.shape != times.shape:
                expected = f"as many as times, {times.shape}"
                raise InputError(source, f"channel {name}", f"samples of shape {column.shape}", expected)
        _check_times(times, np.diff(times, prepend=-np.inf) <= 0.0, source, "finite times, each after the one before")
        values = np.column_stack([*columns.values()]) if columns else np.empty((times.size, 0))
        return Capture(times, tuple(columns), values, source)

    @staticmethod
    def from_table(table: Any, source: str = "table") -> Capture:
        """A capture of a pandas DataFrame or a pyarrow Table: a column t, s, and one a channel; what is missing is NaN.

        Raises InputError where there is no column t or one that holds no numbers, and as `Capture` does.
        """
        names = [str(name) for name in getattr(table, "column_names", None) or table.columns]
        if TIME not in names:
            raise InputError(source, "columns", ", ".join(names) or "none", "a column t with times in seconds")
        columns = {name: _column(table[name]) for name in names}
        return Capture.from_arrays(columns.pop(TIME), columns, source)

    def __iter__(self) -> Iterator[Block]:
        return Block(self.t, self.channels, self.values).pieces(PIECE)

    def __len__(self) -> int:
        return int(self.t.size)


def _check_times(t: Array, wrong: Mask, source: str, expected: str) -> None:
    at = np.flatnonzero(~np.isfinite(t) | wrong)
    if at.size:
        raise InputError(source, f"sample {at[0] + 1}", f"time {t[at[0]]:g} s", expected)


def _numbers(values: ArrayLike, source: str, place: str) -> Array:
    """A copy as floats; InputError where they are none."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(source, place, str(error).splitlines()[0], "numbers") from None


def _column(column: Any) -> Any:
    """A column of a table, NaN where nothing is."""
    if hasattr(column, "isna"):  # of pandas, whose own missing values are no floats
        try:
            return column.to_numpy(dtype=np.float64, na_value=np.nan)
        except (TypeError, ValueError):
            return column.to_numpy()
    return column.to_numpy()


def check_channels(channels: tuple[str, ...], known: tuple[str, ...], source: str) -> None:
    """InputError for a channel that a system does not have, with the one that was probably meant."""
    for channel in channels:
        if channel not in known:
            raise InputError(source, "channels", f"unknown channel {channel!r}", expected_channel(channel, known))
