"""A session as people see it: the view while it runs, the page when it is over."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from sms_online.result import Result
from sms_online.session import Session
from sms_online.stream import Block
from sms_online.truth import true_values
from sms_tools.html_report.course import CourseRecorder
from sms_tools.interruption import Interruption
from sms_tools.live.loop import LiveSession
from sms_tools.report import report_console, show, verdict_text
from sms_tools.view.frames import Circumstances
from sms_tools.view.scene import Scene
from sms_tools.view.session import View, open_view


class Showing:
    """View and course of one session, which has to be updated with the blocks as they come out of `watch`."""

    def __init__(
        self,
        args: argparse.Namespace,
        session: Session,
        view: View,
        directory: Path,
    ) -> None:
        self._args = args
        self._session = session
        self._view = view
        self._course = CourseRecorder(session)
        self._directory = directory

    @property
    def notices(self) -> list[str]:
        """A line on the view where it has been given up."""
        return [self._view.status] if self._view.status else []

    @property
    def warnings(self) -> list[str]:
        """What the view could not show."""
        return self._view.warnings

    def watch(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """The same blocks, drawn as they pass."""
        return iter(self._course.watch(self._view.watch(blocks)))

    def follow(self, say: Callable[[str], None] = lambda text: None) -> None:
        """Show what the session's diagnosis finds: evidence as a plot, verdicts in the log and in the trust.

        say: is called with the verdicts too.
        """
        online = self._session.diagnosis
        before = self._view.circumstances
        self._view.circumstances = lambda: replace(before(), discrepancies=online.discrepancies)

        def evidence(t: float, scores: Mapping[str, float]) -> None:
            self._view.evidence(t, {name: math.log10(max(1.0, gain)) for name, gain in scores.items()})

        def verdict(t: float, text: str) -> None:
            self._view.event(t, text)
            say(f"{t:.2f} s: {text}")

        online.on_evidence, online.on_verdict = evidence, verdict

    def report(self, result: Result, interruption: Interruption) -> None:
        """Write the page of a finished session and say whether to trust its numbers; then serve the view."""
        # Matplotlib takes a second to be imported, which nobody should wait for before a session.
        from sms_tools.html_report.page import write_report

        document = result.document()
        nominal = {p.name: p.nominal for p in result.parameters.values() if p.nominal is not None}
        scene = Scene(self._session.estimator.model, self._args.exaggerate)
        page = write_report(self._directory, document, self._course.course, nominal, scene)
        show(report_console(self._args.json), f"report: {page}", "", verdict_text(document["verdict"]))
        self._view.linger(interruption)


@contextmanager
def showing(
    args: argparse.Namespace,
    session: Session,
    directory: Path,
    truth: Mapping[str, Any] | None,
    patient: bool = False,
    live: LiveSession | None = None,
) -> Iterator[Showing]:
    """What `--rerun` asks for, while the context lasts; the session has to be finished within it.

    truth: of a simulated session, see `Capture`. patient: the session may wait for the view, as a replay as fast as it
    goes does. live: it comes from devices, whose health and troubles are shown with it.
    """
    true = None if truth is None else true_values(truth, session.system, session.system)
    with open_view(
        args.rerun,
        session.estimator,
        session.channels,
        directory,
        true,
        patient=patient,
        exaggeration=args.exaggerate,
        health=None if live is None else lambda: live.health,
    ) as view:
        if live is not None:
            view.circumstances = lambda: Circumstances(troubles=tuple(live.troubles))
        yield Showing(args, session, view, directory)
