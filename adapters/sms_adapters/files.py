"""Files read and written with one clear line where that fails; a file is there as a whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sms_online.errors import InputError

WRITABLE = "a file that can be written"


def unusable(path: Path, error: OSError, expected: str) -> InputError:
    """The error of a file that the system refuses, in its own words."""
    return InputError(str(path), "", error.strerror or str(error), expected)


@contextmanager
def reading(path: Path, expected: str) -> Iterator[None]:
    """Inside, an OSError becomes an InputError for the file; expected: what it should be."""
    try:
        yield
    except OSError as error:
        raise unusable(path, error, expected) from None


def size_of(path: Path) -> int:
    """Bytes of a file, or of those in a directory; 0 where there is none."""
    files = path.iterdir() if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def part_of(path: Path) -> Path:
    """Where a file is written before it appears under its own name."""
    return path.with_name(path.name + ".part")


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Where to write a file, which then appears as a whole; its directory is made. InputError where that fails."""
    part = part_of(path)
    with reading(path, WRITABLE):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> Path:
    """Write a text file as a whole or not at all; its directory is made. InputError where that fails."""
    with writing(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def read_json(path: Path, expected: str) -> Any:
    """The content of a JSON file; InputError where it is none. expected: what it should be."""
    with reading(path, expected):
        text = path.read_text(encoding="utf-8")
    try:
        return json.loads(text)
    except ValueError as error:
        raise InputError(str(path), "", f"no JSON ({error})", expected) from None


class WholeFile:
    """A binary file that is written piece by piece and appears under its name when the context ends without an error.

    Raises InputError where it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with reading(path, WRITABLE):
            self._file = part_of(path).open("wb")

    def __enter__(self) -> Self:
        return self

    def _complete(self) -> None:
        """Write what the format has at its end."""
        raise NotImplementedError

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        part = part_of(self._path)
        try:
            if kind is None:
                self._complete()
                self._file.close()
                part.replace(self._path)
        finally:
            self._file.close()
            part.unlink(missing_ok=True)
