"""Results as people and programs read them: digits by their standard deviation, plain tables, JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from html import escape
from typing import Any

# Significant digits of an estimate: as many as show two of its standard deviation, within these bounds.
LEAST_DIGITS, MOST_DIGITS = 2, 7
# Powers of ten below this one are written as such.
SMALLEST_PLAIN = -4


def formatter(estimate: float, std: float) -> Callable[[float], str]:
    """Formats an estimate and its interval down to the second digit of the standard deviation."""
    magnitude = math.floor(math.log10(abs(estimate))) if estimate else 0
    second = math.floor(math.log10(std)) - 1 if std else -math.inf
    digits = int(min(MOST_DIGITS, max(LEAST_DIGITS, magnitude - second + 1)))
    if magnitude < SMALLEST_PLAIN:
        return lambda value: f"{value:.{digits - 1}e}"
    return lambda value: f"{value:.{max(0, digits - 1 - magnitude)}f}"


def text_table(headings: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Rows below their headings, columns aligned; the first `left` of them to the left."""
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]

    def line(cells: Sequence[str]) -> str:
        aligned = [
            cell.ljust(width) if k < left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        return "  ".join(aligned).rstrip()

    return "\n".join(line(cells) for cells in (headings, *rows))


def html_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The same as a table of HTML, its cells escaped."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in headings)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>" for cells in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def finite(value: float) -> float | None:
    """A number as JSON knows it: None where it is infinite or none."""
    return value if math.isfinite(value) else None


def json_text(document: Any) -> str:
    """A document as text; JSON knows no infinity and no NaN, which become null."""
    return json.dumps(_finite(document), indent=2, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return finite(value) if isinstance(value, float) else value


class Documented:
    """A result that is written as a document of JSON."""

    def document(self) -> dict[str, Any]:
        """The same as plain lists, dictionaries and numbers."""
        raise NotImplementedError

    def to_json(self) -> str:
        """The document as text; numbers that do not exist are null."""
        return json_text(self.document())


class Table:
    """What is read as a table, on a terminal and in a notebook; its first `LEFT` columns are aligned left."""

    LEFT = 2

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """Headings, and a row of cells for each line of the table."""
        raise NotImplementedError

    @property
    def sentence(self) -> str:
        """What the table says, in a sentence."""
        return ""

    def __str__(self) -> str:
        return "\n\n".join(filter(None, (text_table(*self.rows(), left=self.LEFT), self.sentence)))

    __repr__ = __str__

    def _repr_html_(self) -> str:
        said = f"<p><b>{escape(self.sentence)}</b></p>" if self.sentence else ""
        return said + html_table(*self.rows())


class Tabled(Table, Documented):
    """A result that is read as a table, and written as a document of JSON."""
