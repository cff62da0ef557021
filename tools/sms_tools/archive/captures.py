"""Every capture under a folder, identified and diagnosed, as a table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from time import process_time
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sms_adapters.files import writing
from sms_adapters.recorded import captured, recorded_at
from sms_adapters.runs import NAME as RESULTS
from sms_adapters.sources import NAMES, is_recorded, open_source
from sms_online.description.parse import describe
from sms_online.description.schema import System
from sms_online.diagnosed import diagnose
from sms_online.errors import InputError
from sms_online.session import estimate
from sms_tools.archive.rows import Row, RowFile
from sms_tools.archive.runner import finished
from sms_tools.results_file import write_document

ROWS, TABLE = "archive.jsonl", "archive.parquet"
DIAGNOSIS = "diagnosis.json"


def captures_under(folder: Path) -> list[Path]:
    """Captures, logs and recordings under a folder, by name; InputError where there is none."""
    if not folder.is_dir():
        raise InputError(str(folder), "", "no folder", "a folder with captures")
    out = sorted(_captures(folder))
    if not out:
        raise InputError(str(folder), "", "no capture in it or below it", NAMES)
    return out


def _captures(folder: Path) -> Iterator[Path]:
    """What can be read, but for what an archive has written."""
    if is_recorded(folder):
        yield folder
    elif folder.is_dir() and not (folder / ROWS).is_file():
        for path in folder.iterdir():
            yield from _captures(path)


def archive(
    folder: Path,
    system: System,
    directory: Path | None,
    out: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[Row, int, int], None] = lambda row, done, of: None,
) -> list[Row]:
    """Rows of all captures under a folder, by name; those that an earlier run has finished are taken from it.

    directory: where the system file lies, to find its DBC. out: where rows, table, and results.json and diagnosis.json
    of each capture go. workers, scheduler: see `finished`. progress: is called with each new row, how many are done,
    and of how many. A capture is done again where it or the system has changed.
    """
    paths = {str(path.relative_to(folder)): path for path in captures_under(folder)}
    identity = hashlib.sha256(json.dumps(describe(system), sort_keys=True).encode()).hexdigest()[:16]
    states = {name: f"{_state(path)} {identity}" for name, path in paths.items()}
    file = RowFile(out / ROWS)
    rows = {row["capture"]: row for row in file.read() if states.get(row["capture"]) == row["state"]}
    missing = {
        name: (path.absolute(), system, directory, (out / name).absolute())
        for name, path in paths.items()
        if name not in rows
    }
    for name, row in finished(identify, missing, workers=workers, scheduler=scheduler):
        rows[name] = {"capture": name, "state": states[name], **row}
        file.append(rows[name])
        progress(rows[name], len(rows), len(paths))
    ordered = [rows[name] for name in paths]
    write_table(out / TABLE, ordered)
    return ordered


def _state(path: Path) -> str:
    """Changes when a capture does; of a recording, when any of its files does."""
    stats = [each.stat() for each in (sorted(path.iterdir()) if path.is_dir() else [path])]
    return f"{sum(stat.st_size for stat in stats)} {max(stat.st_mtime_ns for stat in stats)}"


def identify(path: Path, system: System, directory: Path | None, out: Path) -> Row:
    """The row of a capture: what is estimated, and what the diagnosis says; results.json and diagnosis.json in `out`.

    Raises InputError where the capture cannot be read; that it cannot be diagnosed is said in the row.
    """
    begin = process_time()
    capture = captured(recorded_at(path, open_source(path, system, directory=directory)))
    result = estimate(system, capture)
    write_document(out / RESULTS, result.to_json())
    row: Row = {
        "error": None,
        "trust": result.trust.level,
        "reason": result.trust.sentence,
        "samples": result.samples,
        "duration_s": result.duration,
        "lost_samples": result.lost_samples,
        "method": result.method,
        "events": len(result.events),
        "parameters": {p.name: [p.value, p.std] for p in result.parameters.values() if p.determined},
        "verdict": None,
        "summary": None,
        "effects": [],
    }
    try:
        found = diagnose(system, capture)
    except InputError as error:
        row["error"] = f"not diagnosed: {error}"
    else:
        write_document(out / DIAGNOSIS, found.to_json())
        row |= {"verdict": found.verdict, "summary": found.summary, "effects": [e.effect for e in found.effects]}
    return row | {"seconds": process_time() - begin}


# Columns of the table before those of the parameters.
COLUMNS: Mapping[str, pa.DataType] = {
    "capture": pa.string(),
    "error": pa.string(),
    "trust": pa.string(),
    "reason": pa.string(),
    "verdict": pa.string(),
    "summary": pa.string(),
    "effects": pa.list_(pa.string()),
    "method": pa.string(),
    "events": pa.int64(),
    "samples": pa.int64(),
    "lost_samples": pa.int64(),
    "duration_s": pa.float64(),
    "seconds": pa.float64(),
}


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as Parquet: COLUMNS, then `<parameter>` and `<parameter>.std`; null where there is no value."""
    names = dict.fromkeys(name for row in rows for name in row.get("parameters") or ())
    columns = {name: pa.array([row.get(name) for row in rows], kind) for name, kind in COLUMNS.items()}
    for name in names:
        pairs = [(row.get("parameters") or {}).get(name, (None, None)) for row in rows]
        for label, values in zip((name, f"{name}.std"), zip(*pairs, strict=True), strict=True):
            columns[label] = pa.array(values, pa.float64())
    with writing(path) as part:
        pq.write_table(pa.table(columns), part)
