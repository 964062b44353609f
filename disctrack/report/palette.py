"""Colours of figures and pages, of Okabe and Ito (2008), distinguishable for colour-blind readers."""

INK, MUTED, GRID = "#1d2733", "#6b7885", "#e3e8ed"  # text and axes, secondary lines, grid
BLUE, RED, GREEN, AMBER = "#0072b2", "#d55e00", "#009e73", "#e69f00"  # blue, vermilion, bluish green, orange
COLOURS = {"left": BLUE, "right": RED}  # of the cameras
