"""Trajectories and rigs in the formats of other programs."""
