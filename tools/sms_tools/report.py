"""results.json as a person reads it: a table of the parameters, then how far to trust it."""

from __future__ import annotations

import math
import sys
from typing import Any

from rich.console import Console
from rich.table import Table

# Width of a table that goes to a file or a pipe, where there is no terminal to ask.
FILE_WIDTH = 140
# Digits of an estimate: two of its standard deviation are meant to be seen, no fewer and no more than these in all.
LEAST_DIGITS, MOST_DIGITS = 2, 7
NOT_DETERMINED = "not determined"

Document = dict[str, Any]


def report_console(json: bool) -> Console:
    """Where people read: stdout, or stderr where stdout belongs to a JSON document."""
    stream = sys.stderr if json else sys.stdout
    return Console(file=stream, width=None if stream.isatty() else FILE_WIDTH, highlight=False)


def show(console: Console, *parts: Table | str) -> None:
    """Print; raises BrokenPipeError, which rich itself would turn into an exit code of its own."""
    with console.capture() as capture:
        for part in parts:
            console.print(part, markup=False, soft_wrap=isinstance(part, str))
    console.file.write(capture.get())


def parameter_table(document: Document, title: str | None = None) -> Table:
    """Parameter, unit, estimate ± std, 95 % interval, and the truth and the error where it is known."""
    parameters = document["parameters"]
    simulated = any(p["true"] is not None for p in parameters)
    table = Table(title=title, title_justify="left", box=None, header_style="bold", pad_edge=False)
    table.add_column("parameter", overflow="fold")
    table.add_column("unit")
    for heading in ("estimate", "± std", "95 % interval"):
        table.add_column(heading, justify="right")
    if simulated:
        table.add_column("true", justify="right")
        table.add_column("error %", justify="right")
    for p in parameters:
        cells = [p["name"], p["unit"], NOT_DETERMINED, "", ""]
        digits = MOST_DIGITS
        if p["identifiable"]:
            digits = _digits(p["estimate"], p["std"])
            interval = f"{_number(p['lower95'], digits)} … {_number(p['upper95'], digits)}"
            cells[2:] = _number(p["estimate"], digits), f"{p['std']:.2g}", interval
        if simulated:
            cells.append("" if p["true"] is None else f"{p['true']:.6g}")
            cells.append(_error(p))
        table.add_row(*cells, style=None if p["identifiable"] else "dim")
    return table


def _digits(estimate: float, std: float) -> int:
    """Significant digits that end with the second one of the standard deviation."""
    if estimate == 0.0 or std == 0.0:
        return MOST_DIGITS
    digits = math.floor(math.log10(abs(estimate))) - math.floor(math.log10(std)) + 2
    return min(MOST_DIGITS, max(LEAST_DIGITS, digits))


def _number(value: float, digits: int) -> str:
    """With trailing zeros, which say how well it is known."""
    return f"{value:#.{digits}g}".rstrip(".")


def _error(p: Document) -> str:
    if not p["identifiable"] or not p["true"]:
        return ""
    return f"{100.0 * (p['estimate'] / p['true'] - 1.0):+.2g}"


def trust_lines(document: Document) -> list[str]:
    """Residual, condition number, amount of data, throughput and warnings, a line each."""
    lines = []
    for rows, residual in document["residual"].items():
        if residual["relative"] is not None:
            lines.append(f"residual {rows}: {residual['relative']:.3g} of the measured torque or force")
        if residual["whitened"] is not None:
            lines.append(f"residual {rows}: {residual['whitened']:.3g} of its predicted deviation")
    condition = document["condition_number"]
    full_rank = condition is not None and math.isfinite(condition)
    lines.append(f"condition number: {condition:.3g}" if full_rank else "condition number: infinite")
    lost = document["lost_samples"]
    lines.append(f"samples: {document['samples']} in {document['duration_s']:.6g} s, {lost} lost")
    lines.append(f"throughput: {document['throughput_samples_per_s']:,.0f} samples/s")
    return lines + [f"warning: {warning}" for warning in document["warnings"]]
