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

# Plots show so much of the past, s: the whole of the example's motion, and of longer sessions what a person remembers.
WINDOW = 20.0
# Past of the tip that is drawn, s: a good part of one swing.
TRAIL = 4.0
# More plots of parameters than this side by side are too small to read; they go into tabs.
MOST_PLOTS = 6
# Distance of the eye over the radius of what is to be seen: the viewer's field of view is 55° high.
EYE_DISTANCE = 2.2
# In space the arm is looked at where it begins, with so much room around it.
ROOM = 1.3
# Direction from the arm to the eye of a spatial system, from above one side.
OBLIQUE = np.array((0.35, -0.8, 0.5))
# A relative residual of 1 says that the model explains nothing; whitened, 1 is noise.
RELATIVE_RANGE, WHITENED_RANGE = (0.0, 1.2), (0.0, 5.0)


def layout(scene: Scene, groups: Sequence[Group], first: Drawing) -> rrb.Blueprint:
    """Layout for an arm that is first seen as the first picture of `first` shows it."""
    shown = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    log = rrb.TextLogView(origin=number_log.LOG, name="Events and verdicts", columns=shown)
    table = rrb.TextDocumentView(origin=number_log.TABLE, name="Parameters")
    left = rrb.Vertical(_arm(scene, first), rrb.Tabs(table, log, active_tab=0), row_shares=[11, 9])
    below = rrb.Tabs(_residual(), _evidence(), _health(), active_tab=0)
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


def _range(seconds: float) -> rr.TimeRange:
    """The last seconds before the instant that the viewer shows."""
    return rr.TimeRange(
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-seconds), end=rr.TimeRangeBoundary.cursor_relative()
    )


def _plot(
    name: str, contents: Sequence[str], y: tuple[float, float] | None = None, legend: bool = True
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(contents),
        name=name,
        axis_y=rrb.ScalarAxis(range=y) if y is not None else None,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        axis_x=rrb.TimeAxis(view_range=_range(WINDOW)),
        time_ranges=rrb.VisibleTimeRanges([rr.VisibleTimeRange(TIMELINE, _range(WINDOW))]),
    )


def _parameters(groups: Sequence[Group]) -> rrb.Container:
    plots: dict[str, list[rrb.TimeSeriesView]] = {}
    for group in groups:
        path = f"{number_log.PARAMETERS}/{group.path}"
        y = None if group.half_range is None else (-group.half_range, group.half_range)
        contents = [f"{path}/deviation", f"{path}/two_sigma", f"{path}/events"]
        plots.setdefault(group.kind, []).append(_plot(group.title[:1].upper() + group.title[1:], contents, y))
    together = [plot for kind in plots.values() for plot in kind]
    if len(together) <= MOST_PLOTS:
        return rrb.Grid(*together, grid_columns=2)
    return rrb.Tabs(*(rrb.Grid(*members, grid_columns=2, name=kind) for kind, members in plots.items()))


def _residual() -> rrb.Container:
    relative = _plot("Unexplained torque or force, share", [f"{number_log.RESIDUAL}/relative"], RELATIVE_RANGE)
    whitened = _plot(
        "Whitened residual, 1 is noise",
        [f"{number_log.RESIDUAL}/whitened/**", f"{number_log.RESIDUAL}/noise"],
        WHITENED_RANGE,
    )
    energy = _plot("Energy residual, rms, J", [f"{number_log.RESIDUAL}/energy"])
    return rrb.Horizontal(relative, whitened, energy, name="Residual")


def _evidence() -> rrb.TimeSeriesView:
    return _plot("Evidence for missing effects, log10 of the gain", [f"{number_log.EVIDENCE}/**"])


def _health() -> rrb.Container:
    health = number_log.HEALTH
    return rrb.Horizontal(
        _plot("Samples/s", [f"{health}/rates/**"]),
        _plot("Lost, dropped and bridged, counts", [f"{health}/counts/**"]),
        _plot("Of the source: latency, clocks", [f"{health}/source/**"]),
        name="Health",
    )
