"""Pages from templates: one file each that needs nothing else, to be read long after the session."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from sms_online.errors import InputError
from sms_online.tables import formatter
from sms_tools.html_report.figures import PALETTE
from sms_tools.report import NOT_DETERMINED, Document


@dataclass(frozen=True)
class Bar:
    """An error bar: where it begins and ends and where the estimate is, % of its cell's width; its colour's name.

    middle: none where the estimate is beyond the cell. below, above: whether the bar goes on beyond it.
    """

    start: float
    end: float
    middle: float | None
    color: str
    below: bool
    above: bool


def error_bar(deviation: float, bound: float, limit: float, color: str) -> Bar | None:
    """Deviation from a reference, and 2σ, on a scale of ± limit about it; none where one is not known."""
    if not np.isfinite((deviation, bound)).all():
        return None
    ends = np.array((deviation - bound, deviation + bound, deviation)) / limit
    start, end, middle = (50.0 + 50.0 * np.clip(ends, -1.0, 1.0)).round(1).tolist()
    seen = abs(deviation) <= limit
    return Bar(start, end, middle if seen else None, color, bool(ends[0] < -1.0), bool(ends[1] > 1.0))


def with_subscripts(symbol: str) -> Markup:
    """A parameter's symbol with its indices set low."""
    return Markup(re.sub("_([0-9A-Za-z]+)", r"<sub>\1</sub>", str(escape(symbol))))


def breakable(name: str) -> Markup:
    """A parameter's name that may go on in the next line after its dot, its at, or a body that is lumped into it."""
    return Markup(re.sub("([.@]|_and_)", r"\1<wbr>", str(escape(name))))


def estimate_cells(p: Document) -> tuple[str, str, str]:
    """Estimate, standard deviation and 95 % interval of a parameter of the results."""
    if not p["identifiable"]:
        return NOT_DETERMINED, "", ""
    shown = formatter(p["estimate"], p["std"])
    return shown(p["estimate"]), f"{p['std']:.2g}", f"{shown(p['lower95'])} … {shown(p['upper95'])}"


def number(value: float | None, form: str = ".3g") -> str:
    """A number, or nothing where there is none."""
    return "" if value is None or np.isnan(value) else format(value, form)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("sms_tools.html_report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["palette"] = PALETTE
    environment.filters |= {"with_subscripts": with_subscripts, "breakable": breakable, "number": number}
    return environment


def write_page(path: Path, template: str, **content: Any) -> Path:
    """A self-contained page of a template; InputError where it cannot be written."""
    text = _environment().get_template(template).render(content)
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise InputError(str(path), "", error.strerror or str(error), "a file that can be written") from None
    return path
