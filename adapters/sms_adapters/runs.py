"""Results of finished sessions: results.json by file or by the folder of the run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from sms_adapters.files import read_json
from sms_online.errors import InputError
from sms_online.repeatability import Comparison, compare_documents
from sms_online.result import SCHEMA, Result

NAME = "results.json"


def compare(results: Iterable[Result | str | Path] | Mapping[str, Result | str | Path]) -> Comparison:
    """Compare sessions of one rig: which parameters changed in which of them.

    results: results, or results.json files, or folders of runs; as a mapping, by the name of the session. Three and
    more are judged against their spread from run to run, two against their error bars.
    InputError where a file is no results.json, or where there are fewer than two sessions, or of different systems.
    """
    named = dict(results) if isinstance(results, Mapping) else _named(list(results))
    return compare_documents(
        {
            name: each.document() if isinstance(each, Result) else read_results(Path(each))
            for name, each in named.items()
        }
    )


def _named(results: list[Result | str | Path]) -> dict[str, Result | str | Path]:
    """Results by the folder of the run, or by the whole path where two have the same; those without one by number."""
    paths = [None if isinstance(each, Result) else _folder(Path(each)) for each in results]
    short = [str(k) if path is None else path.name for k, path in enumerate(paths, start=1)]
    names = [
        name if path is None or short.count(name) == 1 else str(path) for name, path in zip(short, paths, strict=True)
    ]
    for name in names:
        if names.count(name) > 1:
            raise InputError(name, "", "the same run twice", "each run once")
    return dict(zip(names, results, strict=True))


def _folder(path: Path) -> Path:
    return path.absolute().parent if path.name == NAME else path.absolute()


def read_results(path: Path) -> dict[str, Any]:
    """The document of a results.json, or of the one in a folder; InputError where it is none."""
    file = path / NAME if path.is_dir() else path
    document = read_json(file, "the results of a run")
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise InputError(str(file), "schema", "no results of a session", f"{SCHEMA!r}")
    return document
