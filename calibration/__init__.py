"""Calibration of a stereo pair of cameras from views of a chessboard; usable on its own."""
