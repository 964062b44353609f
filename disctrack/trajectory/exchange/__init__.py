"""Trajectories, rigs and points in the formats of other programs: a format is a small module and a row in `formats`."""
