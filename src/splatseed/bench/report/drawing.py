"""Shared by all figures: sizes, panels, colours, legends, and PNG bytes.

Promise: equal data give equal bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {
    "sfm": "#222222",
    "linear": "#0072B2",
    "triangle": "#56B4E9",
    "spline": "#E69F00",
    "mls": "#D55E00",
    "voronoi": "#009E73",
    "depth": "#CC79A7",
    "random": "#999999",
    "cover": "#B8860B",
    "stereo": "#1B7837",
    "auto": "#7B4FA3",
}
"""Colours that the colour-blind can tell apart (Okabe and Ito)."""
OTHER = "#8C564B"
MANY = 8
"""More curves than this in one picture cannot be told apart."""
DPI = 120


class Plot(NamedTuple):
    """A figure: its file's name without suffix, what it shows, and its PNG."""

    name: str
    caption: str
    png: bytes


def method_color(method: str) -> str:
    """The colour of a method."""
    return COLORS.get(method, OTHER)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, its size in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  (slow to import)
    from matplotlib.figure import Figure  # noqa: PLC0415  (loads with its use)

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def panels(count: int) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` panels, up to three per row."""
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = new_figure(max(3.6 * columns, 5.0), 2.9 * rows + 0.4)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[count:]:
        axes.remove()
    return figure, list(panels[:count])


def legend_of(figure: Figure, named: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """Names above the panels, at the left, where a narrow window shows them.

    Args:
        figure: The figure.
        named: A name and a line's style each.
    """
    from matplotlib.lines import Line2D  # noqa: PLC0415  (slow to import)

    handles = [Line2D([], [], label=name, **style) for name, style in named]
    figure.legend(handles=handles, loc="outside upper left", ncols=min(4, len(handles)),
                  fontsize="small", frameon=False)  # fmt: skip


def png(figure: Figure) -> bytes:
    """The figure's bytes.

    Without the version of the library, so that the same data give the same.
    """
    out = BytesIO()
    figure.savefig(out, dpi=DPI, format="png", metadata={"Software": None})
    return out.getvalue()
