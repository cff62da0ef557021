"""Whole lines of a growing or compressed text file, in chunks of bounded size."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

import numpy as np

from sms_adapters.files import reading, unusable
from sms_online.errors import InputError

# Bytes of text parsed at once: from here on the cost of a parser call is lost in the cost of its lines, and the text
# still fits a second-level cache. (Measured, 18 channels: 64 KiB 4.5 µs a row, 1 MiB 1.5, 4 MiB 2.3.)
CHUNK = 1 << 20
READABLE = "a readable file"


class LineReader:
    """The whole lines of a text file, or of its .gz, from the beginning each time it is iterated.

    Yields (number of the chunk's first line, chunk), the chunk ending in a newline and valid until the next one is
    asked for: all share one buffer, since fresh memory for each would cost a quarter of the parser's time.
    What follows the last newline is never yielded: a logger that died in the middle of `0.0123` leaves `0.01`, which is
    a number to any parser. Then `cut_line` is the number of that line; it is None where the file ends in a newline.
    on_bytes: called with the bytes of the file consumed so far, to be compared with its size.
    Raises InputError for a file that is missing, unreadable, empty, not gzip despite its name, or not lines of text.
    """

    def __init__(self, path: Path, on_bytes: Callable[[int], None] | None = None) -> None:
        self.path = path
        self.cut_line: int | None = None
        self._on_bytes = on_bytes

    @property
    def warnings(self) -> list[str]:
        """A warning if the last iteration left out a cut line."""
        if self.cut_line is None:
            return []
        return [f"{self.path.name}: 1 line skipped, line {self.cut_line} is cut (no newline at its end)"]

    def __iter__(self) -> Iterator[tuple[int, memoryview]]:
        self.cut_line = None
        buffer = bytearray(CHUNK)
        line, held = 1, 0  # held: bytes of an unfinished line at the buffer's front
        with self._open() as (raw, stream):
            while True:
                size = held + self._fill(stream, memoryview(buffer)[held:])
                if size == held:
                    break
                if self._on_bytes is not None:
                    self._on_bytes(raw.tell())
                whole = buffer.rfind(b"\n", 0, size) + 1
                if whole:
                    yield line, memoryview(buffer)[:whole]
                    line += int(np.count_nonzero(np.frombuffer(buffer, np.uint8, whole) == ord("\n")))
                elif size == CHUNK:
                    raise InputError(str(self.path), f"line {line}", f"{CHUNK} bytes without an end", "lines of text")
                held = size - whole
                buffer[:held] = buffer[whole:size]
        if held:
            self.cut_line = line
        elif line == 1:
            raise self._empty()

    def first_line(self, strict: bool = True) -> str:
        """The first line without its end, whole or cut; InputError as for the iteration.

        strict: InputError too where it is not UTF-8; else what is not is replaced.
        """
        with self._open() as (_, stream):
            buffer = bytearray(CHUNK)
            size = self._fill(stream, memoryview(buffer))
        if not size:
            raise self._empty()
        try:
            # Spreadsheets put a byte-order mark in front.
            return buffer[:size].split(b"\n", 1)[0].decode("utf-8-sig", "strict" if strict else "replace").rstrip("\r")
        except UnicodeDecodeError:
            raise InputError(str(self.path), "line 1", "bytes that are not text", "lines of text in UTF-8") from None

    @contextmanager
    def _open(self) -> Iterator[tuple[BufferedReader, BufferedReader | gzip.GzipFile]]:
        """The file, and the stream of its text."""
        with reading(self.path, READABLE):
            raw = self.path.open("rb")
        with raw:
            yield raw, gzip.GzipFile(fileobj=raw) if self.path.suffix == ".gz" else raw

    def _fill(self, stream: BufferedReader | gzip.GzipFile, space: memoryview) -> int:
        """Read until the space is full or the text ends, and return how much; a .gz that breaks off ends there."""
        size = 0
        try:
            while size < len(space) and (count := stream.readinto1(space[size:])):
                size += count
        except EOFError:
            pass
        except (gzip.BadGzipFile, zlib.error) as error:
            raise InputError(str(self.path), "", f"damaged compression ({error})", "a file written by gzip") from None
        except OSError as error:
            raise unusable(self.path, error, READABLE) from None
        return size

    def _empty(self) -> InputError:
        return InputError(str(self.path), "", "an empty file", "lines of text")


class LineLog:
    """What logs of lines have in common: the file, opened once to see that it is one, and what was left out of it.

    on_bytes: see LineReader, whose InputErrors are raised.
    """

    def __init__(self, path: Path, on_bytes: Callable[[int], None] | None = None) -> None:
        self._path = path
        self._lines = LineReader(path, on_bytes)
        self._lines.first_line()

    @property
    def warnings(self) -> list[str]:
        """What the current iteration has left out."""
        return self._lines.warnings


def sampled_line(line: int, chunk: memoryview, row: int) -> tuple[int, str]:
    """Number and text of the line that holds a row; the chunk begins at the line given, and blank lines hold no row."""
    lines = [(line + k, text) for k, text in enumerate(bytes(chunk).splitlines()) if text]
    number, text = lines[row]
    return number, text.decode()
