"""A bar with the time left on what takes longer than a moment, for a person at a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from sms_adapters.files import size_of
from sms_adapters.sources import open_source
from sms_online.capture import PIECE
from sms_online.description.schema import System
from sms_online.stream import Block, Relayed, Source
from sms_tools.report import plain_console

# What is over before this many seconds needs no bar.
MOMENT = 2.0
# Bytes of a file up to which its samples are held in memory and counted; a larger one is as far as its bytes are read.
# Of less, a reader takes too large a part at once to say how far the estimator is.
SMALL = 20_000_000


class Mover(Protocol):
    """Moves a bar to how much is done; name: of what is being done, where that is new."""

    def __call__(self, done: float, name: str | None = None) -> None: ...


class Watched(Relayed):
    """A source whose blocks move a bar when they are processed. console: where to write above the bar."""

    def __init__(self, source: Source, blocks: Iterable[Block], console: Console) -> None:
        super().__init__(source)
        self.blocks, self.console = blocks, console

    def __iter__(self) -> Iterator[Block]:
        return iter(self.blocks)


@contextmanager
def watched(
    path: Path, system: System, folder: Path | None, start: float | None = None, stop: float | None = None
) -> Iterator[Watched]:
    """Open a recorded session with a bar on stderr while the context lasts, where that is a terminal.

    The arguments are those of `open_source`.
    """
    console = plain_console(stderr=True)
    if not console.is_terminal:
        source = open_source(path, system, start, stop, None, folder)
        yield Watched(source, source, console)
        return
    size = size_of(path)
    bar = _bar(console)
    try:
        if size > SMALL:
            on_bytes = _mover(bar, path.name, size)
            source = open_source(path, system, start, stop, on_bytes, folder)
            yield Watched(source, source, console)
        else:
            source = open_source(path, system, start, stop, None, folder)
            blocks = list(source)
            move = _mover(bar, path.name, sum(block.t.size for block in blocks))
            yield Watched(source, _counted(blocks, move), console)
    finally:
        bar.stop()


@contextmanager
def waiting() -> Iterator[Callable[[str, float], None]]:
    """A bar on stderr for what people wait for while the context lasts, where that is a terminal.

    Yields whom to call with what is being done, a few words, and the share of all that is done.
    """
    console = plain_console(stderr=True)
    if not console.is_terminal:
        yield lambda what, share: None
        return
    bar = _bar(console)
    try:
        move = _mover(bar, "", 1.0)
        yield lambda what, share: move(share, what)
    finally:
        bar.stop()


def _bar(console: Console) -> Progress:
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.percentage:.0f} %"))
    return Progress(*columns, TimeRemainingColumn(), console=console, transient=True)


def _mover(bar: Progress, name: str, total: float) -> Mover:
    """Function that moves the bar to how much is done of the total; the bar appears once it has been a moment."""
    task = bar.add_task(name, total=total)
    began, shown = monotonic(), False

    def move(done: float, name: str | None = None) -> None:
        nonlocal shown
        bar.update(task, completed=done, description=name)
        if not shown and monotonic() > began + MOMENT:
            shown = True
            bar.start()

    return move


def _counted(blocks: Iterable[Block], move: Mover) -> Iterator[Block]:
    done = 0
    for block in blocks:
        # In portions, so that the bar moves: a block may be all of a capture.
        for piece in block.pieces(PIECE):
            yield piece
            done += piece.t.size
            move(done)
