"""Tables of text: a header somewhere near the top, commas, semicolons or tabs, decimal points or commas."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv

from sms_adapters.lines import CHUNK, LineReader
from sms_adapters.log_tables import Chunk, missing, stamps_of
from sms_adapters.raw import one_line
from sms_online.errors import InputError

# What a program says of itself may come before the header, but not more lines of it.
HEADER_LINES = 100
SEPARATORS = (",", ";", "\t")
_NUMBER = re.compile(r"\s*([-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf(inity)?))?\s*", re.IGNORECASE)
_WHOLE = re.compile(r"-?\d+")


@dataclass(frozen=True)
class _Layout:
    """How a file is written. places: of the wanted columns among `names`, the stamp's first. whole: stamps are whole
    numbers. comma: the decimal sign of the first row is one."""

    separator: str
    names: list[str]
    places: list[int]
    whole: bool
    comma: bool


class CsvTable:
    """A CSV file with any header, also as .gz: a `Table`. on_bytes: called with the bytes consumed so far."""

    def __init__(self, path: Path, on_bytes: Callable[[int], None] | None) -> None:
        self._path = path
        self._lines = LineReader(path, on_bytes)

    @property
    def warnings(self) -> Sequence[str]:
        """See `Table`."""
        return self._lines.warnings

    def chunks(self, stamp: str, columns: Sequence[str]) -> Iterator[Chunk]:
        """See `Table`."""
        wanted = list(dict.fromkeys((stamp, *columns)))
        layout: _Layout | None = None
        for line, chunk in self._lines:
            text = bytes(chunk)
            if layout is None:
                number, layout = self._layout(text, wanted)
                text = text.split(b"\n", number)[number]
                line += number
            if not text.strip():
                continue
            table = self._parse(text, line, layout)
            values = [np.asarray(table.column(wanted.index(name)).to_numpy(), dtype=np.float64) for name in columns]
            yield stamps_of(table.column(0)), np.column_stack(values)

    def _layout(self, text: bytes, wanted: Sequence[str]) -> tuple[int, _Layout]:
        """Lines up to the header, it included, and how the file is written."""
        lines = text.decode("utf-8-sig", "replace").split("\n")
        best: list[str] = []  # the names of the line that has most of the wanted columns
        for number, line in enumerate(lines[:HEADER_LINES], start=1):
            for separator in SEPARATORS:
                names = [name.strip() for name in _cells(line, separator)]
                best = max(best, names, key=lambda each: len(set(each) & set(wanted)))
                if not set(wanted) <= set(names):
                    continue
                twice = next((name for name in wanted if names.count(name) > 1), None)
                if twice is not None:
                    raise InputError(str(self._path), f"line {number}", f"column {twice!r} twice", "it once")
                places = [names.index(name) for name in wanted]
                below = next((row for row in lines[number:] if row.strip()), "")
                cells = _cells(below, separator)
                whole = len(cells) > places[0] and bool(_WHOLE.fullmatch(cells[places[0]].strip()))
                return number, _Layout(separator, names, places, whole, "," in below)
        absent = next(name for name in wanted if name not in best)
        if set(best) & set(wanted):
            raise missing(self._path, absent, best)
        found = f"no header with a column {absent!r}, line 1 is {lines[0].strip()[:60]!r}"
        raise InputError(str(self._path), "", found, "names with commas, semicolons or tabs between them, in UTF-8")

    def _parse(self, text: bytes, line: int, layout: _Layout) -> pa.Table:
        """The wanted columns of whole lines; InputError names the first line that does not fit."""
        stamp = str(layout.places[0])
        types = {str(k): pa.float64() for k in layout.places}
        # Stamps of 0, 0.001, … are whole at first only, and only cells that are not whole show the decimal sign.
        kinds = (pa.int64(), pa.float64()) if layout.whole else (pa.float64(),)
        signs = (False,) if layout.separator == "," else (layout.comma, not layout.comma)
        for kind, comma in product(kinds, signs):
            try:
                return self._columns(text, types | {stamp: kind}, layout, comma)
            except pa.ArrowInvalid as error:
                wrong = error
        raise self._explained(text, line, layout, wrong)

    def _columns(self, text: bytes, types: dict[str, pa.DataType], layout: _Layout, comma: bool) -> pa.Table:
        return pyarrow.csv.read_csv(
            pa.py_buffer(text),
            # A block that holds the whole text; columns are named by their place, for names may come twice.
            read_options=pyarrow.csv.ReadOptions(
                use_threads=False, column_names=[str(k) for k in range(len(layout.names))], block_size=CHUNK
            ),
            parse_options=pyarrow.csv.ParseOptions(delimiter=layout.separator),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types=types,
                include_columns=[str(k) for k in layout.places],
                decimal_point="," if comma else ".",
            ),
        )

    def _explained(self, text: bytes, line: int, layout: _Layout, error: Exception) -> InputError:
        """InputError for the first line that is to blame."""
        lines = text.decode("utf-8", "replace").split("\n")
        for number, row in enumerate((_cells(each, layout.separator) for each in lines), start=line):
            if row and len(row) != len(layout.names):
                expected = f"{len(layout.names)}, as in the header"
                return InputError(str(self._path), f"line {number}", f"{len(row)} cells", expected)
            for k in layout.places if row else ():
                if not _NUMBER.fullmatch(row[k] if layout.separator == "," else row[k].replace(",", ".")):
                    where = f"line {number}, column {layout.names[k]}"
                    return InputError(str(self._path), where, repr(row[k][:40]), "a number or nothing")
        return InputError(str(self._path), "", one_line(error), "a table of numbers")


def _cells(line: str, separator: str) -> list[str]:
    """Cells of a line; one that holds all of it where it is no line of a table."""
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return [line]
