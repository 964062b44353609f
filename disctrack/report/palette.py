"""Colours of figures and pages: those of Okabe and Ito (2008), which colour-blind readers can tell apart."""

INK, MUTED, GRID = "#1d2733", "#6b7885", "#e3e8ed"  # text and axes, what steps back, lines of the grid
BLUE, RED, GREEN, AMBER = "#0072b2", "#d55e00", "#009e73", "#e69f00"  # blue, vermilion, bluish green, orange
COLOURS = {"left": BLUE, "right": RED}  # of the cameras
