"""The centre of a dot's image is that of the area inside its outline, by Green's formula over many points."""

import numpy as np
from numpy.testing import assert_allclose

from disctrack.disc import MA_2014
from disctrack.faults.dots import ellipse_centre_shift
from disctrack.frames import rotation_from_euler
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import Scene


def test_centres_of_images_are_shifted_as_their_outlines_are(rng):
    rig, t = rig_of(Scene()), np.array([[0.032, 0.02, 0.02]])
    angles = np.linspace(0.0, 2 * np.pi, 2000, endpoint=False)
    ring = 0.5 * MA_2014.marker_diameter * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
    for psi, theta, phi in rng.uniform([0.0, 0.05, 0.0], [6.0, 0.9, 6.0], (6, 3)):
        R = rotation_from_euler([psi], [theta], [phi])
        shift = ellipse_centre_shift(R, t, rig, MA_2014)[0]
        for dot, centre in enumerate(MA_2014.marker_centres_body):
            middle, around = rig.project(centre @ R.swapaxes(1, 2) + t), rig.project((centre + ring) @ R[0].T + t)
            x, y = np.moveaxis(around - middle, -1, 0)
            cross = x * np.roll(y, -1, axis=-1) - np.roll(x, -1, axis=-1) * y
            expected = [
                np.sum((v + np.roll(v, -1, axis=-1)) * cross, axis=-1) / (3 * cross.sum(axis=-1)) for v in (x, y)
            ]
            # fourth order of the dot's size: 1e-5 of shifts of 0.07 px; the polygon's own error is less
            assert_allclose(shift[:, dot].T, expected, atol=2e-5)
        assert np.abs(shift).max() > 0.01
