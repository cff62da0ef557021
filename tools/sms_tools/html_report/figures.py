"""Figures of a page: Matplotlib's SVG in the page's own colours, light or dark."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import StringIO

from markupsafe import Markup
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sms_online.stream import Array

# Colours of pages and figures by name, on light and on dark ground. The lines' are Okabe and Ito's, darkened or
# lightened where they would vanish. Figures are drawn in the light ones, each of which therefore has one name only.
PALETTE = {
    "ground": ("#ffffff", "#12181f"),
    "panel": ("#f4f6f8", "#1b242d"),
    "ink": ("#1c2733", "#e4e9ee"),
    "muted": ("#5a6875", "#9ba8b5"),
    "rule": ("#e1e7ec", "#2e3a45"),
    "blue": ("#0072b2", "#4db0e8"),
    "orange": ("#d55e00", "#f58f45"),
    "green": ("#009e73", "#2fc79a"),
    "pink": ("#c7659b", "#e39cc4"),
    "ochre": ("#b8860b", "#e0b040"),
    "sky": ("#4aa8dd", "#9ad4f7"),
    "grey": ("#7a8794", "#8b98a5"),
    "brown": ("#8c564b", "#c79186"),
    "mark": ("#b4005a", "#e0337f"),
    "body": ("#c9d2dc", "#3d4b59"),
    "alarm": ("#c0282d", "#f0686c"),
}
LINES = ("blue", "orange", "green", "pink", "ochre", "sky", "grey", "brown")
# Size of a chart, pt of its drawing, which is a pixel each in one column at 400 px and in three at 1400.
WIDTH, HEIGHT = 370.0, 190.0
POINTS_PER_INCH = 72.0
# A line with a band has at most so many points: bands are not simplified, and more cannot be seen.
MOST_POINTS = 200
# Opacity of a band: several overlap.
BAND = 0.11
# Intervals between the numbers of an axis, at most.
TICKS = 6
STYLE = {
    "svg.fonttype": "none",  # text that can be searched and copied
    "path.simplify_threshold": 0.3,  # pt
    "font.family": "DejaVu Sans",  # comes with Matplotlib, so that drawings are the same everywhere
    "font.size": 10.5,
    "lines.linewidth": 1.5,
    "text.color": PALETTE["muted"][0],
    "axes.labelcolor": PALETTE["muted"][0],
    "xtick.color": PALETTE["muted"][0],
    "ytick.color": PALETTE["muted"][0],
    "axes.grid": True,
    "grid.color": PALETTE["rule"][0],
    **dict.fromkeys((f"axes.spines.{side}" for side in ("left", "right", "top", "bottom")), False),
    **dict.fromkeys(("xtick.bottom", "ytick.left"), False),
}


@dataclass(frozen=True)
class Series:
    """A line y (B,) over x (B,), NaN where it has a gap, with bounds (B,) where there are some.

    label: for the key, where it is in one. color: its name; the next of LINES unless given.
    """

    label: str
    x: Array
    y: Array
    lower: Array | None = None
    upper: Array | None = None
    dashed: bool = False
    color: str = ""


@dataclass(frozen=True)
class Chart:
    """A drawing with its caption and its key, (label, colour's name, whether dashed) of each line."""

    caption: str
    key: tuple[tuple[str, str, bool], ...]
    svg: Markup


def chart(
    caption: str,
    series: Sequence[Series],
    x_label: str,
    y_range: tuple[float, float] | None = None,
    marks: Sequence[float] = (),
    log: bool = False,
) -> Chart:
    """A chart of lines; without a range the y axis holds all lines, not their bounds.

    caption: no other chart of the page has it. marks: at these x. log: the y axis.
    """
    colors = [line.color or LINES[k % len(LINES)] for k, line in enumerate(series)]

    def draw(axes: Axes) -> None:
        if log:
            axes.set_yscale("log", nonpositive="mask")
        for line, name in zip(series, colors, strict=True):
            rows = _thinned(line)
            axes.plot(line.x[rows], line.y[rows], "--" if line.dashed else "-", color=ink(name))
        limits = axes.get_ylim()
        for line, name in zip(series, colors, strict=True):
            rows = _thinned(line)
            if line.lower is not None and line.upper is not None:
                bounds = line.lower[rows], line.upper[rows]
                axes.fill_between(line.x[rows], *bounds, color=ink(name), alpha=BAND, linewidth=0)
        for mark in marks:
            axes.axvline(mark, color=ink("alarm"), linestyle=":", linewidth=1.0)
        ends = [float(value) for line in series for value in (line.x.min(), line.x.max())]
        if min(ends) < max(ends):
            axes.set_xlim(min(ends), max(ends))
        axes.set_ylim(y_range or limits)
        axes.set_xlabel(x_label)
        axes.locator_params("x", nbins=TICKS)

    key = tuple((line.label, name, line.dashed) for line, name in zip(series, colors, strict=True) if line.label)
    return Chart(caption, key, drawn(caption, WIDTH, HEIGHT, draw))


def ink(name: str) -> str:
    """The colour that a figure draws with, which its page replaces by its own."""
    return PALETTE[name][0]


def drawn(name: str, width: float, height: float, draw: Callable[[Axes], None], bare: bool = False) -> Markup:
    """A drawing of a size, pt, as part of a page. name: no other drawing of the page has it.

    bare: no axes, and no room for them. The same drawing has the same text, wherever it is made.
    """
    text = StringIO()
    # Not the user's own settings.
    with style.context(["default", {**STYLE, "svg.hashsalt": name}]):
        figure = Figure((width / POINTS_PER_INCH, height / POINTS_PER_INCH), layout=None if bare else "constrained")
        figure.patch.set_visible(False)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0)) if bare else figure.add_subplot()
        axes.patch.set_visible(False)
        if bare:
            axes.set_axis_off()
        draw(axes)
        figure.savefig(text, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    return _inlined(text.getvalue())


def _thinned(line: Series) -> slice:
    return slice(None, None, -(-len(line.x) // MOST_POINTS) if line.lower is not None else 1)


def _inlined(svg: str) -> Markup:
    """An SVG file as part of a page: without header, style and size of its own, in the page's colours."""
    view = re.search(r'viewBox="[^"]*"', svg)
    assert view is not None
    svg = f'<svg {view[0]} role="img">{svg[svg.index("</defs>") + len("</defs>") :]}'
    # Names that nothing refers to are the same in every drawing.
    used = set(re.findall(r"#([\w.]+)", svg))
    svg = re.sub(r' id="([^"]*)"', lambda match: match[0] if match[1] in used else "", svg)
    # A tenth of a point is less than a pixel.
    svg = re.sub(r'(?<= d=")[^"]+', lambda match: re.sub(r"(\.\d)\d+", r"\1", match[0]).replace("\n", ""), svg)
    names = {light: f"var(--{name})" for name, (light, _) in PALETTE.items()}
    svg = re.sub("#[0-9a-f]{6}", lambda match: names.get(match[0], match[0]), svg)
    return Markup(svg.replace("xlink:href", "href"))
