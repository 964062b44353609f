"""`disctrack print`: the declared dots and board, true to scale."""

import argparse

from disctrack.commands import _outputs as outputs
from disctrack.disc import MA_2014
from disctrack.files.whole import refuse_existing
from disctrack.first_look.targets import board_figure, dots_figure
from disctrack.recording.declaration import read_recording
from disctrack.report.figures import save_figure


def run(arguments: argparse.Namespace) -> None:
    """Draw both sheets, and print what to declare."""
    disc, corners, square_mm = MA_2014, (9, 6), 10.0
    if arguments.recording is not None:
        recording = read_recording(arguments.recording)
        disc = recording.disc
        if recording.chessboard is not None:
            corners, square_mm = recording.chessboard.inner_corners, 1e3 * recording.chessboard.square
    dots, board = arguments.output / "dots.pdf", arguments.output / "board.pdf"
    for path in (dots, board):
        refuse_existing(path, arguments.overwrite)
    sheets = {
        dots: dots_figure(disc, arguments.paper, dark=not arguments.light_dots),
        board: board_figure(corners, square_mm, arguments.paper),
    }
    for path, figure in sheets.items():
        print(f"{'sheet':<13} {outputs.relative(save_figure(figure, path))}")
    print(f"{'':<13} print at 100 %, and measure the bar of 100 mm on each sheet")
    centres = ", ".join(f"[{1e3 * x:.4f}, {1e3 * y:.4f}]" for x, y, _ in disc.marker_centres_body)
    print(f"{'declare':<13} [markers] diameter_mm = {1e3 * disc.marker_diameter:g}")
    print(f"{'':<13} centres_mm = [{centres}]")
    print(f"{'':<13} [calibration] inner_corners = [{corners[0]}, {corners[1]}], square_mm = {square_mm:g}")
