"""The calibration target, a plain chessboard or one with markers, and the positions of its points.

Board axes of every target: i to the right and j upwards as the pattern stands upright, k out of the print.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from calibration.kit.errors import CalibrationError
from calibration.kit.types import Array, Indices, checked

LEAST_POINTS = 8  # of a view: fewer do not determine its pose


@checked
@dataclass(frozen=True)
class Board:
    """A chessboard. Board axes: origin at corner 0, i along the first count, j along the second, k out of the print.

    Seen from the printed side, corner 0 is the lower left inner corner and the square outside it is dark; with an odd
    first and an even second count (9 x 6) the whole short side there has dark corner squares. Corners run along i
    first, then along j.
    """

    inner_corners: tuple[int, int]  # along i (the long side), along j (the short side)
    square: float  # side of a square [m]

    def __post_init__(self) -> None:
        _require(self.inner_corners, 3, "inner corners of a chessboard")
        if not (np.isfinite(self.square) and self.square > 0):
            raise CalibrationError(f"the side of a square must be positive, got {self.square} m")

    @property
    def points(self) -> Array:
        """Inner corners (n, 3) [m] in board axes; the third coordinate is zero."""
        return grid_of(self.inner_corners) * self.square

    @property
    def orders(self) -> list[Indices]:
        """Symmetries (rotations in its plane) as orders of its points; the first is the identity."""
        columns, rows = self.inner_corners
        orders = board_orders(self.inner_corners)
        if (columns + rows) % 2:
            return orders[:1]
        return orders if len(orders) == 2 or columns % 2 == 0 else orders[::2]

    def __str__(self) -> str:
        return f"a board of {self.inner_corners[0]} x {self.inner_corners[1]} inner corners"


def board_orders(inner_corners: tuple[int, int]) -> list[Indices]:
    """Symmetries of a chessboard (rotations in its plane) as orders of its corners: 2, or 4 for a square board."""
    columns, rows = inner_corners
    index = np.arange(columns * rows).reshape(rows, columns)
    turns = (0, 1, 2, 3) if columns == rows else (0, 2)
    return [np.rot90(index, k).ravel() for k in turns]


@checked
@dataclass(frozen=True)
class CharucoBoard:
    """A chessboard with an ArUco marker in every light square; points are its inner corners in OpenCV's order.

    Upright as OpenCV draws it, the origin is the lower left inner corner.
    """

    squares: tuple[int, int]  # columns, rows of squares, dark and light
    square: float  # side of a square [m]
    marker: float  # side of a marker [m]
    dictionary: str = "DICT_4X4_50"  # OpenCV's name

    def __post_init__(self) -> None:
        _require(self.squares, 4, "squares of a ChArUco board")
        if not 0 < self.marker < self.square < np.inf:
            raise CalibrationError(
                f"a marker of {self.marker} m does not fit into a square of {self.square} m: both are sides, in metres"
            )

    @property
    def inner_corners(self) -> tuple[int, int]:
        """Columns, rows of inner corners."""
        return self.squares[0] - 1, self.squares[1] - 1

    @property
    def points(self) -> Array:
        """Inner corners (n, 3) [m], from the upper left, row by row."""
        return (grid_of(self.inner_corners) * [1, -1, 1] + [0, self.inner_corners[1] - 1, 0]) * self.square

    @property
    def orders(self) -> list[Indices]:
        """The identity alone: its markers determine the orientation."""
        return [np.arange(len(self.points))]

    def __str__(self) -> str:
        return f"a ChArUco board of {self.squares[0]} x {self.squares[1]} squares ({self.dictionary})"


def grid_of(counts: tuple[int, int]) -> Array:
    """(n, 3) positions, along i first, then along j."""
    j, i = np.mgrid[: counts[1], : counts[0]]
    return np.stack([i.ravel(), j.ravel(), np.zeros(i.size)], axis=-1)


def _require(counts: tuple[int, int], least: int, what: str) -> None:
    if min(counts) < least:
        raise CalibrationError(f"{what}: at least {least} x {least} are needed, got {counts}")


Target = Board | CharucoBoard
_KINDS: dict[str, type[Target]] = {"chessboard": Board, "charuco": CharucoBoard}  # by their names in recording.toml


def described(target: Target) -> dict[str, Any]:
    """Kind and fields, the argument of `target_of`."""
    return {"target": next(name for name, kind in _KINDS.items() if isinstance(target, kind)), **asdict(target)}


def target_of(description: dict[str, Any]) -> Target:
    """Inverse of `described`."""
    fields = dict(description)
    return _KINDS[fields.pop("target")](**fields)
