"""Round dots on a plane that is seen by a homography, without a calibrated camera."""

from dataclasses import replace

import numpy as np

from calibration.cameras.camera import Camera
from disctrack.disc import MA_2014
from disctrack.track.dots.template import locate_on_disc


def locate_on_plane(image, image_from_plane, centres, radius, **known):
    """As `locate_on_disc`: image_from_plane (3, 3), plane -> pixel; centres (m, 2) and radius in plane units.

    A camera whose rays are the pixels themselves sees the plane at R e1, R e2, t: the columns of the homography.
    """
    height, width = image.shape
    camera = Camera(1.0, 1.0, 0.0, 0.0, (0.0,) * 5, (width, height))
    places = np.column_stack([np.atleast_2d(centres), np.zeros(len(centres))])
    dots = replace(MA_2014, marker_centres_body=places, marker_diameter=2.0 * radius, radius=1e6 * radius)
    R = np.column_stack([image_from_plane[:, :2], [0.0, 0.0, -1.0]])
    return locate_on_disc(image, camera, R, image_from_plane[:, 2], dots, **known)
