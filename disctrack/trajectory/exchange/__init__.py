"""Trajectories, rigs and points in the formats of other programs: a function or two, and a row in `formats`."""
