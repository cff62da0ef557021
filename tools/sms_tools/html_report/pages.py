"""Pages from templates: one file each that needs nothing else, to be read long after the session."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from sms_adapters.files import write_text
from sms_tools.html_report.figures import PALETTE
from sms_tools.html_report.parameter_rows import breakable, with_subscripts


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
    return write_text(path, _environment().get_template(template).render(content))
