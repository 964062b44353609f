"""Figures: style of axes, files, and embedding in pages."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from calibration.kit.types import Array
from disctrack.files.whole import write_whole
from disctrack.report.palette import GRID, INK, MUTED

DPI = 150
BAND = 3.0  # sigmas shown as a band


@dataclass(frozen=True)
class Curve:
    """A line of a chart, or points."""

    x: Array
    y: Array
    colour: str
    label: str = ""
    style: str = "-"  # of matplotlib: "--", ":", ".", "o"
    sigma: Array | None = None  # if given, a band of ± BAND sigmas is drawn


def chart(
    x_label: str,
    *rows: tuple[str, Sequence[Curve]],
    size: tuple[float, float] = (7.2, 3.6),
    equal: bool = False,
    heights: Sequence[float] | None = None,
) -> Figure:
    """Curves over a common abscissa. rows : label of the ordinate, curves.

    size : [in];  equal : same scale of both axes, for positions in a plane;  heights : of the rows, relative
    """
    figure, found = panels(*size, len(rows), top=0.15, sharex=True, height_ratios=heights)
    for axes, (y_label, curves) in zip(found, rows, strict=True):
        for curve in curves:
            if curve.sigma is not None:
                low, high = curve.y - BAND * curve.sigma, curve.y + BAND * curve.sigma
                axes.fill_between(curve.x, low, high, color=curve.colour, alpha=0.25, linewidth=0)
            axes.plot(curve.x, curve.y, curve.style, color=curve.colour, label=curve.label, linewidth=1.1, markersize=3)
        labelled = sum(bool(curve.label) for curve in curves)
        if labelled:
            axes.legend(frameon=False, fontsize=9, ncols=min(labelled, 3) if len(rows) > 1 else 1)
        axes.set_ylabel(y_label)
        if equal:
            axes.set_aspect("equal", adjustable="datalim")
    found[-1].set_xlabel(x_label)
    return figure


def plain_powers(axis: Axis) -> None:
    """Numbers on a logarithmic axis: 3 and 20, not 3 × 10⁰ and 2 × 10¹; powers of ten if it spans many."""
    low, high = sorted(axis.get_view_interval())
    if low > 1e-3 and high < 1e5 and high < 1e3 * low:
        axis.set_major_formatter("{x:g}")
        digits = "2357" if high < 12 * low else "25" if high < 40 * low else ""
        axis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in digits else "")


def panels(
    width: float, height: float, rows: int = 1, columns: int = 1, top: float | None = None, **options: Any
) -> tuple[Figure, list[Axes]]:
    """A figure [in] with its axes row by row, dressed; options as for matplotlib's `subplots`.

    top : margin [in] above axes with fixed margins; by default, these are by matplotlib from the size of all labels,
    which takes longer than drawing
    """
    figure = Figure(figsize=(width, height), layout="constrained" if top is None else None)
    if top is not None:
        figure.subplots_adjust(0.95 / width, 0.55 / height, 1 - 0.15 / width, 1 - top / height, 0.24, 0.2)
    grid = figure.subplots(rows, columns, squeeze=False, **options)
    for axes in grid.flat:
        axes.grid(True, color=GRID, linewidth=0.7)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        for spine in axes.spines.values():
            spine.set_color(MUTED)
        axes.tick_params(colors=INK, labelsize=9)
        axes.xaxis.label.set_color(INK)
        axes.yaxis.label.set_color(INK)
    return figure, list(grid.flat)


def encoded(figure: Figure, kind: str) -> bytes:
    """The figure as a file of this kind ("png", "pdf", "svg"), without the date."""
    FigureCanvasAgg(figure)
    if engine := figure.get_layout_engine():  # laid out once for all formats
        engine.execute(figure)
        figure.set_layout_engine("none")
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    content = io.BytesIO()
    with rc_context({"font.size": 10, "svg.fonttype": "path", "svg.hashsalt": "disctrack", "mathtext.fontset": "cm"}):
        figure.savefig(content, format=kind, dpi=DPI, metadata=undated.get(kind))
    return content.getvalue()


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure atomically; the format is that of the suffix. Raises OutputError."""
    write_whole(path, encoded(figure, path.suffix[1:]))
    return path
