"""The one layout of all sessions: arm, parameters, residual, evidence, health, log, on fixed axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sms_tools.view import number_log, style
from sms_tools.view.arm_log import ARM, TIMELINE, TIP
from sms_tools.view.parameter_groups import Group
from sms_tools.view.scene import Drawing, Scene

# Plots show so much of the past, s: the whole of the example's motion, and of longer sessions what a person remembers;
# and so much beyond now, or the last label of their axis would be cut.
WINDOW, AHEAD = 20.0, 1.5
# The same across: room beyond the range of what is drawn.
MARGIN = 1.1
# Past of the tip that is drawn, s: a good part of one swing.
TRAIL = 4.0
# More plots of parameters than this side by side are too small to read; they go into tabs.
MOST_PLOTS = 6
# Distance of the eye over the radius of what is to be seen: the viewer's field of view is 55° high.
EYE_DISTANCE = 2.2
# In space the arm is looked at where it begins, with so much room around it.
ROOM = 1.15
# Direction from the arm to the eye of a spatial system, from above one side.
OBLIQUE = np.array((0.35, -0.8, 0.5))


def layout(
    scene: Scene, groups: Sequence[Group], first: Drawing, live: bool = False, diagnosed: bool = False
) -> rrb.Blueprint:
    """Layout for an arm that is first seen as the first picture of `first` shows it.

    live: with plots of the source's latency and clocks. diagnosed: verdict and evidence are in front.
    """
    shown = rrb.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(TIMELINE, visible=False)],
        text_log_columns=["LogLevel", "Body"],
    )
    log = rrb.TextLogView(origin=number_log.LOG, name="Events and verdicts", columns=shown)
    table = rrb.TextDocumentView(origin=number_log.TABLE, name="Parameters")
    told = rrb.Tabs(table, log, active_tab=int(diagnosed))
    left = rrb.Vertical(_arm(scene, first), told, row_shares=[11, 9])
    below = rrb.Tabs(_residual(), _evidence(), _health(live), active_tab=int(diagnosed))
    right = rrb.Vertical(_parameters(groups), below, row_shares=[7, 3])
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_views=False,
    )


def _arm(scene: Scene, first: Drawing) -> rrb.Spatial3DView:
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
    factor = f", deflections × {scene.exaggeration:g}" if scene.exaggeration != 1.0 else ""
    return rrb.Spatial3DView(
        origin=ARM,
        name=f"Arm{' from above' if planar else ''}, grid {grid:g} m{factor}; thin: as if it were rigid",
        eye_controls=eye,
        background=style.BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=True, spacing=grid),
        overrides={TIP: rrb.VisibleTimeRanges([rr.VisibleTimeRange(TIMELINE, _range(TRAIL))])},
    )


def _range(seconds: float, ahead: float = 0.0) -> rr.TimeRange:
    """The last seconds before the instant that the viewer shows, and some beyond it."""
    return rr.TimeRange(
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-seconds),
        end=rr.TimeRangeBoundary.cursor_relative(seconds=ahead),
    )


def _plot(
    name: str, contents: Sequence[str], y: tuple[float, float] | None = None, legend: bool = True
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(contents),
        name=name,
        axis_y=rrb.ScalarAxis(range=y) if y is not None else None,
        # Over the past, of which the first seconds have no estimate yet.
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        axis_x=rrb.TimeAxis(view_range=_range(WINDOW, AHEAD)),
        time_ranges=rrb.VisibleTimeRanges([rr.VisibleTimeRange(TIMELINE, _range(WINDOW))]),
    )


def _parameters(groups: Sequence[Group]) -> rrb.Container:
    plots: dict[str, list[rrb.TimeSeriesView]] = {}
    for group in groups:
        path = f"{number_log.PARAMETERS}/{group.path}"
        y = None if group.half_range is None else (-MARGIN * group.half_range, MARGIN * group.half_range)
        contents = [f"{path}/deviation", f"{path}/two_sigma", f"{path}/events"]
        plots.setdefault(group.kind, []).append(_plot(group.title[:1].upper() + group.title[1:], contents, y))
    together = [plot for kind in plots.values() for plot in kind]
    if len(together) <= MOST_PLOTS:
        return rrb.Grid(*together, grid_columns=2)
    tabs: list[tuple[list[str], list[rrb.TimeSeriesView]]] = []
    for kind, members in plots.items():
        if tabs and len(tabs[-1][1]) + len(members) <= MOST_PLOTS:
            tabs[-1][0].append(kind)
            tabs[-1][1].extend(members)
        else:
            tabs.append(([kind], members))
    return rrb.Tabs(*(rrb.Grid(*shown, grid_columns=2, name=", ".join(kinds)) for kinds, shown in tabs))


def _residual() -> rrb.Container:
    residual = number_log.RESIDUAL
    relative = _plot(
        "Unexplained torque, share",
        [f"{residual}/relative", f"{residual}/relative_events"],
        number_log.RELATIVE_RANGE,
    )
    whitened = _plot(
        "Rows over their noise, log10",
        [f"{residual}/whitened/**", f"{residual}/noise", f"{residual}/whitened_events"],
        number_log.WHITENED_RANGE,
    )
    energy = _plot("Energy residual, rms, J", [f"{residual}/energy"], legend=False)
    return rrb.Horizontal(relative, whitened, energy, name="Residual")


def _evidence() -> rrb.TimeSeriesView:
    return _plot("Evidence for missing effects, log10 of the gain", [f"{number_log.EVIDENCE}/**"])


def _health(live: bool) -> rrb.Container:
    health = number_log.HEALTH
    plots = [
        _plot("Rate, samples/s", [f"{health}/rates/**"], legend=False),
        _plot("Lost, dropped, bridged, counts", [f"{health}/counts/**"]),
    ]
    if live:
        plots += [
            _plot("Latency, ms", [f"{health}/latency/**"]),
            _plot("Clock offsets, ms", [f"{health}/clocks/**"]),
        ]
    return rrb.Horizontal(*plots, name="Health")
