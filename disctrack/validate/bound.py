"""The Cramer-Rao bound of a pose, from the images themselves: no unbiased method can scatter less.

I_p(q) is the expected grey value of pixel p, s_p^2 its variance by the sensor's law. The Fisher information on the six
pose components is F = sum_p (dI_p/dq) (dI_p/dq)^T / s_p^2 over both images; the bound is F^-1 (Kay 1993, section
3.9, for Gaussian noise whose variance hardly depends on q). Light, blur and the disc's own measures count as known
here, so that a method that also fits those must scatter a little more.
"""

from dataclasses import dataclass

import numpy as np

from calibration.cameras.camera import Camera, StereoRig, normalised_maps
from calibration.kit.arrays import Array, Array32, Mask
from disctrack.disc import Disc
from disctrack.frames import euler_from_rotation, rotation_from_euler, rotation_from_vector
from disctrack.synthetic import expected_disc
from disctrack.synthetic.description import Scene, SensorSettings
from disctrack.track.dots import face_edge

Maps = tuple[tuple[Array, Array], tuple[Array, Array]]

# Steps of the central differences: 0.08 px in the image. Their error is (step/blur)^2 / 6 = 0.2 %, that of 32-bit grey
# values 1e-5 of a derivative.
STEP = np.r_[np.full(3, 20e-6), np.full(3, 0.7e-3)]  # [m, rad]
DOT_BAND_PX = 4.0  # pixels farther outside a dot's edge hold less than 1e-5 of its light


@dataclass(frozen=True)
class PoseBound:
    """Fisher information on POSE_COMPONENTS (SI, radians) of one pair of images."""

    dots: Array  # (6, 6) from the pixels of the upper face's dots: what a method that uses the dots can know
    image: Array  # (6, 6) from all pixels: rim, side and the table behind included
    expected: Array32  # (2, height, width) the noise-free images

    @property
    def covariance(self) -> Array:
        """(6, 6) lower bound for methods that use the dots; infinite where they do not determine the pose."""
        return inverse_information(self.dots)


def inverse_information(information: Array) -> Array:
    """Inverse of a Fisher matrix (6, 6); infinite where it is singular."""
    scale = np.sqrt(np.diag(information))
    if not np.all(scale > 0):
        return np.full((6, 6), np.inf)
    inverse = np.linalg.inv(information / np.outer(scale, scale))
    return np.asarray(inverse / np.outer(scale, scale))


def camera_maps(rig: StereoRig) -> Maps:
    """Rays of all pixels of both cameras; the same for all poses."""
    return normalised_maps(rig.left), normalised_maps(rig.right)


def neighbours(q: Array) -> Array:
    """(13, 6): q (6,) and its neighbours one STEP forth and back along each of POSE_COMPONENTS."""
    R = rotation_from_euler(*q[3:])
    rows = [q]
    for k in range(6):
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            step[k] = sign * STEP[k]
            rows.append(np.concatenate([q[:3] + step[:3], euler_from_rotation(rotation_from_vector(step[3:]) @ R)]))
    return np.array(rows)


def pixel_variance(grey: Array, sensor: SensorSettings, bit_depth: int) -> Array:
    """Variance [8-bit grey values^2] of a pixel of mean `grey`: shot and read noise, rounding to the bit depth."""
    shot = np.maximum(grey, 0) / sensor.gain_e_per_dn if sensor.gain_e_per_dn > 0 else 0.0
    rounding = (255.0 / (2**bit_depth - 1)) ** 2 / 12
    return np.asarray(shot + sensor.read_noise_dn**2 + rounding)


def pose_bound(q: Array, rig: StereoRig, disc: Disc, scene: Scene, maps: Maps) -> PoseBound:
    """Bound for the disc at rest at q (6,) before the true cameras `rig`."""
    images = expected_disc(neighbours(q), rig, disc, scene)
    derivative = (images[1::2].astype(float) - images[2::2]) / (2 * STEP[:, None, None, None])
    weight = 1 / pixel_variance(images[0].astype(float), scene.sensor, scene.cameras.bit_depth)
    R = rotation_from_euler(*q[3:])
    mask = np.stack(
        [
            dot_pixels(R_cw @ R, R_cw @ q[:3] + t_cw, camera, disc, rays)
            for camera, (R_cw, t_cw), rays in zip(rig.cameras, rig.camera_poses(), maps, strict=True)
        ]
    )
    return PoseBound(
        dots=_information(derivative, weight * mask), image=_information(derivative, weight), expected=images[0]
    )


def _information(derivative: Array, weight: Array) -> Array:
    rows = derivative.reshape(6, -1)
    return np.asarray((rows * weight.ravel()) @ rows.T)


def dot_pixels(R: Array, t: Array, camera: Camera, disc: Disc, rays: tuple[Array, Array]) -> Mask:
    """(height, width) True within DOT_BAND_PX of a dot of the upper face, if the camera sees that face."""
    h = disc.half_thickness
    if (-R.T @ t)[2] <= h:
        return np.zeros(rays[0].shape, bool)
    to_plane = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], R[:, 2] * h + t]))
    plane = np.einsum("ij,jvu->ivu", to_plane, np.stack([rays[0], rays[1], np.ones_like(rays[0])]))
    with np.errstate(invalid="ignore", divide="ignore"):
        points = np.moveaxis(plane[:2] / plane[2], 0, -1)
        ahead = (plane[2] > 0) & (np.hypot(points[..., 0], points[..., 1]) < face_edge(disc))
        inside = np.zeros(ahead.shape, bool)
        for centre in disc.marker_centres_body[:, :2]:
            rho = np.linalg.norm(points - centre, axis=-1)
            slope = np.hypot(*np.gradient(rho))  # plane units per pixel
            inside |= rho - disc.marker_diameter / 2 < DOT_BAND_PX * slope
    return np.asarray(inside & ahead)
