"""Numbers over time as rerun entities: parameters with their bounds, residuals, health, evidence, events, a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from sms_online.stream import Array
from sms_tools.view import style
from sms_tools.view.arm_log import times
from sms_tools.view.parameter_groups import Group

PARAMETERS, RESIDUAL, HEALTH, EVIDENCE = "parameters", "residual", "health", "evidence"
TABLE, LOG = "table", "log"
BOUNDS = 2.0  # standard deviations
# An event is drawn as a line from bottom to top of a plot: two values this far apart, s.
MARK_WIDTH = 1e-9


@dataclass
class Columns:
    """Rows of numbers that wait to be sent together."""

    t: list[float] = field(default_factory=list)
    rows: list[Array] = field(default_factory=list)


class NumberLog:
    """Gathers rows of named numbers per entity and sends them as columns."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._waiting: dict[str, Columns] = {}
        self._known: set[str] = set()

    def describe(
        self,
        path: str,
        names: Sequence[str],
        colors: Sequence[tuple[int, ...]] | None = None,
        width: float = 2.0,
        aggregated: bool = True,
    ) -> None:
        """Names, colours and width of an entity's lines; aggregated: as means where there are more than pixels."""
        self._known.add(path)
        n = len(names)
        chosen = [style.LINES[k % len(style.LINES)] for k in range(n)] if colors is None else list(colors)
        policy = None if aggregated else rr.components.AggregationPolicy.Off
        lines = rr.SeriesLines(names=list(names), colors=chosen, widths=[width] * n, aggregation_policy=policy)
        self._stream.log(path, lines, static=True)

    def add(self, path: str, t: float, values: Array) -> None:
        """One row at an instant; NaN leaves a gap. Later rows may have more numbers."""
        columns = self._waiting.setdefault(path, Columns())
        if columns.rows and columns.rows[0].size != values.size:
            self._send(path, columns)
            columns = self._waiting[path] = Columns()
        columns.t.append(t)
        columns.rows.append(values)

    def add_named(self, folder: str, t: float, values: dict[str, float]) -> None:
        """Numbers that come with names of their own, each an entity."""
        for name, value in values.items():
            path = f"{folder}/{rr.escape_entity_path_part(name)}"
            if path not in self._known:
                colors = [style.LINES[len(self._known) % len(style.LINES)]]
                self.describe(path, [name], colors)
            self.add(path, t, np.array([value]))

    def send(self) -> None:
        """Send what waits."""
        for path, columns in self._waiting.items():
            self._send(path, columns)
        self._waiting.clear()

    def _send(self, path: str, columns: Columns) -> None:
        values = np.array(columns.rows)
        scalars = rr.Scalars.columns(scalars=values.ravel()).partition(np.full(len(values), values.shape[1]))
        self._stream.send_columns(path, times(np.array(columns.t)), scalars)

    def table(self, t: float, text: str) -> None:
        """The table of all parameters as it is now."""
        document = rr.TextDocument.columns(text=[text], media_type=["text/markdown"])
        self._stream.send_columns(TABLE, times(np.array([t])), document)

    def tell(self, t: float, text: str, warning: bool = False) -> None:
        """A line of the log."""
        level = "WARN" if warning else "INFO"
        self._stream.send_columns(LOG, times(np.array([t])), rr.TextLog.columns(text=[text], level=[level]))


class ParameterLog:
    """Estimates in SI units, exact, and what is drawn of them: deviations with their bounds, beside a reference."""

    def __init__(self, numbers: NumberLog, groups: Sequence[Group]) -> None:
        self._numbers = numbers
        self.groups = groups
        for group in groups:
            colors = [style.LINES[k % len(style.LINES)] for k in range(len(group.labels))]
            path = f"{PARAMETERS}/{group.path}"
            numbers.describe(f"{path}/estimate", group.labels, colors)
            numbers.describe(f"{path}/std", group.labels, colors)
            numbers.describe(f"{path}/deviation", group.labels, colors, width=2.5)
            numbers.describe(f"{path}/events", ["event"], [style.EVENT], width=1.0, aggregated=False)
            bounds = [style.translucent(color) for color in colors]
            numbers.describe(f"{path}/two_sigma", ["± 2σ"] * len(bounds * 2), bounds * 2, width=1.0)

    def add(self, t: float, estimate: Array, std: Array, determined: NDArray[np.bool_]) -> None:
        """Estimates (n,) and their standard deviations (n,); only what is determined (n,) is drawn."""
        shown, deviation = np.where(determined, estimate, np.nan), np.where(determined, std, np.nan)
        for group in self.groups:
            k, path = group.indices, f"{PARAMETERS}/{group.path}"
            self._numbers.add(f"{path}/estimate", t, estimate[k])
            self._numbers.add(f"{path}/std", t, std[k])
            drawn = (shown[k] - group.zero) / group.scale
            width = BOUNDS * deviation[k] / group.scale
            self._numbers.add(f"{path}/deviation", t, drawn)
            self._numbers.add(f"{path}/two_sigma", t, np.concatenate((drawn + width, drawn - width)))

    def mark(self, t: float) -> None:
        """A vertical line in every plot of parameters with a fixed axis."""
        for group in self.groups:
            if group.half_range is None:
                continue
            path = f"{PARAMETERS}/{group.path}/events"
            for k, value in enumerate((-group.half_range, group.half_range, np.nan)):
                self._numbers.add(path, t + k * MARK_WIDTH, np.array([value]))
