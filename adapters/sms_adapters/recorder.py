"""Raw items to disk, in a thread of its own: at most half a second is in memory, and a full disk stops nobody."""

from __future__ import annotations

import fcntl
import os
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sms_adapters.files import reading
from sms_adapters.raw import CanFrames, Raw
from sms_adapters.session_log import (
    DROPPED,
    SESSION,
    STAMPS,
    SUFFIXES,
    SessionHeader,
    chunk_line,
    ending_text,
    frame_lines,
    header_text,
    number_of_items,
    stamp_lines,
)
from sms_online.errors import InputError

# The writer wakes so often, s: what a kill can lose at most, beside what the kernel had not delivered.
INTERVAL = 0.2
# Items that may wait for the disk: 20 s of 10,000 frames a second, some 60 MB.
MOST_WAITING = 200_000
TOO_SLOW = "the disk is too slow"


class _File:
    """An append-only file without a buffer in this process, which leaves no torn line behind when the disk is full."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor: int | None = None
        self._rest = b""  # of a line that the disk took half of

    def write(self, text: str) -> None:
        """Append; OSError where the disk refuses. What of a begun line is missing goes out with the next write."""
        if self._descriptor is None:
            self._descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        data = self._rest + text.encode("ascii")
        done = 0
        try:
            while done < len(data):
                done += os.write(self._descriptor, data[done:])
        finally:
            begun = done > 0 and data[done - 1 : done] != b"\n"
            if done >= len(self._rest):
                end = data.find(b"\n", done) + 1
                self._rest = data[done:end] if begun else b""
            else:
                self._rest = self._rest[done:]

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


@dataclass
class _Track:
    """What is written of one source. count: items so far. run: first and length of the drops not yet marked."""

    main: _File
    stamps: _File
    dropped: _File
    count: int = 0
    run: tuple[int, int] = (0, 0)
    stamped: bool | None = None

    def mark(self) -> None:
        """Write the drops down."""
        (first, count), self.run = self.run, (0, 0)
        if count:
            self.dropped.write(f"{first} {count}\n")


def being_recorded(directory: Path) -> bool:
    """Whether a process that lives records into the directory."""
    try:
        with (directory / SESSION).open("rb") as session:
            fcntl.flock(session, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # no recording, or none that can be opened
        return False
    return False


class Recorder:
    """Writes the raw items of all sources into a directory, see `session_log`.

    header: of the session. files: what else belongs to it, such as the system file, by name. Raises InputError where
    the directory cannot be made or holds a recording already.
    """

    def __init__(self, directory: Path, header: SessionHeader, files: Mapping[str, bytes] | None = None) -> None:
        self.problem: str | None = None  # why nothing can be written now
        self.unrecorded = 0
        self._header = header
        self._queue: deque[tuple[str, Sequence[Raw], int, bool]] = deque()
        self._waiting = 0
        self._lock = threading.Lock()
        self._closing = threading.Event()
        with reading(directory, "a directory to record in"):
            directory.mkdir(parents=True, exist_ok=True)
            if (directory / SESSION).exists():
                raise InputError(str(directory), "", "a recording that is there already", "a new directory")
            self._session = (directory / SESSION).open("w", encoding="utf-8")
            with suppress(OSError):  # not every network's disk has locks, and none is worth the session
                fcntl.flock(self._session, fcntl.LOCK_EX)
            self._session.write(header_text(header))
            self._session.flush()
            for name, content in (files or {}).items():
                (directory / name).write_bytes(content)
        self._tracks = {
            name: _Track(
                _File(directory / (name + SUFFIXES[kind])),
                _File(directory / (name + STAMPS)),
                _File(directory / (name + DROPPED)),
            )
            for name, kind in header.sources.items()
        }
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def put(self, name: str, items: Sequence[Raw], dropped: bool) -> None:
        """Record items of a source, in order; never waits. dropped: the estimator does not get them."""
        count = number_of_items(items)
        with self._lock:
            if self._waiting + count > MOST_WAITING:
                self.unrecorded += count
                self.problem = TOO_SLOW
                return
            self._waiting += count
            self._queue.append((name, items, count, dropped))

    def close(self, duration: float, warnings: Sequence[str] = ()) -> None:
        """Write what waits, and how the session ended; duration: s. warnings: what no raw item shows of it."""
        self._closing.set()
        self._thread.join()
        for track in self._tracks.values():
            for file in (track.main, track.stamps, track.dropped):
                file.close()
        try:
            with self._session:
                self._session.write(ending_text(duration, self.unrecorded, warnings))
        except OSError as error:
            self.problem = error.strerror or str(error)

    def abandon(self) -> None:
        """Close a recording whose session could not begin; where nothing came yet, the directory is free again."""
        self.close(0.0)
        if not any(track.count for track in self._tracks.values()):
            Path(self._session.name).unlink(missing_ok=True)

    def _run(self) -> None:
        while not self._closing.wait(INTERVAL):
            self._write_waiting()
        self._write_waiting()

    def _write_waiting(self) -> None:
        with self._lock:
            batch, self._queue = self._queue, deque()
        texts: dict[str, list[tuple[Sequence[Raw], int, bool]]] = {}
        for name, items, count, dropped in batch:
            texts.setdefault(name, []).append((items, count, dropped))
        for name, parts in texts.items():
            count = sum(part[1] for part in parts)
            try:
                self._write(name, self._tracks[name], parts)
                if self.problem != TOO_SLOW:
                    self.problem = None
            except OSError as error:
                self.unrecorded += count
                self.problem = error.strerror or str(error)
            with self._lock:
                self._waiting -= count

    def _write(self, name: str, track: _Track, parts: Sequence[tuple[Sequence[Raw], int, bool]]) -> None:
        lines: list[str] = []
        stamps: list[str] = []
        for items, count, dropped in parts:
            if dropped and sum(track.run) == track.count:
                track.run = (track.run[0], track.run[1] + count)
            elif dropped:
                track.mark()
                track.run = (track.count, count)
            track.count += count
            for item in items:
                if isinstance(item, CanFrames):
                    if track.stamped is None:
                        track.stamped = bool(np.isfinite(item.stamp).any())
                    lines += frame_lines(name, self._header.epoch, item)
                    stamps += stamp_lines(item) if track.stamped else []
                else:
                    lines.append(chunk_line(name, self._header.epoch, item))
        track.main.write("".join(lines))
        if stamps:
            track.stamps.write("".join(stamps))
        track.mark()
