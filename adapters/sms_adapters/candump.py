"""CAN logs of `candump -l`, matched in bulk as text and decoded as arrays.

python-can's reader is not used: a line that it cannot read raises a bare ValueError without the line's number, its
objects cost 3.7 µs a frame before any signal is decoded, and its times are floats, good to 0.24 µs at this epoch, where
the log holds whole microseconds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sms_adapters.can_signals import wanted_messages
from sms_adapters.capture import BLOCK
from sms_adapters.lines import LineReader, sampled_line
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Array, Block

# (seconds.fraction) interface id#data, with the variants of the format: ##flags for CAN FD, R for a remote frame
# (which carries no data), a direction at the end.
_LINE = re.compile(
    rb"^\((\d{1,10})\.(\d{1,9})\) (\S+) ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    rb"(?:#[0-9A-Fa-f])?(?:R[0-9A-Fa-f]?|((?:[0-9A-Fa-f]{2})*))(?: [RT])?\r?$",
    re.MULTILINE,
)
_EXTENDED = 1 << 32  # set on the ids of eight digits: 007 and 00000007 are two ids
_EXTENDED_DIGITS = 8
_NANOSECONDS = 10**9
_SHOWN_IDS = 5

_Column = tuple[bytes, ...]
_Frames = tuple[_Column, _Column, _Column]  # interface, id and data of each frame, as written


class CandumpReader:
    """A candump log, .log or .log.gz, as blocks in order of time; each iteration starts from its beginning.

    Each frame of a message of system.source gives one sample: its signals as the DBC scales them, NaN in the channels
    of other messages. t: seconds since the log's first frame of any kind, from the log's integer times.
    start, stop, block, on_bytes: as for CaptureReader. directory: where the system file stands; its DBC is
    looked for there, then among those shipped in sms_adapters/dbc.

    Frames that no channel comes from, wanted frames of another length than the DBC says (remote frames among them),
    later frames of a message with an equal time, and a last line that does not end in a newline are skipped and
    counted in `warnings`.
    Raises InputError, on construction for a system without a CAN source, a DBC that is missing or unreadable, or a
    signal it does not hold; while iterating for a malformed line, a time that goes back, one message on two
    interfaces, or no sample at all.
    """

    def __init__(
        self,
        path: Path,
        system: System,
        start: float | None = None,
        stop: float | None = None,
        block: int = BLOCK,
        on_bytes: Callable[[int], None] | None = None,
        directory: Path | None = None,
    ) -> None:
        if system.source is None:
            expected = f"a table [source] in the system {system.name!r}, with its DBC and signals"
            raise InputError(str(path), "", "a CAN log without a DBC", expected)
        self._path = path
        self._start = -math.inf if start is None else start
        self._stop = math.inf if stop is None else stop
        self._block = block
        self._dbc = system.source.dbc
        self._channels = tuple(system.source.signals.values())
        self._wanted = {
            wanted.message.frame_id | (_EXTENDED if wanted.message.is_extended_frame else 0): wanted
            for wanted in wanted_messages(system, system.source, directory)
        }
        self._lines = LineReader(path, on_bytes)
        LineReader(path).first_line()
        self._reset()

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that the system's [source] maps signals to, in its order."""
        return self._channels

    @property
    def warnings(self) -> list[str]:
        """What the current iteration has skipped so far."""
        name, found = self._path.name, []
        if self._unwanted:
            ids = [
                f"{id_ & ~_EXTENDED:0{_EXTENDED_DIGITS if id_ & _EXTENDED else 3}X}"
                for id_ in sorted(self._unwanted_ids)
            ]
            shown = ", ".join(ids[:_SHOWN_IDS]) + (", …" if len(ids) > _SHOWN_IDS else "")
            found.append(f"{name}: {self._unwanted} frames skipped, no channel comes from their ids ({shown})")
        if self._wrong_length:
            found.append(f"{name}: {self._wrong_length} frames skipped, their length is not the one in {self._dbc}")
        if self._repeated:
            found.append(
                f"{name}: {self._repeated} frames skipped, their time repeats that of their message's last one"
            )
        if self._lines.cut_line is not None:
            found.append(f"{name}: 1 line skipped, line {self._lines.cut_line} is cut (no newline at its end)")
        return found

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks from the log's beginning."""
        self._reset()
        first: int | None = None
        last = rows = 0
        for line, text in self._lines:
            chunk = bytes(text)
            stamps, frames = self._frames(line, chunk, last)
            if not stamps.size:
                continue
            first, last = (int(stamps[0]) if first is None else first), int(stamps[-1])
            used, values = self._decode(line, chunk, stamps, frames)
            t = (stamps[used] - first) / _NANOSECONDS
            inside = slice(*np.searchsorted(t, (self._start, self._stop)))
            t, values = t[inside], values[used][inside]
            rows += t.size
            for k in range(0, t.size, self._block):
                yield Block(t[k : k + self._block], self._channels, values[k : k + self._block])
            if (last - first) / _NANOSECONDS >= self._stop:
                break
        if not rows:
            names = ", ".join(wanted.message.name for wanted in self._wanted.values())
            raise InputError(str(self._path), "", "no samples", f"frames of {names} between start and stop")

    def _reset(self) -> None:
        self._unwanted = self._wrong_length = self._repeated = 0
        self._unwanted_ids: set[int] = set()
        self._interface: dict[int, bytes] = {}
        self._last_stamp: dict[int, int] = {}

    def _frames(self, line: int, chunk: bytes, last: int) -> tuple[NDArray[np.int64], _Frames]:
        """Times (ns) and columns of the frames in a chunk; InputError for a malformed line or a time going back."""
        matches = _LINE.findall(chunk)
        texts = chunk.split(b"\n")
        if len(matches) != sum(1 for text in texts if text.rstrip(b"\r")):
            k = next(k for k, text in enumerate(texts) if text.rstrip(b"\r") and not _LINE.fullmatch(text))
            found = repr(texts[k][:60].decode("utf-8", "replace"))
            raise InputError(
                str(self._path), f"line {line + k}", found, "(seconds) interface id#data, as candump -l writes"
            )
        if not matches:
            return np.empty(0, np.int64), ((), (), ())
        seconds, fractions, *frames = zip(*matches, strict=True)
        stamps = np.array([int(s + f.ljust(9, b"0")) for s, f in zip(seconds, fractions, strict=True)], np.int64)
        back = np.diff(stamps, prepend=last) < 0
        if back.any():
            number, _ = sampled_line(line, memoryview(chunk), int(back.argmax()))
            expected = "times that do not go back"
            raise InputError(str(self._path), f"line {number}", "a time before that of the line above", expected)
        return stamps, (frames[0], frames[1], frames[2])

    def _decode(
        self, line: int, chunk: bytes, stamps: NDArray[np.int64], frames: _Frames
    ) -> tuple[NDArray[np.bool_], Array]:
        """Which frames of a chunk give a sample, (B,), and the values (B, C) of all, NaN where they give none."""
        interfaces, id_texts, data = frames
        ids = np.array([int(text, 16) | (_EXTENDED if len(text) == _EXTENDED_DIGITS else 0) for text in id_texts])
        used = np.zeros(stamps.size, dtype=np.bool_)
        values = np.full((stamps.size, len(self._channels)), np.nan)
        for id_, wanted in self._wanted.items():
            rows = np.flatnonzero(ids == id_)
            interface = self._interface.setdefault(id_, interfaces[rows[0]]) if rows.size else b""
            other = next((row for row in rows if interfaces[row] != interface), None)
            if other is not None:
                number, _ = sampled_line(line, memoryview(chunk), int(other))
                found = f"{wanted.message.name} on {interfaces[other].decode()} after {interface.decode()}"
                raise InputError(str(self._path), f"line {number}", found, "a message on one interface")
            digits = 2 * wanted.message.length
            whole = rows[[len(data[row]) == digits for row in rows]]
            fresh = whole[np.diff(stamps[whole], prepend=self._last_stamp.get(id_, -1)) > 0]
            self._wrong_length += rows.size - whole.size
            self._repeated += whole.size - fresh.size
            if fresh.size:
                self._last_stamp[id_] = int(stamps[fresh[-1]])
                words = bytes.fromhex(b"".join(data[row] for row in fresh).decode())
                values[np.ix_(fresh, wanted.columns)] = wanted.decode(
                    np.frombuffer(words, np.uint8).reshape(fresh.size, -1)
                )
                used[fresh] = True
        unwanted = ids[~np.isin(ids, list(self._wanted))]
        self._unwanted += unwanted.size
        self._unwanted_ids.update(unwanted.tolist())
        return used, values
