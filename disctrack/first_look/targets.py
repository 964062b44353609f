"""The declared dots and board as PDF, true to scale: from recording.toml, so that print and declaration agree."""

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from disctrack.disc import Disc
from disctrack.errors import OutputError

PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 8.0  # that printers cannot print
RULER_MM = 100.0
GAP_MM = 4.0  # between two discs on a sheet
_CREDIT = 'print at 100 %, not "fit to page"; the bar must measure 100.0 mm'


def dots_figure(disc: Disc, paper: str = "a4", dark: bool = True) -> Figure:
    """Sheet with as many faces as fit: dots, the rim to cut along, four ticks outside it. Raises OutputError.

    dark : black dots on white paper; otherwise white dots in a black face
    """
    width, height = PAPERS_MM[paper]
    diameter = 2e3 * disc.radius
    places = list(_places(width, height, diameter))
    if not places:
        said = f"a disc of {diameter:g} mm does not fit on {paper.upper()} with its ruler"
        raise OutputError(f"{said}. Choose a larger paper.")
    figure, axes = _sheet(width, height)
    ink, ground = ("black", "white") if dark else ("white", "black")
    for x, y in places:
        axes.add_patch(Circle((x, y), diameter / 2, facecolor=ground, edgecolor="#999999", linewidth=0.3))
        for u, v in disc.marker_centres_body[:, :2] * 1e3:
            axes.add_patch(Circle((x + u, y + v), disc.marker_diameter * 500, facecolor=ink, linewidth=0))
        # outside the rim: marks on the face could be detected as dots
        for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            r = np.array([diameter / 2 + 0.5, diameter / 2 + 2.5])
            axes.plot(x + dx * r, y + dy * r, color="#999999", linewidth=0.4)
    _footer(axes, width, f"disc {diameter:g} mm, {disc.n_markers} dots of {1e3 * disc.marker_diameter:g} mm; {_CREDIT}")
    return figure


def board_figure(inner_corners: tuple[int, int], square_mm: float, paper: str = "a4") -> Figure:
    """Chessboard with a light rim of at least one square. Raises OutputError if it does not fit."""
    columns, rows = inner_corners
    turned = columns > rows  # so that its long side is along that of the paper
    size = np.array([rows + 1, columns + 1] if turned else [columns + 1, rows + 1]) * square_mm
    width, height = PAPERS_MM[paper]
    across = size + 2 * square_mm  # with the rim
    room = np.array([width - 2 * MARGIN_MM, height - 2 * MARGIN_MM - 14])
    if (across > room).any():
        raise OutputError(
            f"a board of {columns} x {rows} inner corners of {square_mm:g} mm needs {across[0]:g} x {across[1]:g} mm "
            f"with the light rim; {paper.upper()} has {room[0]:.0f} x {room[1]:.0f} mm. Choose a larger paper."
        )
    figure, axes = _sheet(width, height)
    left, bottom = (width - size[0]) / 2, (height - size[1]) / 2 + 5
    for i in range(columns + 1):
        for j in range(rows + 1):
            if (i + j) % 2 == 0:  # the square outside corner 0 is dark
                x, y = (rows - j, i) if turned else (i, j)
                place = (left + x * square_mm, bottom + y * square_mm)
                axes.add_patch(Rectangle(place, square_mm, square_mm, facecolor="black", lw=0, snap=False))
    _footer(axes, width, f"{columns} x {rows} inner corners, squares of {square_mm:g} mm; {_CREDIT}")
    return figure


def _places(width: float, height: float, diameter: float) -> Iterator[tuple[float, float]]:
    """Centres [mm] of the discs on a sheet, outside the strip of the ruler."""
    pitch, rim = diameter + GAP_MM, MARGIN_MM + 3 + diameter / 2
    for y in np.arange(MARGIN_MM + 14 + rim, height - rim + 1e-9, pitch):
        for x in np.arange(rim, width - rim + 1e-9, pitch):
            yield float(x), float(y)


def _sheet(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width / 25.4, height / 25.4))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(0, height))
    axes.set_axis_off()
    return figure, axes


def _footer(axes: Axes, width: float, text: str) -> None:
    x, y = (width - RULER_MM) / 2, MARGIN_MM + 5
    axes.plot([x, x + RULER_MM], [y, y], color="black", linewidth=0.5, solid_capstyle="butt")
    for end in (x, x + RULER_MM):
        axes.plot([end, end], [y - 1.5, y + 1.5], color="black", linewidth=0.5)
    axes.text(width / 2, y - 4.5, text, fontsize=7, ha="center", va="center")
