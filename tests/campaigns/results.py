"""The results file of a campaign, a line of JSON a session, what adds to it, and its command line."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from sms_online.errors import InputError
from sms_tools.archive.rows import RowFile
from sms_tools.archive.runner import Work, finished
from sms_tools.option_values import whole

Record = dict[str, Any]
# What a record is named by, such as {"grade": "A", "seed": 0}, and the arguments of the work that gives the rest of it.
Task = tuple[Mapping[str, Any], tuple[object, ...]]
# What a mode does with the arguments; a text is printed.
Mode = Callable[[argparse.Namespace], str | None]


def read(results: Path) -> list[Record]:
    """Sessions in a results file, none where there is no file; what a stopped run left of its last line goes."""
    return RowFile(results).read()


def append(results: Path, record: Record) -> None:
    """Add a session, which is on the disk when this returns; NaN stays what it is."""
    results.parent.mkdir(parents=True, exist_ok=True)
    with results.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")
        file.flush()
        os.fsync(file.fileno())


def complete(args: argparse.Namespace, work: Work, tasks: Iterable[Task]) -> None:
    """Append the records that the results lack, as their tasks are finished, in any order.

    args: of `campaign`. work: a module's own function. tasks: all have names of the same keys. What fails is a record
    of its names and the error, and is done again by the next run.
    """
    tasks = list(tasks)
    keys = [*tasks[0][0]] if tasks else []
    done = {_key(record, keys) for record in read(args.results) if "error" not in record}
    missing = {_key(names, keys): (names, arguments) for names, arguments in tasks if _key(names, keys) not in done}
    rows = finished(
        work if args.scheduler is None else _importable(work),
        {key: arguments for key, (_, arguments) in missing.items()},
        workers=args.workers,
        scheduler=args.scheduler,
    )
    for count, (key, row) in enumerate(rows, 1):
        append(args.results, {**missing[key][0], **row})
        print(f"{key}: {row.get('error', 'done')} ({count} of {len(missing)})", flush=True)


def _importable(work: Work) -> Work:
    """The same function of the module as others import it: what was started here is not what a cluster starts."""
    spec = sys.modules[work.__module__].__spec__
    return work if spec is None else getattr(import_module(spec.name), work.__name__)


def _key(names: Mapping[str, Any], keys: list[str]) -> str:
    return "/".join(str(names.get(key)) for key in keys)


def absolute(text: str) -> Path:
    """A path of the command line, the same for workers, which may run elsewhere."""
    return Path(text).absolute()


def campaign(
    document: str | None, modes: Mapping[str, Mode], *, alone: bool = False, **options: dict[str, Any]
) -> None:
    """Run `MODE RESULTS` of the command line; 2 where a file cannot be read, 130 where interrupted.

    document: of the module. alone: its tasks must run one by one, so there is no choice of workers. options: by name,
    as argparse takes them.
    """
    parser = argparse.ArgumentParser(description=document, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=modes)
    parser.add_argument("results", metavar="RESULTS", type=absolute)
    for name, settings in options.items():
        parser.add_argument(f"--{name}", **settings)
    if alone:
        parser.set_defaults(workers=1, scheduler=None)
    else:
        where = parser.add_mutually_exclusive_group()
        where.add_argument("--workers", metavar="N", type=whole(1), help="processes, one for each core by default")
        where.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster that imports this checkout")
    args = parser.parse_args()
    try:
        text = modes[args.mode](args)
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
    if text is not None:
        print(text)


def summed(summary: Callable[[list[Record]], str]) -> Mode:
    """The mode that prints what the sessions of the results show, and which have failed."""

    def mode(args: argparse.Namespace) -> str:
        if not args.results.is_file():
            raise InputError(str(args.results), "", "no such file", "results that another mode wrote")
        records = read(args.results)
        good = [record for record in records if "error" not in record]
        return "\n".join([*([summary(good)] if good else []), *failures(records, good)])

    return mode


def failures(records: list[Record], good: list[Record]) -> list[str]:
    """A line for each record that failed and has not been done since."""
    last: dict[str, str] = {}
    for record in records:
        names = {key: value for key, value in record.items() if key != "error"}
        if "error" in record and not any(names.items() <= each.items() for each in good):
            last["/".join(map(str, names.values()))] = record["error"]
    return [f"FAILED {key}: {error}" for key, error in last.items()]
