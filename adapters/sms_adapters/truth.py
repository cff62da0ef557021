"""The truth of a simulated capture, in CAPTURE.truth.json beside it: for the report alone, never for the estimator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sms_adapters.files import read_json, write_text
from sms_online.errors import InputError

SCHEMA = "sms-online/truth/1"


def truth_path(capture: Path) -> Path:
    """Where the truth of a capture lies: its full name with .truth.json after it."""
    return capture.with_name(capture.name + ".truth.json")


def write_truth(capture: Path, parameters: dict[str, float], extra: dict[str, Any]) -> None:
    """Write the truth of a capture beside it.

    parameters: name to value, SI units. extra: what else describes the simulation, JSON values. Raises ValueError for
    an infinite value, NaN, or a key of extra that the document itself uses.
    """
    document = {"schema": SCHEMA, "parameters": parameters}
    if taken := document.keys() & extra.keys():
        raise ValueError(f"extra must not hold {sorted(taken)}")
    write_text(truth_path(capture), json.dumps(document | extra, indent=2, allow_nan=False) + "\n")


def read_truth(capture: Path) -> dict[str, Any] | None:
    """The truth beside a capture, None where there is none. InputError: it is no such document."""
    path = truth_path(capture)
    if not path.is_file():
        return None
    document = read_json(path, f"a document of schema {SCHEMA}")
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        found = document.get("schema") if isinstance(document, dict) else type(document).__name__
        raise InputError(str(path), "schema", repr(found), SCHEMA)
    parameters = document.get("parameters")
    if not isinstance(parameters, dict) or not all(isinstance(value, float | int) for value in parameters.values()):
        raise InputError(str(path), "parameters", repr(parameters)[:40], "a table of name to number")
    return document
