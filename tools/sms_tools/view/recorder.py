"""Draws a session from its frames: the statistics of each state are evaluated, and what they say is logged."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import groupby
from operator import itemgetter

import numpy as np
import rerun.blueprint as rrb

from sms_online.evaluation import identifiable
from sms_online.pipeline.statistics import Statistics
from sms_online.result import event_document
from sms_online.row_types import LARGEST_RESIDUAL
from sms_online.stream import Array, Mask
from sms_online.verdict.judged import JudgedEvaluation
from sms_online.verdict.reasons import LARGEST_WHITENED
from sms_online.verdict.trust import Trust
from sms_tools.report import event_line
from sms_tools.view import style
from sms_tools.view.arm_log import ArmLog
from sms_tools.view.banner import Banner
from sms_tools.view.blueprint import WINDOW, layout
from sms_tools.view.frames import Circumstances, End, Event, Evidence, Picture, Start
from sms_tools.view.known import Known
from sms_tools.view.number_log import (
    EVIDENCE,
    HEALTH,
    RELATIVE_RANGE,
    RESIDUAL,
    WHITENED_RANGE,
    NumberLog,
    ParameterLog,
    markdown_table,
)
from sms_tools.view.own_scale import OwnScale
from sms_tools.view.parameter_groups import Group, parameter_groups
from sms_tools.view.places import drawn_marks
from sms_tools.view.readings import Readings
from sms_tools.view.residuals import RecentResidual
from sms_tools.view.scene import Scene
from sms_tools.view.sink import Sink
from sms_tools.view.tracker_log import TrackerLog

# The table, and residuals of all rows so far, which move slowly: s of the session.
SLOW_INTERVAL = 1.0
# Plots of residuals in which events are marked, and how far across; and from where on they are a reason to doubt.
RANGES = {"relative": RELATIVE_RANGE, "whitened": WHITENED_RANGE}
LIMITS = {"relative": LARGEST_RESIDUAL, "whitened": float(np.log10(LARGEST_WHITENED))}
# The rate of samples is stated over so many states: five seconds of a live session.
RATE_STATES = 20


class Recorder:
    """One session on one sink. opened: is called with where the view is, once something is drawn.

    Raises TroubleError, from every method, where the sink does not take the data.
    """

    def __init__(self, start: Start, opened: Callable[[str], None]) -> None:
        self.waiting = 0  # pictures in the batch
        self._now = now = JudgedEvaluation(start.statistics)
        self._references = start.references
        self._live, self._diagnosed = start.live, start.diagnosed
        self._opened: Callable[[str], None] | None = opened
        self._scene = Scene(now.model, start.exaggeration)
        self._sensing = now.statistics.setup.sensing
        self._readings = Readings(self._sensing, start.channels)
        self._scale = OwnScale(start.references)
        system = now.statistics.setup.system
        self._sink = Sink(start.choice, start.recording, system.title or system.name)
        # t, x, relative residual of each link's rows, marks and their colour.
        self._arm: list[tuple[Array, Array, Array, dict[str, str], style.Color]] = []
        self._marks: dict[str, str] = {}
        self._trust: Trust | None = None
        self._circumstances = Circumstances()
        self._residual = np.full(len(system.joints), np.nan)
        self._recent = RecentResidual()
        self._events = 0  # marked and named so far
        self._determined: Mask = np.zeros(now.base.n, dtype=bool)
        self._gaps = 0
        self._beyond: set[str] = set()  # plots of residuals in which something was too much
        self._slow_due = -np.inf
        self._clock: deque[tuple[int, float]] = deque(maxlen=RATE_STATES)  # samples and wall clock of the last states

    def _open(self, t: float, x: Array) -> None:
        """Begin to log: the layout looks at where the arm is first seen."""
        if self._opened is None:
            return
        self._first = self._scene.draw(x[:1])
        self._begin: float | None = t
        stream = self._sink.stream
        self._numbers = NumberLog(stream)
        self._parameters = ParameterLog(self._numbers, self._groups())
        chosen = self._now.statistics.setup.trackers
        self._trackers = TrackerLog(self._numbers, [choice.label for choice in chosen])
        self._trackers.describe(self._now.parameters)
        self._opened(self._sink.open(self._layout()))
        self._opened = None
        self._arm_log, self._banner = ArmLog(stream, self._scene), Banner(stream)
        joints = [f"joint {i}" for i in range(1, self._residual.size + 1)]
        self._numbers.describe(f"{RESIDUAL}/relative", joints)
        self._numbers.describe(f"{RESIDUAL}/energy", ["energy"])
        self._numbers.describe(f"{RESIDUAL}/noise", ["noise"], [style.REFERENCE], width=1.0)
        for plot in RANGES:
            self._numbers.describe_events(f"{RESIDUAL}/{plot}_events")
            self._numbers.describe(f"{RESIDUAL}/{plot}_limit", ["limit"], [style.GRAVE], width=1.0)
        self._numbers.describe(f"{HEALTH}/rates/samples", ["samples/s"])
        counts = ["samples lost", "rows dropped", "gaps", "cells interpolated", "pictures dropped"]
        self._numbers.describe(f"{HEALTH}/counts/all", counts)

    def _groups(self) -> list[Group]:
        return parameter_groups(self._now.parameters, self._references, self._scale.basis)

    def _layout(self) -> rrb.Blueprint:
        diagnosed = self._diagnosed is not None
        return layout(self._scene, self._parameters, self._trackers, self._first, self._begin, self._live, diagnosed)

    def picture(self, picture: Picture) -> None:
        """Take in the samples and, where one comes with them, the estimator's state."""
        for block in picture.blocks:
            t, x = self._readings.push(block)
            if t.size:
                self._open(float(t[0]), x)
                residual = np.broadcast_to(self._residual, (t.size, self._residual.size))
                self._arm.append((t, x, residual, self._marks, self._color))
                self.waiting += t.size
        if picture.state is not None and self._opened is None:
            t_state = float(picture.blocks[-1].t[-1])
            self._take(t_state, picture.state, picture.circumstances)
            samples = picture.state.samples
            self._clock.append((samples, picture.wall))
            took = picture.wall - self._clock[0][1]
            if took > 0.0:
                rate = (samples - self._clock[0][0]) / took
                self._numbers.add(f"{HEALTH}/rates/samples", t_state, np.array([rate]))
            counters, dropped = picture.state.counters, picture.state.dropped_rows
            counts = [counters.lost_samples, dropped, counters.gaps, counters.interpolated_cells]
            self._numbers.add(f"{HEALTH}/counts/all", t_state, np.array([*counts, picture.dropped], dtype=np.float64))
            for plot, values in picture.health.items():
                self._numbers.add_named(f"{HEALTH}/{plot}", t_state, values)

    def event(self, event: Event) -> None:
        """Mark an event in the plots and name it in the log."""
        if self._opened is None:
            self._mark(event.t)
            self._numbers.say(event.t, event.text)

    def evidence(self, evidence: Evidence) -> None:
        """Scores of candidate effects."""
        if self._opened is None:
            self._numbers.add_named(EVIDENCE, evidence.t, evidence.scores)

    def write(self) -> None:
        """Send what waits."""
        if self._opened is not None:
            return
        for (marks, color), pictures in groupby(self._arm, key=itemgetter(3, 4)):
            t, x, residual = (np.concatenate(column) for column in list(zip(*pictures, strict=True))[:3])
            self._arm_log.write(t, x, residual, marks, color)
        self._arm.clear()
        self.waiting = 0
        self._numbers.send()
        self._sink.flush()

    def end(self, end: End | None) -> None:
        """The session's last state, with what its results warn of; None where it was cut off."""
        if end is not None and self._opened is None:
            self._take(end.t, end.state, end.circumstances, last=True)
            for warning in self._now.warnings:
                self._numbers.say(end.t, warning, warning=True)
        self.write()
        if self._opened is None:
            self._sink.close()

    def _take(self, t: float, state: Statistics, circumstances: Circumstances, last: bool = False) -> None:
        self._now = now = JudgedEvaluation(state, None, circumstances.discrepancies, circumstances.troubles)
        more = self._follow_events()
        known = self._known(t)
        slow = t >= self._slow_due or last
        if slow or circumstances != self._circumstances:
            self._circumstances = circumstances
            self._judge(t, last)
        converged = self._trust is not None and self._trust.level != "not yet"
        self._trackers.describe(now.parameters)
        self._arrange(t, more, self._scale.follow(known, converged, last))
        self._parameters.add(known)
        self._trackers.add(t, now)
        self._residual = self._recent.push(t, state, known.estimate, now.estimate.nuisances)
        self._numbers.add(f"{RESIDUAL}/relative", t, self._residual)
        self._name_changes(known)
        if slow:
            self._numbers.table(t, markdown_table(now.parameters, self._references, known))
            self._whole_residuals(t)
            self._slow_due = t + SLOW_INTERVAL

    def _arrange(self, t: float, more: bool, rescaled: bool) -> None:
        """A new layout where there are more parameters, another scale, or more past than a plot shows."""
        long = self._begin is not None and t - self._begin > WINDOW
        if long:
            self._begin = None
        if more or rescaled:
            self._parameters.arrange(self._groups())
        if more or rescaled or long:
            self._sink.arrange(self._layout())

    def _judge(self, t: float, last: bool) -> None:
        """May the numbers be trusted? Shown on top, marked on the arm, and logged where the answer is another one."""
        before, now = self._trust, self._now.trust if self._diagnosed is None else self._diagnosed.trust
        self._trust = now
        self._banner.show(t, now)
        self._marks = drawn_marks(now.marks, self._sensing.channels)
        if last or before is None or (before.level, before.grave, before.marks) != (now.level, now.grave, now.marks):
            self._numbers.say(t, now.sentence, warning=now.level == "doubt")

    def _known(self, t: float) -> Known:
        """What is known of the base parameters at t, s: by the session, or by a diagnosis."""
        now = self._now
        if self._diagnosed is not None and self._diagnosed.parameters:
            unknown = np.nan, np.inf
            shown = [self._diagnosed.parameters.get(p.name, unknown) for p in now.parameters]
            estimate, std = np.array(shown).T
            return Known(t, estimate, std, identifiable(estimate, std))
        return Known(t, now.estimate.pi, now.std, now.determined)

    def _mark(self, t: float) -> None:
        """A vertical line in all plots of parameters and residuals."""
        self._parameters.mark(t)
        for plot, extent in RANGES.items():
            self._numbers.mark(f"{RESIDUAL}/{plot}_events", t, *extent)

    @property
    def _color(self) -> style.Color:
        return style.NOT_YET if self._trust is None else style.verdict_color(self._trust)

    def _follow_events(self) -> bool:
        """Mark and name new events; whether they have added parameters."""
        more = self._now.base.n - len(self._references)
        if more > 0:
            self._references = (*self._references, *[None] * more)
            self._determined = np.append(self._determined, np.zeros(more, dtype=bool))
        events = self._now.statistics.events
        for event in events[self._events :]:
            self._mark(event.time)
            self._numbers.say(event.time, event_line(event_document(event)), warning=True)
        self._events = len(events)
        return more > 0

    def _whole_residuals(self, t: float) -> None:
        """Residuals of all rows so far: over their predicted deviation, in decades, and of the energy balance."""
        whole = self._now.residuals
        known = {rows: np.log10(value) for rows, r in whole.items() if (value := r.whitened)}
        self._numbers.add_named(f"{RESIDUAL}/whitened", t, known)
        self._numbers.add(f"{RESIDUAL}/noise", t, np.zeros(1))
        shares = [share for r in whole.values() if (share := r.relative) is not None]
        for plot, values in (("relative", shares), ("whitened", [*known.values()])):
            limit, (_, top) = LIMITS[plot], RANGES[plot]
            worst = max(values, default=-np.inf)
            self._numbers.add(f"{RESIDUAL}/{plot}_limit", t, np.array([limit]))
            if worst > limit and plot not in self._beyond:
                # Only now, so that no legend names it before.
                self._beyond.add(plot)
                self._numbers.describe(f"{RESIDUAL}/{plot}_beyond", ["too much"], [style.GRAVE], width=5.0)
            if plot in self._beyond:
                beyond = min(worst, top) if worst > limit else np.nan
                self._numbers.add(f"{RESIDUAL}/{plot}_beyond", t, np.array([beyond]))
        energy = self._now.statistics.energy_estimate()
        rms = np.sqrt(energy.rss / energy.dof) if energy.dof > 0.0 else np.nan
        self._numbers.add(f"{RESIDUAL}/energy", t, np.array([rms]))

    def _name_changes(self, now: Known) -> None:
        """What has become known or has been lost since the last state."""
        t, determined = now.t, now.determined
        for k in np.flatnonzero(determined != self._determined):
            p = self._now.parameters[k]
            if determined[k]:
                self._numbers.say(t, f"{p.name} is determined: {now.estimate[k]:.4g} ± {now.std[k]:.2g} {p.unit}")
            else:
                self._numbers.say(t, f"{p.name} is not determined any more", warning=True)
        self._determined = determined
        gaps = self._now.statistics.counters.gaps
        if gaps > self._gaps:
            self._mark(t)
            self._numbers.say(t, "a gap too long to bridge: a new window of the balance begins", warning=True)
        self._gaps = gaps
