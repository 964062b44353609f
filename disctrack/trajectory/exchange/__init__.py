"""Trajectories, rigs and points in the formats of other programs: per format, functions and a row in `formats`."""
