"""Numbers over time as rerun entities: parameters with their bounds, residuals, health, evidence, events, a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import rerun as rr

from sms_online.model.parameters import Parameter
from sms_online.stream import Array
from sms_tools.view import style
from sms_tools.view.arm_log import times
from sms_tools.view.frames import Reference
from sms_tools.view.known import BOUNDS, Known
from sms_tools.view.parameter_groups import Group, shortened

PARAMETERS, RESIDUAL, HEALTH, EVIDENCE = "parameters", "residual", "health", "evidence"
TABLE, LOG = "table", "log"
# Of plots of residuals. A relative one of 1 says that the model explains nothing. Whitened ones are drawn in decades:
# noise is 0, and a model that lacks an effect leaves hundreds of times as much.
RELATIVE_RANGE, WHITENED_RANGE = (-0.1, 1.2), (-0.5, 3.5)
# Half height of an event's mark where the axis follows the data.
UNKNOWN_RANGE = 1.0
# Instants that are drawn again on another axis, at most.
MOST_REDRAWN = 600
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
        self._named: set[str] = set()  # entities that came with a name of their own
        self._counted: dict[str, int] = {}  # of these, by folder

    def describe(
        self,
        path: str,
        names: Sequence[str],
        colors: Sequence[tuple[int, ...]] | None = None,
        width: float = 2.0,
        aggregated: bool = True,
    ) -> None:
        """Names, colours and width of an entity's lines; aggregated: as means where there are more than pixels."""
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

    def add_named(self, folder: str, t: float, values: Mapping[str, float]) -> None:
        """Numbers that come with names of their own, each an entity."""
        for name, value in values.items():
            path = f"{folder}/{rr.escape_entity_path_part(name)}"
            if path not in self._named:
                self._named.add(path)
                number = self._counted[folder] = self._counted.get(folder, 0) + 1
                self.describe(path, [name], [style.LINES[(number - 1) % len(style.LINES)]])
            self.add(path, t, np.array([value]))

    def describe_events(self, path: str) -> None:
        """An entity that `mark` draws on."""
        self.describe(path, ["event"], [style.EVENT], width=1.0, aggregated=False)

    def mark(self, path: str, t: float, low: float, high: float) -> None:
        """A vertical line at an instant, s."""
        for k, value in enumerate((low, high, np.nan)):
            self.add(path, t + k * MARK_WIDTH, np.array([value]))

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

    def say(self, t: float, text: str, warning: bool = False) -> None:
        """A line of the log; it begins with the time, for the viewer's own column of it is too narrow to be read."""
        line = rr.TextLog.columns(text=[f"{t:.2f} s: {text}"], level=["WARN" if warning else "INFO"])
        self._stream.send_columns(LOG, times(np.array([t])), line)


class ParameterLog:
    """Estimates in SI units, exact, and what is drawn of them: deviations with their bounds, beside a reference."""

    def __init__(self, numbers: NumberLog, groups: Sequence[Group]) -> None:
        self._numbers = numbers
        self._past: list[Known] = []  # thinned, to be drawn again about another reference
        self._marks: list[float] = []
        self._drawings = -1
        self.arrange(groups)

    def arrange(self, groups: Sequence[Group]) -> None:
        """Draw in these groups from now on, and once more in them what has been drawn so far."""
        self.groups = groups
        self._drawings += 1
        for group in groups:
            colors = [style.LINES[k % len(style.LINES)] for k in range(len(group.labels))]
            for number in ("estimate", "std"):
                self._numbers.describe(f"{PARAMETERS}/{group.path}/{number}", group.labels, colors)
            self._numbers.describe(f"{self.drawn(group)}/deviation", group.labels, colors, width=2.5)
            self._numbers.describe_events(f"{self.drawn(group)}/events")
            bounds = [style.translucent(color) for color in colors]
            self._numbers.describe(f"{self.drawn(group)}/two_sigma", ["± 2σ"] * len(bounds * 2), bounds * 2, width=1.0)
        for known in self._past:
            self._draw(known)
        for t in self._marks:
            self._mark(t)

    def drawn(self, group: Group) -> str:
        """The entity below which a group is drawn now."""
        return f"{PARAMETERS}/{group.path}/drawing_{self._drawings}"

    def add(self, known: Known) -> None:
        """Estimates of an instant; only what is determined is drawn."""
        for group in self.groups:
            self._numbers.add(f"{PARAMETERS}/{group.path}/estimate", known.t, known.estimate[group.indices])
            self._numbers.add(f"{PARAMETERS}/{group.path}/std", known.t, known.std[group.indices])
        self._draw(known)
        self._past.append(known)
        if len(self._past) > MOST_REDRAWN:
            self._past = self._past[::2]

    def _draw(self, known: Known) -> None:
        # There were fewer before an event has added some.
        n = sum(group.indices.size for group in self.groups)
        estimate, std = np.full((2, n), np.nan)
        there = np.flatnonzero(known.determined)
        estimate[there], std[there] = known.estimate[there], known.std[there]
        for group in self.groups:
            drawn = (estimate[group.indices] - group.zero) / group.scale
            width = BOUNDS * std[group.indices] / group.scale
            self._numbers.add(f"{self.drawn(group)}/deviation", known.t, drawn)
            self._numbers.add(f"{self.drawn(group)}/two_sigma", known.t, np.concatenate((drawn + width, drawn - width)))

    def mark(self, t: float) -> None:
        """A vertical line in every plot of parameters."""
        self._marks.append(t)
        self._mark(t)

    def _mark(self, t: float) -> None:
        for group in self.groups:
            half = UNKNOWN_RANGE if group.half_range is None else group.half_range
            self._numbers.mark(f"{self.drawn(group)}/events", t, -half, half)


def markdown_table(parameters: Sequence[Parameter], references: Sequence[Reference | None], now: Known) -> str:
    """Symbol, unit, estimate ± std and the reference; a dash where the data determine nothing."""
    estimate, std, determined = now.estimate, now.std, now.determined
    compared = "true" if any(reference is not None and reference.is_true for reference in references) else "nominal"
    lines = [f"| parameter | unit | estimate | ± std | {compared} | deviation |", "|:--|:--|--:|--:|--:|--:|"]
    for k, (p, reference) in enumerate(zip(parameters, references, strict=True)):
        value = spread = deviation = "–"
        if determined[k]:
            value, spread = f"{estimate[k]:.6g}", f"{std[k]:.2g}"
            if reference is not None and reference.value:
                deviation = f"{100.0 * (estimate[k] / reference.value - 1.0):+.3g} %"
        known = "–" if reference is None else f"{reference.value:.6g}"
        lines.append(f"| {shortened(p.symbol)} | {p.unit} | {value} | {spread} | {known} | {deviation} |")
    return "\n".join(lines)
