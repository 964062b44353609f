"""Views of a board before they are calibrated from: what their grey values tell beside the corners."""

import cv2
import numpy as np
import pytest

from calibration.board.chessboard import margin_is_dark
from calibration.board.target import Board


@pytest.mark.parametrize("margin", [0.3, 1.0])
def test_paper_round_the_squares_tells_a_negative_from_a_positive(margin):
    """Nothing else does: the colouring of a negative is that of the board turned by 180 deg."""
    board, side = Board((9, 6), 6e-3), 40
    paper = np.full((8 * side + 100, 11 * side + 100), 60, np.uint8)  # a table, darker than paper
    edge = 50 - int(margin * side)
    paper[edge : 50 + 7 * side + 50 - edge, edge : 50 + 10 * side + 50 - edge] = 200
    for j in range(7):
        for i in range(10):
            if (i + j) % 2 == 0:
                paper[50 + j * side : 50 + (j + 1) * side, 50 + i * side : 50 + (i + 1) * side] = 25
    corners = 49.5 + side * (1 + board.points[:, :2] / board.square)
    lean = np.array([[0.9, 0.15, 5.0], [-0.1, 0.95, 60.0], [1e-4, 2e-4, 1.0]])
    view = cv2.warpPerspective(paper, lean, (700, 500))
    seen = cv2.perspectiveTransform(corners[None], lean)[0]
    assert not margin_is_dark(view, seen, board.points, board)
    assert margin_is_dark(255 - view, seen, board.points, board)
