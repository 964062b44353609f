"""Cameras, dots and table with faults, and the resulting images of the dots."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calibration.cameras.camera import Camera, StereoRig, by_turning, placed, project_with_jacobians
from calibration.kit.types import Array
from disctrack.disc import Disc
from disctrack.faults.keys import Faults
from disctrack.frames import rotation_from_vector, rotation_z


def centres_with(faults: Faults, disc: Disc) -> Array:
    """(m, 3) true centres of the dots in body axes [m]."""
    centres = disc.marker_centres_body.copy()
    centres[:, :2] += 1e-3 * np.array(faults.misprint_mm or np.zeros((disc.n_markers, 2)))
    turn = rotation_z(np.radians(faults.pattern_turn_deg))[:2, :2]
    centres[:, :2] = faults.pattern_scale * centres[:, :2] @ turn.T
    return np.asarray(centres + 1e-3 * np.array([*faults.pattern_offset_mm, faults.pattern_height_mm]))


def cameras_with(faults: Faults, rig: StereoRig) -> StereoRig:
    """The rig during the recording of the disc, in axes of the true table.

    It differs from the calibrated rig by changes of the cameras since, and by a table that differs from the table view
    of the calibration.
    """
    tilt = rotation_from_vector(np.radians([*faults.table_turn_deg, 0.0]))
    lift = np.array([0.0, 0.0, 1e-3 * faults.table_height_mm])
    cameras = []
    for camera, (R, t), fault in zip(rig.cameras, rig.camera_poses(), (faults.left, faults.right), strict=True):
        turn = rotation_from_vector(np.radians(fault.rotation_deg)).T  # the image rotates opposite to the camera
        shifted = turn @ (t + R @ lift - 1e-3 * np.array(fault.translation_mm))
        parameters = camera.parameters
        parameters[:2] *= fault.focal_scale
        parameters[2:5] += [*fault.principal_point_change_px, fault.k1_change]
        cameras.append((Camera.from_parameters(parameters, camera.image_size), turn @ R @ tilt, shifted))
    return replace(rig, **placed(cameras))


@dataclass(frozen=True)
class Sight:
    """Dots of a moving disc in both cameras: input for the effect of a fault on them."""

    time: Array  # (n,) [s] of the frames, by the declared clock
    R: Array  # (2, n, 3, 3), t (2, n, 3) body -> world, at the instants of each camera
    t: Array
    speed: Array  # (2, n, 6) rates of the POSE_COMPONENTS
    rig: StereoRig
    disc: Disc
    values: Mapping[str, float]
    pixels: Array  # (n, 2, m, 2) of the dots, predicted
    by_pose: Array  # (n, 2, m, 2, 6) their derivatives by the POSE_COMPONENTS


def marker_pixels(R: Array, t: Array, rig: StereoRig, centres_body: Array) -> tuple[Array, Array]:
    """Images of the dots' centres (n, 2, m, 2), and derivatives (n, 2, m, 2, 6) by POSE_COMPONENTS.

    R (n, 3, 3), t (n, 3), or (2, n, ...) per camera: body -> world; centres_body (m, 3). NaN behind a camera.
    """
    pixels, by_pose = [], []
    R, t = np.broadcast_to(R, (2, *R.shape[-3:])), np.broadcast_to(t, (2, *t.shape[-2:]))
    for of, to, camera, (R_cw, t_cw) in zip(R, t, rig.cameras, rig.camera_poses(), strict=True):
        arm = centres_body @ np.swapaxes(of, 1, 2)
        view, d_point, _ = project_with_jacobians((arm + to[:, None]) @ R_cw.T + t_cw, camera)
        d_world = d_point @ R_cw
        pixels.append(view)
        by_pose.append(np.concatenate([d_world, by_turning(d_world, arm)], axis=-1))
    return np.stack(pixels, axis=1), np.stack(by_pose, axis=1)


def predict(R: Array, t: Array, rig: StereoRig, disc: Disc, faults: Faults) -> tuple[Array, Array]:
    """As `marker_pixels`, with faults; those of clocks and images are not included."""
    return marker_pixels(R, t, cameras_with(faults, rig), centres_with(faults, disc))


def ellipse_centre_shift(R: Array, t: Array, rig: StereoRig, disc: Disc) -> Array:
    """Centre of the dots' images minus image of their centres (n, 2, m, 2) [px]; R (n, 3, 3), t (n, 3).

    The image of a circle is an ellipse, apart from lens distortion. Its centre is the centroid of its area, here by a
    quadrature with four points that is exact to third order.
    """
    arms = np.sqrt(0.125) * disc.marker_diameter * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 0]])
    body = (disc.marker_centres_body[:, None] + arms).reshape(-1, 3)
    pixels, by_point, _ = rig.project_with_jacobians(body @ np.swapaxes(R, 1, 2) + t[:, None])
    area = np.linalg.det(by_point @ R[:, None, None, :, :2])
    pixels, area = (found.reshape(len(R), 2, disc.n_markers, 5, -1) for found in (pixels, area))
    around, centre = np.s_[..., :4, :], pixels[..., 4, :]
    shift = np.sum((pixels * area)[around], axis=-2) / np.sum(area[around], axis=-2) - centre
    return np.where(np.isfinite(centre), shift, 0.0)
