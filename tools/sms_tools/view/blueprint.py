"""The one layout of all sessions: judgement, arm, parameters, residual, evidence, health, log, on fixed axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sms_tools.view import banner, number_log, style
from sms_tools.view.arm_log import ARM, TIMELINE, TIP
from sms_tools.view.number_log import ParameterLog
from sms_tools.view.scene import Drawing, Scene
from sms_tools.view.tracker_log import INNOVATIONS, MEMORY, TrackerLog

# Plots show so much of the past, s: the whole of the example's motion, and of longer sessions what a person remembers;
# and so much beyond now, where nothing is drawn yet and the legend hides nothing: of 400 pixels it takes 60 to 130.
WINDOW, AHEAD = 20.0, 8.0
# Share of the height for the judgement: a heading and a line.
BANNER = 0.125
# The same across: room beyond the range of what is drawn.
MARGIN = 1.1
# Past of the tip that is drawn, s: a good part of one swing.
TRAIL = 4.0
# More plots of parameters than this side by side are too small to read; they go into tabs.
MOST_PLOTS = 6
# Distance of the eye over the radius of what is to be seen: the viewer's field of view is 55° high.
EYE_DISTANCE = 2.2
# In space the camera looks at the arm's first pose, with so much room around it.
ROOM = 1.15
# Direction from the arm to the eye of a spatial system, from above one side.
OBLIQUE = np.array((0.35, -0.8, 0.5))


def layout(
    scene: Scene,
    parameters: ParameterLog,
    trackers: TrackerLog,
    first: Drawing,
    begin: float | None,
    live: bool = False,
    diagnosed: bool = False,
) -> rrb.Blueprint:
    """Layout for an arm that is first seen as the first picture of `first` shows it.

    begin: s, where the plots begin while the session is shorter than their window, None from then on. trackers: curves
    of several. live: with plots of the source's latency and clocks. diagnosed: verdict and evidence are in front.
    """
    plots = _Plots(begin)
    shown = rrb.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(TIMELINE, visible=False)],
        text_log_columns=["LogLevel", "Body"],
    )
    log = rrb.TextLogView(origin=number_log.LOG, name="Events and verdicts", columns=shown)
    table = rrb.TextDocumentView(origin=number_log.TABLE, name="Parameters")
    texts = rrb.Tabs(table, log, active_tab=int(diagnosed))
    left = rrb.Vertical(arm_view(scene, first), texts, row_shares=[11, 9])
    below = rrb.Tabs(plots.residual(), plots.evidence(), plots.health(live), active_tab=int(diagnosed))
    above = plots.parameters(parameters)
    if trackers.curves():
        above = rrb.Tabs(above, plots.trackers(trackers), active_tab=0)
    right = rrb.Vertical(above, below, row_shares=[7, 3])
    session = rrb.Horizontal(left, right, column_shares=[2, 3])
    return rrb.Blueprint(
        rrb.Vertical(_judgement(), session, row_shares=[BANNER, 1.0 - BANNER]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_views=False,
    )


def _judgement() -> rrb.Horizontal:
    """May the numbers be trusted?"""
    seen = (-banner.LAMP_SHOWN, banner.LAMP_SHOWN)
    lamp = rrb.Spatial2DView(
        origin=banner.LAMP,
        name="May the numbers be trusted?",
        visual_bounds=rrb.VisualBounds2D(x_range=seen, y_range=seen),
        titlebar=False,
    )
    words = rrb.TextDocumentView(origin=banner.WORDS, name="Verdict", titlebar=False)
    return rrb.Horizontal(lamp, words, column_shares=[1, 15])


def arm_view(scene: Scene, first: Drawing) -> rrb.Spatial3DView:
    """The arm as it is first seen in `first`, all of it and its base."""
    planar = scene.model.layout.planar
    center, half = scene.box
    if planar:
        # All that the arm can reach and the spacecraft, around joint 1.
        middle = first.base_origin[0]
        extent = max(scene.reach, float(np.linalg.norm(np.abs(center) + half)))
        direction, up = np.array((0.0, 0.0, 1.0)), (0.0, 1.0, 0.0)
    else:
        box = first.base_origin[0] + first.base_rotation[0] @ center
        points = np.concatenate(((box + half)[None], (box - half)[None], *(line[0] for line in first.links)))
        middle = (points.max(axis=0) + points.min(axis=0)) / 2.0
        extent = ROOM * float(np.linalg.norm(points - middle, axis=1).max())
        direction, up = OBLIQUE / np.linalg.norm(OBLIQUE), (0.0, 0.0, 1.0)
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=middle + EYE_DISTANCE * extent * direction, look_target=middle, eye_up=up
    )
    grid = 10.0 ** np.floor(np.log10(scene.reach))
    trail = rr.TimeRange(
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-TRAIL), end=rr.TimeRangeBoundary.cursor_relative(seconds=0)
    )
    factor = f", deflections × {scene.exaggeration:g}" if scene.exaggeration != 1.0 else ""
    return rrb.Spatial3DView(
        origin=ARM,
        name=f"Arm{' from above' if planar else ''}, grid {grid:g} m{factor}; thin: as if it were rigid",
        eye_controls=eye,
        background=style.BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=True, spacing=grid),
        overrides={TIP: rrb.VisibleTimeRanges([rr.VisibleTimeRange(TIMELINE, trail)])},
    )


class _Plots:
    """Plots over time. begin: see `layout`."""

    def __init__(self, begin: float | None) -> None:
        start = rr.TimeRangeBoundary.cursor_relative(seconds=-WINDOW)
        if begin is not None:
            start = rr.TimeRangeBoundary.absolute(seconds=begin)
        end, ahead = (rr.TimeRangeBoundary.cursor_relative(seconds=seconds) for seconds in (0.0, AHEAD))
        self._axis = rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=ahead))
        self._ranges = rrb.VisibleTimeRanges([rr.VisibleTimeRange(TIMELINE, rr.TimeRange(start=start, end=end))])

    def _plot(
        self, name: str, contents: Sequence[str], y: tuple[float, float] | None = None, legend: bool = True
    ) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin="/",
            contents=list(contents),
            name=name,
            axis_y=rrb.ScalarAxis(range=y) if y is not None else None,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
            axis_x=self._axis,
            time_ranges=self._ranges,
        )

    def parameters(self, parameters: ParameterLog) -> rrb.Container:
        """A plot for each group; in tabs where there are many."""
        plots: dict[str, list[rrb.TimeSeriesView]] = {}
        for group in parameters.groups:
            path = parameters.drawn(group)
            y = None if group.half_range is None else (-MARGIN * group.half_range, MARGIN * group.half_range)
            contents = [f"{path}/deviation", f"{path}/two_sigma", f"{path}/events"]
            plots.setdefault(group.kind, []).append(self._plot(group.title[:1].upper() + group.title[1:], contents, y))
        return _in_tabs(plots, "Parameters")

    def trackers(self, trackers: TrackerLog) -> rrb.Container:
        """A plot for each parameter with the curves of all trackers; a click on a name in its legend hides one."""
        plots = {
            kind: [self._plot(title, [f"{entity}/**"]) for title, entity in curves]
            for kind, curves in trackers.curves().items()
        }
        return _in_tabs(plots, "Trackers")

    def residual(self) -> rrb.Container:
        """What is not explained; red where it is too much."""
        residual = number_log.RESIDUAL
        relative = self._plot(
            "Unexplained torque, share",
            [f"{residual}/relative{each}" for each in ("", "_limit", "_beyond", "_events")],
            number_log.RELATIVE_RANGE,
        )
        whitened = self._plot(
            "Rows over their noise, log10",
            [
                f"{residual}/{each}"
                for each in ("whitened/**", "noise", *(f"whitened_{part}" for part in ("limit", "beyond", "events")))
            ],
            number_log.WHITENED_RANGE,
        )
        energy = self._plot("Energy residual, rms, J", [f"{residual}/energy"], legend=False)
        return rrb.Horizontal(relative, whitened, energy, name="Residual")

    def evidence(self) -> rrb.TimeSeriesView:
        """Candidates for what the model lacks."""
        return self._plot("Evidence for missing effects, log10 of the gain", [f"{number_log.EVIDENCE}/**"])

    def health(self, live: bool) -> rrb.Container:
        """Health of the data and, live, of their source."""
        health = number_log.HEALTH
        plots = [
            self._plot("Rate, samples/s", [f"{health}/rates/**"], legend=False),
            self._plot("Lost, dropped, bridged, counts", [f"{health}/counts/**"]),
            self._plot("NIS, log10", [f"{INNOVATIONS}/**"]),
            self._plot("Memory, s", [f"{MEMORY}/**"], legend=False),
        ]
        if live:
            plots += [
                self._plot("Latency, ms", [f"{health}/latency/**"]),
                self._plot("Clock offsets, ms", [f"{health}/clocks/**"]),
            ]
        return rrb.Grid(*plots, grid_columns=3 if live else len(plots), name="Health")


def _in_tabs(plots: Mapping[str, list[rrb.TimeSeriesView]], name: str) -> rrb.Container:
    """Plots by kind side by side; in tabs where there are many."""
    together = [plot for kind in plots.values() for plot in kind]
    if len(together) <= MOST_PLOTS:
        return rrb.Grid(*together, grid_columns=2, name=name)
    tabs: list[tuple[list[str], list[rrb.TimeSeriesView]]] = []
    for kind, members in plots.items():
        if tabs and len(tabs[-1][1]) + len(members) <= MOST_PLOTS:
            tabs[-1][0].append(kind)
            tabs[-1][1].extend(members)
        else:
            tabs.append(([kind], members))
    return rrb.Tabs(*(rrb.Grid(*shown, grid_columns=2, name=", ".join(kinds)) for kinds, shown in tabs), name=name)
