"""Clocks, cameras, dots and table as faults leave them, and the images of the dots that follow from that."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.cameras.camera import Camera, StereoRig, placed_at, project_with_jacobians
from calibration.kit.arrays import Array
from disctrack.disc import Disc
from disctrack.frames import rotation_from_vector

RIM_POINTS = 24  # of a dot's outline, for the centre of its image


@dataclass
class CameraChange:
    """What became of one camera after its calibration."""

    rotation: Array = field(default_factory=lambda: np.zeros(3))  # [rad] vector in its own axes
    translation: Array = field(default_factory=lambda: np.zeros(3))  # [m] in its own axes
    focal: float = 0.0  # relative
    centre: Array = field(default_factory=lambda: np.zeros(2))  # [px] of the principal point
    k1: float = 0.0

    def lens(self, camera: Camera) -> Camera:
        """The camera with its lens as it is now."""
        k1, k2, p1, p2, k3 = camera.distortion
        return replace(
            camera,
            fx=camera.fx * (1.0 + self.focal),
            fy=camera.fy * (1.0 + self.focal),
            cx=camera.cx + float(self.centre[0]),
            cy=camera.cy + float(self.centre[1]),
            distortion=(k1 + self.k1, k2, p1, p2, k3),
        )


@dataclass
class MeasurementSetup:
    """How clocks, cameras, dots and table differ from what was declared and calibrated. Faults alter it."""

    misprint: Array  # (m, 2) [m] of single dots, body axes
    faster: float = 0.0  # true over declared frame rate, minus one
    delay: float = 0.0  # [s] of the right camera
    cameras: tuple[CameraChange, CameraChange] = field(default_factory=lambda: (CameraChange(), CameraChange()))
    pattern_offset: Array = field(default_factory=lambda: np.zeros(3))  # [m] body axes
    pattern_turn: float = 0.0  # [rad] about e3
    pattern_growth: float = 0.0  # relative
    table_turn: Array = field(default_factory=lambda: np.zeros(3))  # [rad] of the true table in calibrated axes
    table_height: float = 0.0  # [m]

    @property
    def rate(self) -> float:
        """True over declared frame rate."""
        return 1.0 + self.faster

    def centres(self, disc: Disc) -> Array:
        """(m, 3) where the dots are on the body [m]."""
        centres = disc.marker_centres_body.copy()
        centres[:, :2] += self.misprint
        c, s = np.cos(self.pattern_turn), np.sin(self.pattern_turn)
        centres[:, :2] = (1.0 + self.pattern_growth) * centres[:, :2] @ np.array([[c, s], [-s, c]])
        return np.asarray(centres + self.pattern_offset)

    def cameras_of(self, rig: StereoRig) -> StereoRig:
        """The rig with what became of its cameras after the calibration."""
        poses = []
        for (R, t), change in zip(rig.camera_poses(), self.cameras, strict=True):
            turn = rotation_from_vector(change.rotation).T
            poses.append((turn @ R, turn @ (t - change.translation)))
        left, right = (change.lens(camera) for camera, change in zip(rig.cameras, self.cameras, strict=True))
        return replace(rig, left=left, right=right, **placed_at(poses))


@dataclass(frozen=True)
class DotImages:
    """Predicted images of the dots and how they move with the pose."""

    pixels: Array  # (n, 2, m, 2)
    by_pose: Array  # (n, 2, m, 2, 6), POSE_COMPONENTS of the disc in the world


@dataclass(frozen=True)
class Sight:
    """Dots of a moving disc as both cameras meet them: what a fault needs to tell what it does to them."""

    time: Array  # (n,) [s] of the frames, by the declared clock
    R: Array  # (2, n, 3, 3), t (2, n, 3) body -> world, at the instants of each camera
    t: Array
    speed: Array  # (2, n, 6) rates of the POSE_COMPONENTS
    rig: StereoRig
    disc: Disc
    values: Mapping[str, float]
    images: DotImages


def predict(R: Array, t: Array, rig: StereoRig, disc: Disc, setup: MeasurementSetup) -> DotImages:
    """Images of the dots' centres for poses per camera R (2, n, 3, 3), t (2, n, 3), body -> world.

    What is wrong with clocks or images has no part in this.
    """
    centres = setup.centres(disc)
    tilt = rotation_from_vector(setup.table_turn)
    height = np.array([0.0, 0.0, setup.table_height])
    pixels, by_pose = [], []
    for i, (camera, (R_cw, t_cw), change) in enumerate(
        zip(rig.cameras, rig.camera_poses(), setup.cameras, strict=True)
    ):
        arm = centres @ np.swapaxes(R[i], 1, 2)
        world = (arm + t[i][:, None]) @ tilt.T + height
        turn = rotation_from_vector(change.rotation).T
        in_camera = (world @ R_cw.T + t_cw - change.translation) @ turn.T
        view, d_point, _ = project_with_jacobians(in_camera, change.lens(camera))
        d_world = d_point @ (turn @ R_cw @ tilt)
        pixels.append(view)
        by_pose.append(np.concatenate([d_world, np.cross(arm[..., None, :], d_world)], axis=-1))
    return DotImages(np.stack(pixels, axis=1), np.stack(by_pose, axis=1))


def ellipse_centre_shift(R: Array, t: Array, rig: StereoRig, disc: Disc) -> Array:
    """Centre of the dots' images minus image of their centres (n, 2, m, 2) [px]; R (n, 3, 3), t (n, 3).

    The image of a circle is an ellipse, to the lens' distortion; its centre is that of the area inside.
    """
    angles = 2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    ring = 0.5 * disc.marker_diameter * np.stack([np.cos(angles), np.sin(angles), np.zeros(RIM_POINTS)], axis=-1)
    body = np.concatenate([disc.marker_centres_body[:, None], disc.marker_centres_body[:, None] + ring], axis=1)
    world = body.reshape(-1, 3) @ np.swapaxes(R, 1, 2) + t[:, None]
    images = np.moveaxis(rig.project(world), -3, 1)  # (n, 2, m * (1 + rim), 2)
    images = images.reshape(*images.shape[:2], disc.n_markers, 1 + RIM_POINTS, 2)
    centre, outline = images[..., 0, :], images[..., 1:, :] - images[..., :1, :]
    following = np.roll(outline, -1, axis=-2)
    cross = outline[..., 0] * following[..., 1] - outline[..., 1] * following[..., 0]
    shift = np.sum((outline + following) * cross[..., None], axis=-2) / (3 * np.sum(cross, axis=-1))[..., None]
    return np.where(np.isfinite(centre), shift, 0.0)
