"""The calibration target: which points it carries, and where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.arrays import Array
from calibration.errors import CalibrationError


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
        counts = tuple(int(n) for n in self.inner_corners)
        if len(counts) != 2 or min(counts) < 3:
            raise CalibrationError(f"a chessboard needs at least 3 x 3 inner corners, got {self.inner_corners}")
        if not (np.isfinite(self.square) and self.square > 0):
            raise CalibrationError(f"the side of a square must be positive, got {self.square} m")
        object.__setattr__(self, "inner_corners", counts)

    @property
    def points(self) -> Array:
        """Inner corners (n, 3) [m] in board axes; the third coordinate is zero."""
        columns, rows = self.inner_corners
        j, i = np.mgrid[:rows, :columns]
        return np.stack([i.ravel(), j.ravel(), np.zeros(i.size)], axis=-1) * self.square

    @property
    def symmetry(self) -> int:
        """In how many attitudes (quarter or half turns) the colouring looks the same: 1, 2 or 4."""
        columns, rows = self.inner_corners
        if (columns + rows) % 2:
            return 1
        return 4 if columns == rows and columns % 2 == 0 else 2
