"""Captures: CSV files `t,<channel>,…`, one row per sample in SI units, an empty cell for what was not sampled then."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv

from sms_adapters.files import WholeFile
from sms_adapters.lines import CHUNK, LineReader, sampled_line
from sms_online.description.explain import expected_channel
from sms_online.errors import InputError
from sms_online.stream import Array, Block, Indices

BLOCK = 16384  # rows: most that one block holds
# Beyond all that a testbed has in SI units, and small enough that products of a few of them are numbers.
LARGEST = 1e30
# Seconds since 1970 until the year 2286; a time beyond that is none.
LATEST = 1e10
# A channel lacks samples where it has none for so many times its mean interval: one lost sample makes two. At either
# end it may have none for more, for devices do not begin and end together.
LACKING, AT_AN_END = 1.5, 10.0
_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*")


class CaptureReader:
    """A capture file, .csv or .csv.gz, as blocks in order of time; each iteration starts from its beginning.

    on_bytes: called with the bytes of the file consumed so far. known: the channels that mean something to the caller;
    others are errors. One chunk of text is held at a time.

    Empty and NaN cells are NaN in the block, a later sample with an equal time is skipped, and so is a last line that
    does not end in a newline; each is counted in `warnings`, but for cells between the samples of a slower channel.
    Raises InputError, on construction for the file and its header, while iterating for a malformed line, a value beyond
    all sense, a time that is missing or goes back, or no sample at all. Rows of earlier chunks are out by then.
    """

    def __init__(
        self,
        path: Path,
        on_bytes: Callable[[int], None] | None = None,
        known: Sequence[str] | None = None,
    ) -> None:
        self._path = path
        self._lines = LineReader(path, on_bytes)
        self._channels = _header(path, LineReader(path).first_line())
        if known is not None:
            for channel in self._channels:
                if channel not in known:
                    expected = expected_channel(channel, known)
                    raise InputError(str(path), "line 1", f"unknown channel {channel!r}", expected)
        self._reset()

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the columns after t."""
        return self._channels

    @property
    def warnings(self) -> list[str]:
        """What the current iteration has skipped or left empty so far."""
        found = []
        alike: dict[tuple[int, str], list[str]] = {}
        for channel, sampled in zip(self._channels, self._sampled, strict=True):
            start = sampled.hole(self._last) if self._rows else None
            if start is not None:
                where = f", the longest hole from {start:.6g} s on" if sampled.count else ""
                alike.setdefault((self._rows - sampled.count, where), []).append(channel)
        for (count, where), channels in alike.items():
            cells = f"{count} of {self._rows} cells empty or NaN in {', '.join(channels)}"
            found.append(f"{self._path.name}: {cells}{where}")
        if self._repeated:
            found.append(f"{self._path.name}: {self._repeated} samples skipped, their time repeats the one before")
        return found + self._lines.warnings

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks from the capture's beginning."""
        self._reset()
        last = -math.inf
        for line, chunk in self._lines:
            if line == 1:
                line, chunk = 2, chunk[bytes(chunk).index(b"\n") + 1 :]
            rows = self._parse(line, chunk)
            if not len(rows):
                continue
            t = rows[:, 0]
            step = np.diff(t, prepend=last)
            if not (step > 0).all():
                self._check_times(line, chunk, t, step)
                rows = rows[step > 0]
                self._repeated += int(t.size - len(rows))
                t = rows[:, 0]
                if not t.size:
                    continue
            self._last = last = float(t[-1])
            for sampled, column in zip(self._sampled, rows[:, 1:].T, strict=True):
                sampled.add(t, np.flatnonzero(~np.isnan(column)), self._rows)
            self._rows += len(rows)
            yield from Block(t, self._channels, rows[:, 1:]).pieces(BLOCK)
        if not self._rows:
            raise InputError(str(self._path), "", "no samples", "at least one row below the header")

    def _reset(self) -> None:
        self._rows = 0
        self._repeated = 0
        self._last = -math.inf
        self._sampled = [_Sampled() for _ in self._channels]

    def _parse(self, line: int, chunk: memoryview) -> Array:
        """(rows, 1 + C) of whole lines of text, t first; InputError names the first malformed line."""
        names = ("t", *self._channels)
        try:
            rows = _parse(chunk, names)
        except pa.ArrowInvalid:
            lines = bytes(chunk).splitlines()
            k = _first_malformed(lines, names)
            raise self._malformed(line + k, lines[k].decode("utf-8", "replace").split(",")) from None
        too_large = np.abs(rows) > np.array([LATEST, *[LARGEST] * len(self._channels)])
        if too_large.any():
            number, text = sampled_line(line, chunk, int(too_large.any(axis=1).argmax()))
            raise self._malformed(number, text.split(","))
        return rows

    def _malformed(self, line: int, cells: list[str]) -> InputError:
        names = ("t", *self._channels)
        place = f"line {line}"
        if len(cells) != len(names):
            return InputError(str(self._path), place, f"{len(cells)} cells", f"{len(names)}, as in the header")
        for name, cell in zip(names, cells, strict=True):
            if cell and cell.strip().lower() != "nan":
                where, most = f"{place}, column {name}", LATEST if name == "t" else LARGEST
                if not (_NUMBER.fullmatch(cell) and math.isfinite(float(cell))):
                    return InputError(str(self._path), where, repr(cell[:40]), "a finite number or nothing")
                if abs(float(cell)) > most:
                    return InputError(str(self._path), where, repr(cell[:40]), f"a number of {most:g} at most")
        return InputError(str(self._path), place, repr(",".join(cells)[:40]), "plain decimal numbers")

    def _check_times(self, line: int, chunk: memoryview, t: Array, step: Array) -> None:
        """InputError where a time is missing or before the one above; equal times pass."""
        wrong = ~(step >= 0)
        if wrong.any():
            number, text = sampled_line(line, chunk, int(wrong.argmax()))
            cell = text.split(",", 1)[0]
            found = "no time" if math.isnan(t[wrong.argmax()]) else f"time {cell} s, before that of the line above"
            raise InputError(str(self._path), f"line {number}", found, "times that do not go back")


class _Sampled:
    """When a channel was sampled, and the longest hole of empty cells between: its length and beginning, s."""

    def __init__(self) -> None:
        self.count, self._hole = 0, (0.0, math.nan)
        self._begin = self._first = self._last = math.nan
        self._row = 0

    def add(self, t: Array, filled: Indices, row: int) -> None:
        """Take the next rows at t (B,), those `filled` with a sample; row: how many came before."""
        if not row:
            self._begin = float(t[0])
        if not filled.size:
            return
        if not self.count:
            self._first = self._last = float(t[filled[0]])
            self._row = int(filled[0]) + row
        at, rows = np.append(self._last, t[filled]), np.append(self._row, filled + row)
        holes = np.diff(at) * (np.diff(rows) > 1)
        longest = int(holes.argmax())
        self._hole = max(self._hole, (float(holes[longest]), float(at[longest])))
        self.count += filled.size
        self._last, self._row = float(at[-1]), int(rows[-1])

    def hole(self, end: float) -> float | None:
        """Where the longest hole begins, s, up to the last row's time; None where it is the channel's own interval."""
        if not self.count:
            return self._begin
        own = (self._last - self._first) / max(1, self.count - 1)
        at_ends = (self._first - self._begin, self._begin), (end - self._last, self._last)
        holes = [each for each in at_ends if each[0] > AT_AN_END * own]
        if self._hole[0] > LACKING * own:
            holes.append(self._hole)
        return max(holes)[1] if holes else None


class CaptureWriter(WholeFile):
    """Writes blocks as a capture; the file appears under its name when the context ends without an error.

    Floats are written as the shortest text that reads back to the same bits, NaN as an empty cell.
    Raises InputError where the file cannot be made or is not named .csv.
    """

    def __init__(self, path: Path, channels: tuple[str, ...]) -> None:
        if path.suffix != ".csv":
            raise InputError(str(path), "", f"a capture named {path.name}", "a name ending in .csv or .mcap")
        super().__init__(path)
        self._names = ("t", *channels)
        self._file.write((",".join(self._names) + "\n").encode())
        self._csv = pyarrow.csv.CSVWriter(
            self._file,
            pa.schema([(name, pa.float64()) for name in self._names]),
            write_options=pyarrow.csv.WriteOptions(include_header=False, quoting_style="none"),
        )

    def write(self, block: Block) -> None:
        """Append the rows of a block; ValueError where its channels are not the file's."""
        if block.channels != self._names[1:]:
            raise ValueError(f"block of {block.channels} for a capture of {self._names[1:]}")
        columns = [pa.array(column, from_pandas=True) for column in (block.t, *block.values.T)]
        self._csv.write(pa.table(columns, names=list(self._names)))

    def _complete(self) -> None:
        self._csv.close()


def _header(path: Path, line: str) -> tuple[str, ...]:
    """The channels of a header line; InputError where it is none."""
    names = [name.strip() for name in line.split(",")]
    expected = "a header t,<channel>,…"
    if all(_NUMBER.fullmatch(name) or name.lower() in ("", "nan") for name in names):
        raise InputError(str(path), "line 1", f"no header but {line[:40]!r}", expected)
    if names[0] != "t":
        raise InputError(str(path), "line 1", f"first column {names[0]!r}", f"{expected}, with t in seconds")
    if len(names) == 1:
        raise InputError(str(path), "line 1", "no channel after t", expected)
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise InputError(str(path), "line 1", f"column {repeated[0]!r} twice", "each channel once")
    if "" in names:
        raise InputError(str(path), f"line 1, column {names.index('') + 1}", "a column without a name", expected)
    return tuple(names[1:])


def _parse(text: memoryview, names: tuple[str, ...]) -> Array:
    """(rows, columns) float64 of whole lines, NaN for empty cells; blank lines are passed over. Raises ArrowInvalid."""
    if not text:
        return np.empty((0, len(names)))
    table = pyarrow.csv.read_csv(
        pa.py_buffer(text),
        # A block that holds the whole text: it is parsed in one go and on this thread.
        read_options=pyarrow.csv.ReadOptions(use_threads=False, column_names=names, block_size=CHUNK),
        parse_options=pyarrow.csv.ParseOptions(quote_char=False),
        convert_options=pyarrow.csv.ConvertOptions(
            column_types={name: pa.float64() for name in names}, null_values=[""]
        ),
    )
    rows = np.empty((table.num_rows, len(names)))
    for k, column in enumerate(table.columns):
        rows[:, k] = column.to_numpy()
    return rows


def _first_malformed(lines: list[bytes], names: tuple[str, ...]) -> int:
    """Index of the first line that does not parse, by halving: the parser itself finds it, not a second grammar."""
    good, bad = 0, len(lines)  # lines[:good] parse, lines[:bad] do not
    while bad - good > 1:
        middle = (good + bad) // 2
        try:
            _parse(memoryview(b"\n".join([*lines[good:middle], b""])), names)
            good = middle
        except pa.ArrowInvalid:
            bad = middle
    return good
