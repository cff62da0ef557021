"""The results file of a campaign, a line of JSON a session, and its command line."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sms_online.errors import InputError
from sms_tools.archive.rows import RowFile

Record = dict[str, Any]
# What a mode does with the arguments; a text is printed.
Mode = Callable[[argparse.Namespace], str | None]


def read(results: Path) -> list[Record]:
    """Sessions in a results file, none where there is no file; what a stopped run left of its last line goes."""
    return RowFile(results).read()


def append(results: Path, record: Record) -> None:
    """Add a session; NaN stays what it is."""
    results.parent.mkdir(parents=True, exist_ok=True)
    with results.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


def campaign(document: str | None, modes: Mapping[str, Mode], **options: dict[str, Any]) -> None:
    """Run `MODE RESULTS` of the command line; 2 where a file cannot be read, 130 where interrupted.

    document: of the module. options: by name, as argparse takes them.
    """
    parser = argparse.ArgumentParser(description=document, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=modes)
    parser.add_argument("results", metavar="RESULTS", type=Path)
    for name, settings in options.items():
        parser.add_argument(f"--{name}", **settings)
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
    """The mode that prints what the sessions of the results show."""

    def mode(args: argparse.Namespace) -> str:
        if not args.results.is_file():
            raise InputError(str(args.results), "", "no such file", "results that another mode wrote")
        return summary(read(args.results))

    return mode
