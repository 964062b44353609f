"""Poses that a validation asks for: every attitude, everywhere in the field, and who can see the upper face there."""

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array
from disctrack.disc import Disc
from disctrack.errors import SceneError
from disctrack.frames import rotation_from_euler

# Nutation [deg]: the error of psi and phi goes as 1/sin(theta), so the strata are about even in log(theta).
STRATA_DEG = ((0.5, 1.0), (1.0, 2.0), (2.0, 5.0), (5.0, 10.0), (10.0, 20.0), (20.0, 40.0), (40.0, 60.0), (60.0, 85.0))
FIELD_RADIUS = 25e-3  # [m] of the disc's centre about the middle of the field, where the dots stay in both images
BORDER_PX = 14  # a dot's window needs some pixels around it
SMALLEST_SEMI_MINOR_PX = 3.2  # a dot seen flatter than this is all edge: its blurred middle shows no black
FEWEST_DOTS = 3  # two numbers each, six unknowns


def static_poses(n: int, rig: StereoRig, disc: Disc, middle: tuple[float, float], rng: np.random.Generator) -> Array:
    """(n, 6) poses q on the table, by increasing nutation: strata in turn, all psi and phi, anywhere in the field.

    middle : (x, y) [m] of the field. Places where a dot would leave an image are drawn again; at large nutation the
    disc looks away from the cameras for half of all psi, and such poses stay in.
    Raises SceneError where the field has no room for the disc.
    """
    return np.array(sorted((_pose(i, rig, disc, middle, rng) for i in range(n)), key=lambda q: q[4])).reshape(n, 6)


def _pose(i: int, rig: StereoRig, disc: Disc, middle: tuple[float, float], rng: np.random.Generator) -> Array:
    low, high = np.radians(STRATA_DEG[i % len(STRATA_DEG)])
    for attempt in range(400):
        psi, phi, direction = rng.uniform(-np.pi, np.pi, 3)
        theta = np.exp(rng.uniform(np.log(low), np.log(high)))
        # the field shrinks slowly, for small images and long strides of the rim
        reach = FIELD_RADIUS * np.sqrt(rng.uniform()) * (1 - attempt / 500)
        x, y = middle[0] + reach * np.cos(direction), middle[1] + reach * np.sin(direction)
        q = np.array([x, y, disc.resting_height(theta), psi, theta, phi])
        if _inside(q, rig, disc):
            return q
    raise SceneError(
        "validation: no place found where all dots lie in both images; widen the field (rig.mm_per_px, image_size)"
    )


def _inside(q: Array, rig: StereoRig, disc: Disc) -> bool:
    R = rotation_from_euler(*q[3:])
    pixels = rig.project(disc.marker_centres_body @ R.T + q[:3])
    size = np.array([camera.image_size for camera in rig.cameras])[:, None]
    return bool(np.all((pixels > BORDER_PX) & (pixels < size - 1 - BORDER_PX)))


def dots_in_sight(q: Array, rig: StereoRig, disc: Disc) -> NDArray[np.int64]:
    """(n, 2 cameras) number of dots that geometry lets a camera resolve in the poses q (n, 6).

    The upper face must be turned to the camera, and the dot's image, an ellipse of semi-minor axis
    f R cos(gamma) / distance, must not be flatter than SMALLEST_SEMI_MINOR_PX.
    """
    R = rotation_from_euler(q[:, 3], q[:, 4], q[:, 5])
    dots = disc.marker_centres_body @ np.swapaxes(R, 1, 2) + q[:, None, :3]
    counts = []
    for camera, (R_cw, t_cw) in zip(rig.cameras, rig.camera_poses(), strict=True):
        ray = -R_cw.T @ t_cw - dots
        distance = np.linalg.norm(ray, axis=-1)
        cosine = np.einsum("nmi,ni->nm", ray, R[:, :, 2]) / distance
        counts.append(np.sum(camera.fx * disc.marker_diameter / 2 * cosine / distance > SMALLEST_SEMI_MINOR_PX, axis=1))
    return np.stack(counts, axis=1)


def cameras_in_sight(q: Array, rig: StereoRig, disc: Disc) -> NDArray[np.int64]:
    """(n,) cameras that see enough dots for a pose of their own: 2, 1 or 0."""
    return np.sum(dots_in_sight(q, rig, disc) >= FEWEST_DOTS, axis=1)
