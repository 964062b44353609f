"""Faults of a measurement: their catalogue, as `disctrack.rolling.effects` is that of the motion.

`catalogue`: one entry per fault. `dots`: effect of faults on the images of the dots. `keys`: their keys in a scene.
"""
