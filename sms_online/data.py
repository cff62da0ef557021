"""What can be estimated from, as people hand it to a function: a capture, a path, or blocks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

from sms_online.capture import Capture
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.recorded import Recorded
from sms_online.stream import Block

# A capture, the path of one, of a log or of a recording, a block, or blocks in order of time.
Data = Capture | Recorded | str | Path | Block | Iterable[Block]


def recorded_session(system: System, data: Data, folder: Path | None = None) -> Recorded:
    """Data as a recorded session; InputError if a path cannot be read, or there are no blocks.

    folder: of the system's file, where a log finds its DBC.
    """
    if isinstance(data, Recorded):
        return data
    if isinstance(data, Block):
        data = [data]
    if isinstance(data, Capture):
        return Recorded(data, data.source, data.truth)
    if isinstance(data, str | Path):
        from sms_adapters.recorded import recorded_at
        from sms_adapters.sources import open_source

        return recorded_at(Path(data), open_source(Path(data), system, directory=folder))
    return Recorded(_Blocks(data), "blocks")


class _Blocks:
    """Blocks as a source, once."""

    def __init__(self, data: Iterable[Block]) -> None:
        blocks = iter(data)
        first = next(blocks, None)
        if first is None:
            raise InputError("blocks", "", "none", "at least one block of samples")
        self.channels = first.channels
        self._data, self._blocks = data, chain([first], blocks)

    @property
    def warnings(self) -> Sequence[str]:
        """Warnings of the source so far."""
        return getattr(self._data, "warnings", ())

    def __iter__(self) -> Iterator[Block]:
        return self._blocks
