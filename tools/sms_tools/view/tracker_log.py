"""What each chosen tracker says, as rerun entities: values with bounds, innovations with their band, memory."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import rerun as rr

from sms_online.evaluation import Evaluation, identifiable
from sms_online.grouping import grouped
from sms_online.model.parameters import Parameter
from sms_tools.view import style
from sms_tools.view.known import BOUNDS
from sms_tools.view.number_log import HEALTH, NumberLog
from sms_tools.view.parameter_groups import kind_of

TRACKERS = "trackers"
INNOVATIONS, MEMORY = f"{HEALTH}/innovations", f"{HEALTH}/memory"


class TrackerLog:
    """The trackers of one session, a colour each; curves of parameters only where there are several.

    labels: of the trackers, the judged one first.
    """

    def __init__(self, numbers: NumberLog, labels: Sequence[str]) -> None:
        self._numbers = numbers
        self._labels = [f"{label}, judged" if k == 0 and len(labels) > 1 else label for k, label in enumerate(labels)]
        self._parts = [re.sub(r"\W+", "_", f"{k} {label}") for k, label in enumerate(labels, start=1)]
        self._drawn: dict[str, tuple[str, str]] = {}  # parameter to kind and title of its plot
        for k, label in enumerate(self._labels):
            color = self._color(k)
            names, colors = [label, "band", "band"], [color, *[style.translucent(color)] * 2]
            numbers.describe(self._path(INNOVATIONS, k), names, colors)
            numbers.describe(self._path(MEMORY, k), [label], [color])

    def curves(self) -> dict[str, list[tuple[str, str]]]:
        """Title and entity of each plot, by kind of the parameter."""
        return grouped((kind, (title, self._folder(name))) for name, (kind, title) in self._drawn.items())

    def describe(self, parameters: Sequence[Parameter]) -> None:
        """Parameters that are estimated, those of before first."""
        for p in parameters if len(self._labels) > 1 else ():
            if p.name in self._drawn:
                continue
            self._drawn[p.name] = kind_of(p), f"{p.name}, {p.unit}".rstrip(", ")
            for k, label in enumerate(self._labels):
                color, path = self._color(k), self._path(self._folder(p.name), k)
                self._numbers.describe(f"{path}/value", [label], [color], width=2.5)
                self._numbers.describe(f"{path}/two_sigma", ["± 2σ"] * 2, [style.translucent(color)] * 2, width=1.0)

    def add(self, t: float, now: Evaluation) -> None:
        """What they say at t, s; values only of what is determined."""
        for k, (estimate, std) in enumerate(now.estimates if self._drawn else ()):
            known = identifiable(estimate.pi, std)
            values, widths = np.where(known, estimate.pi, np.nan), np.where(known, BOUNDS * std, np.nan)
            for p, value, width in zip(now.parameters, values, widths, strict=True):
                path = self._path(self._folder(p.name), k)
                self._numbers.add(f"{path}/value", t, np.array([value]))
                self._numbers.add(f"{path}/two_sigma", t, np.array([value + width, value - width]))
        for k, tracker in enumerate(now.trackers):
            found = tracker.consistency
            if found.nis is not None and found.nis > 0.0:
                band = np.array((found.nis, max(found.lower, np.finfo(float).tiny), found.upper))
                self._numbers.add(self._path(INNOVATIONS, k), t, np.log10(band))
            self._numbers.add(self._path(MEMORY, k), t, np.array([tracker.memory]))

    @staticmethod
    def _color(k: int) -> style.Color:
        return style.LINES[k % len(style.LINES)]

    def _path(self, folder: str, k: int) -> str:
        return f"{folder}/{self._parts[k]}"

    @staticmethod
    def _folder(name: str) -> str:
        return f"{TRACKERS}/{rr.escape_entity_path_part(name)}"
