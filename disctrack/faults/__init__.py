"""What can be wrong with a measurement: one catalogue, as `disctrack.rolling.effects` is one of the motion.

`catalogue`: an entry a fault. `dots`: what faults do to the images of a disc's dots. `keys`: where a scene holds them.
"""
