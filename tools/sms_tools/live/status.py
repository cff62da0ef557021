"""The status line: written by a thread of its own that always takes the latest news, so that no display can block."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass

from rich.table import Table

from sms_online.verdict.trust import Trust
from sms_tools.report import plain_console, verdict_text

# News a second: more than anybody reads; where there is no terminal, a line every so many seconds.
INTERVAL, LINE_INTERVAL = 0.5, 5.0
# Longest wait for a last line that nobody takes, s.
PATIENCE = 0.5
CLEAR = "\x1b[{}A\x1b[J"


@dataclass(frozen=True)
class Leading:
    """A parameter as the status line shows it."""

    name: str
    unit: str
    estimate: float
    std: float


@dataclass(frozen=True)
class News:
    """News of a session. rate: samples/s; latency: p99, s, or None; lost: samples; residual: largest share of a
    joint's torque or force that is not explained, or None; leading: the best known parameters; troubles: what is wrong;
    trust: in the numbers, of all of it.
    """

    time: float
    rate: float
    latency: float | None
    lost: int
    residual: float | None
    determined: tuple[int, int]
    leading: Sequence[Leading]
    troubles: Sequence[str]
    trust: Trust


def summary(news: News) -> str:
    """One line without parameters."""
    known, of = news.determined
    latency = "-" if news.latency is None else f"{1e3 * news.latency:.0f} ms"
    residual = "-" if news.residual is None else f"{100 * news.residual:.2g} %"
    return (
        f"{news.time:8.1f} s  {news.rate:,.0f} samples/s  latency p99 {latency}  lost {news.lost}  "
        f"residual {residual}  {known} of {of} determined"
    )


def line(news: News) -> str:
    """All of it on one line, for a log."""
    shown = [f"{p.name} {p.estimate:.6g} ± {2.0 * p.std:.2g} {p.unit}" for p in news.leading]
    return "; ".join([summary(news), news.trust.sentence, *shown, *news.troubles])


def screen(news: News, width: int) -> str:
    """All of it as a few lines for a terminal."""
    table = Table(box=None, pad_edge=False, show_header=False)
    for p in news.leading:
        table.add_row(p.name, f"{p.estimate:.6g}", f"± {2.0 * p.std:.2g}", p.unit)
    console = plain_console(width=width, force_terminal=True)
    with console.capture() as capture:
        console.print(summary(news), style="bold")
        if news.leading:
            console.print(table)
        for trouble in news.troubles:
            console.print(trouble, style="yellow")
        console.print(verdict_text(news.trust.document()))
    return capture.get()


class StatusWriter:
    """Writes the latest news to a file descriptor, by default stderr, as fast as its reader takes them and no faster.

    A display that never reads blocks the thread inside one write for ever, and nothing else: publishing only replaces
    what is said next.
    """

    def __init__(self, descriptor: int = 2) -> None:
        self._descriptor = descriptor
        self._terminal = os.isatty(descriptor)
        self._news: News | None = None
        self._fresh = threading.Event()
        self._closing = threading.Event()
        self._height = 0
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)
        self._thread.start()

    def publish(self, news: News) -> None:
        """Say this next."""
        self._news = news
        self._fresh.set()

    def close(self) -> None:
        """Say the last news and stop; leaves a display that does not read behind."""
        self._closing.set()
        self._fresh.set()
        self._thread.join(PATIENCE)

    def _run(self) -> None:
        interval = INTERVAL if self._terminal else LINE_INTERVAL
        while not self._closing.is_set():
            self._fresh.wait()
            self._fresh.clear()
            if not self._say():
                return
            self._closing.wait(interval)
        if self._fresh.is_set():
            self._say()

    def _say(self) -> bool:
        """Write the news; False where nobody will ever read them."""
        if self._news is None:
            return True
        if self._terminal:
            text = screen(self._news, os.get_terminal_size(self._descriptor).columns)
            clear = CLEAR.format(self._height) if self._height else ""
            self._height = text.count("\n")
            text = clear + text
        else:
            text = line(self._news) + "\n"
        data = text.encode("utf-8", errors="replace")
        try:
            # Not through sys.stderr: its lock would be held by a write that never ends.
            while data:
                data = data[os.write(self._descriptor, data) :]
        except OSError:
            return False
        return True
