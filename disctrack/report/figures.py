"""Figures: style of axes, files, and embedding in pages."""

import base64
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

from calibration.kit.arrays import Array
from disctrack.files.whole import whole_file
from disctrack.report.palette import GRID, INK, MUTED

DPI = 150
NO_TITLE = (0.95, 0.15, 0.55, 0.15)  # margins [in] of labelled axes
BAND = 3.0  # sigmas shown as a band
LARGE = 400_000  # [bytes] larger vector graphics, of thousands of points, are embedded as a bitmap


@dataclass(frozen=True)
class Drawn:
    """One figure with its caption."""

    name: str  # of the file
    title: str
    caption: str
    figure: Figure


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
    figure, found = panels(*size, len(rows), margins=NO_TITLE, sharex=True, height_ratios=heights)
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


def dress(axes: Axes) -> None:
    """Grid, colours and spines of every plot."""
    axes.grid(True, color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    for spine in axes.spines.values():
        spine.set_color(MUTED)
    axes.tick_params(colors=INK, labelsize=9)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)


def plain_powers(axis: Axis) -> None:
    """Numbers on a logarithmic axis: 3 and 20, not 3 × 10⁰ and 2 × 10¹; powers of ten if it spans many."""
    low, high = sorted(axis.get_view_interval())
    if low > 1e-3 and high < 1e5 and high < 1e3 * low:
        axis.set_major_formatter("{x:g}")
        digits = "2357" if high < 12 * low else "25" if high < 40 * low else ""
        axis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in digits else "")


def panels(
    width: float,
    height: float,
    rows: int = 1,
    columns: int = 1,
    margins: tuple[float, float, float, float] | None = None,
    **options: Any,
) -> tuple[Figure, list[Axes]]:
    """A figure [in] with its axes row by row, dressed; options as for matplotlib's `subplots`.

    margins : as for `lay_out`; by default from the size of all labels
    """
    figure = Figure(figsize=(width, height), layout="constrained" if margins is None else None)
    if margins is not None:
        lay_out(figure, (rows, columns), margins, (0.9, 0.2))
    grid = figure.subplots(rows, columns, squeeze=False, **options)
    for axes in grid.flat:
        dress(axes)
    return figure, list(grid.flat)


def lay_out(
    figure: Figure,
    shape: tuple[int, int],
    margins: tuple[float, float, float, float] = (0.8, 0.2, 0.6, 0.7),
    gaps: tuple[float, float] = (0.9, 0.6),
) -> None:
    """Place a grid of axes with fixed margins: matplotlib's automatic layout takes longer than drawing.

    shape : rows, columns; margins : left, right, bottom, top [in]; gaps : between columns, between rows [in]
    """
    (width, height), (rows, columns), (left, right, bottom, top) = figure.get_size_inches(), shape, margins
    across = (width - left - right - (columns - 1) * gaps[0]) / columns
    down = (height - bottom - top - (rows - 1) * gaps[1]) / rows
    figure.subplots_adjust(
        left / width, bottom / height, 1 - right / width, 1 - top / height, gaps[0] / across, gaps[1] / down
    )


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure atomically; the format is that of the suffix. Raises OutputError."""
    FigureCanvasAgg(figure)
    undated = {"CreationDate": None} if path.suffix == ".pdf" else None
    with whole_file(path) as part:
        figure.savefig(part, format=path.suffix[1:], dpi=DPI, metadata=undated)
    return path


def draw(
    folder: Path, figures: Sequence[Drawn], kinds: Sequence[str] = ("png", "pdf")
) -> tuple[list[Path], dict[str, str]]:
    """Write figures/*.png, *.pdf (`kinds`, may be none); returns them, and a data URI per name. Raises OutputError."""
    written: list[Path] = []
    pictures: dict[str, str] = {}
    with rc_context({"font.size": 10, "svg.fonttype": "path", "svg.hashsalt": "disctrack", "mathtext.fontset": "cm"}):
        for drawn in figures:
            FigureCanvasAgg(drawn.figure)
            if (engine := drawn.figure.get_layout_engine()) is not None:
                engine.execute(drawn.figure)
                drawn.figure.set_layout_engine("none")  # laid out once, for all formats
            written += [save_figure(drawn.figure, folder / "figures" / f"{drawn.name}.{kind}") for kind in kinds]
            pictures[drawn.name] = _inline(drawn.figure)
    return written, pictures


def _inline(figure: Figure) -> str:
    """The figure as a data URI: vector graphics, or a bitmap if those exceed LARGE."""
    for kind, metadata in (("svg", {"Date": None}), ("png", None)):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, dpi=DPI, metadata=metadata)
        if len(buffer.getvalue()) < LARGE:
            break
    return f"data:image/{'svg+xml' if kind == 'svg' else kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"
