"""Pinhole cameras with Brown distortion, single and as a stereo pair, with the derivatives for fits.

Pixel (0, 0) is the centre of the top-left pixel; a camera's axes are x right, y down, z along the view. Distortion is
Brown's with OpenCV's coefficients in OpenCV's order.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import scipy

from calibration.cameras._brown import distorted
from calibration.cameras.splines import LensField
from calibration.kit.brief import Brief
from calibration.kit.least_squares import solve_each
from calibration.kit.types import Array, checked

CAMERA_NAMES = ("left", "right")  # in messages and files
INTRINSIC_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
N_INTRINSIC = len(INTRINSIC_PARAMETERS)
_AXES = "xyz"
_PLACES = ("right_left_rotation", "right_left_translation", "left_world_rotation", "left_world_translation")
RIG_PARAMETERS = (
    *(f"{camera}_{name}" for camera in CAMERA_NAMES for name in INTRINSIC_PARAMETERS),
    *(f"{place}_{axis}" for place in _PLACES for axis in _AXES),
)
N_RIG = len(RIG_PARAMETERS)  # 30
# Slices of RIG_PARAMETERS: intrinsics of each camera; pose right <- left; pose left <- world
OF_CAMERAS = slice(0, N_INTRINSIC), slice(N_INTRINSIC, 2 * N_INTRINSIC)
PAIR_TURN, PAIR_SHIFT, WORLD_TURN, WORLD_SHIFT = (
    slice(first, first + len(_AXES)) for first in range(len(CAMERA_NAMES) * N_INTRINSIC, N_RIG, len(_AXES))
)


@checked
@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera: pinhole and Brown distortion."""

    fx: float  # [px]
    fy: float  # [px]
    cx: float  # [px]
    cy: float  # [px]
    distortion: tuple[float, float, float, float, float]  # k1, k2, p1, p2, k3, on normalised coordinates
    image_size: tuple[int, int]  # width, height [px]

    @property
    def camera_matrix(self) -> Array:
        """Camera matrix K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def parameters(self) -> Array:
        """(9,) in the order of INTRINSIC_PARAMETERS."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion])

    @classmethod
    def from_parameters(cls, parameters: Array, image_size: tuple[int, int]) -> "Camera":
        """Inverse of `parameters`."""
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = map(float, parameters)
        return cls(fx, fy, cx, cy, (k1, k2, p1, p2, k3), image_size)


def project(points_camera: Array, camera: Camera) -> Array:
    """Pixels (..., 2) of points (..., 3) in camera axes; NaN behind the camera."""
    a, b, _ = _on_unit_depth(points_camera)
    xd, yd, *_ = distorted(a, b, *camera.distortion)
    return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], axis=-1)


def project_with_jacobians(points_camera: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Pixels (..., 2), d pixel / d point (..., 2, 3) and d pixel / d intrinsics (..., 2, 9); NaN behind the camera."""
    a, b, iz = _on_unit_depth(points_camera)
    xd, yd, xd_a, xd_b, yd_b = distorted(a, b, *camera.distortion)
    fx, fy, x, y, r2 = camera.fx, camera.fy, camera.fx * a, camera.fy * b, a * a + b * b
    d_point = [
        [fx * xd_a, fx * xd_b, -fx * (xd_a * a + xd_b * b)],
        [fy * xd_b, fy * yd_b, -fy * (xd_b * a + yd_b * b)],
    ]
    zero, one = np.zeros_like(a), np.ones_like(a)
    d_intrinsics = [
        [xd, zero, one, zero, x * r2, x * r2**2, fx * 2 * a * b, fx * (r2 + 2 * a * a), x * r2**3],
        [zero, yd, zero, one, y * r2, y * r2**2, fy * (r2 + 2 * b * b), fy * 2 * a * b, y * r2**3],
    ]
    pixels = np.stack([fx * xd + camera.cx, fy * yd + camera.cy], axis=-1)
    by_point, by_intrinsics = (np.moveaxis(np.array(rows), (0, 1), (-2, -1)) for rows in (d_point, d_intrinsics))
    return pixels, by_point * iz[..., None, None], by_intrinsics


def _on_unit_depth(points_camera: Array) -> tuple[Array, Array, Array]:
    """X / Z, Y / Z and 1 / Z of points (..., 3); NaN behind the camera."""
    X, Y, Z = np.moveaxis(np.asarray(points_camera, float), -1, 0)
    inverse = 1.0 / np.where(Z > 0, Z, np.nan)
    return X * inverse, Y * inverse, inverse


NEWTON_PX = 1e-6  # step at which Newton's method has converged
_AT_ONCE = 16384  # points per block, which fits in a core's cache: 2.5 times as fast as a whole image at once


def normalise(pixels: Array, camera: Camera) -> Array:
    """Undistorted normalised coordinates (..., 2) of pixels (..., 2): the inverse of `project` up to depth.

    NaN if Newton's method on the distortion does not converge to 1e-6 px (beyond the radius at which the distortion
    polynomial folds).
    """
    pixels = np.asarray(pixels, float)
    if pixels.size > 2 * _AT_ONCE:
        parts = np.array_split(pixels.reshape(-1, 2), pixels.size // (2 * _AT_ONCE) + 1)
        return np.concatenate([normalise(part, camera) for part in parts]).reshape(pixels.shape)
    a, b = x, y = (pixels[..., 0] - camera.cx) / camera.fx, (pixels[..., 1] - camera.cy) / camera.fy
    with np.errstate(all="ignore"):  # beyond the fold the iteration may diverge, which is tested below
        for _ in range(20):
            xd, yd, xd_a, xd_b, yd_b = distorted(a, b, *camera.distortion)
            rx, ry = x - xd, y - yd
            det = xd_a * yd_b - xd_b * xd_b
            inverse = 1.0 / det
            step_a, step_b = (yd_b * rx - xd_b * ry) * inverse, (xd_a * ry - xd_b * rx) * inverse
            a, b = a + step_a, b + step_b
            px2 = camera.fx * camera.fy * (step_a * step_a + step_b * step_b)
            if np.fmax.reduce(px2, axis=None, initial=0.0) < NEWTON_PX**2:  # ignores NaN; convergence is quadratic
                break
        # both slopes are positive up to the fold; roots beyond it belong to no ray
        good = (px2 < NEWTON_PX**2) & (det > 0) & (xd_a + yd_b > 0)
    return np.where(good[..., None], np.stack([a, b], axis=-1), np.nan)


def normalised_maps(camera: Camera) -> tuple[Array, Array]:
    """Undistorted normalised coordinates x, y of every pixel, each (height, width); NaN for pixels without a ray."""
    width, height = camera.image_size
    maps = normalise(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1), camera)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


@dataclass(frozen=True)
class Allowance:
    """A part of a rig's covariance that images do not determine: the tolerance of a size of the board or the disc."""

    cause: str  # as in "the board's thickness"
    shift: Array  # (30,) change of RIG_PARAMETERS for one standard deviation of the size
    assumed: bool = False  # a default, neither declared nor measured, which other evidence may reduce


@checked
@dataclass(frozen=True, repr=False)
class StereoRig(Brief):
    """Two calibrated cameras and their pose in the world (lab) frame.

    points_left = R_left_world @ points_world + t_left_world;  points_right = R_right_left @ points_left + t_right_left.
    `covariance` is that of RIG_PARAMETERS, rotations as rotation vectors that multiply the estimate from the left
    (R = exp([v]x) R_estimate); rows of parameters that were not estimated are zero. It is common to all frames.
    In a rig without a table view, the world axes are those of the left camera (`world_is_table` False).
    """

    read_by: ClassVar[str] = "calibration.rig_file:read_rig"
    held_as: ClassVar[str] = "rig"

    left: Camera
    right: Camera
    R_right_left: Array  # (3, 3)
    t_right_left: Array  # (3,) [m]
    R_left_world: Array = field(default_factory=lambda: np.eye(3))  # (3, 3)
    t_left_world: Array = field(default_factory=lambda: np.zeros(3))  # (3,) [m]
    covariance: Array = field(default_factory=lambda: np.zeros((N_RIG, N_RIG)))  # (30, 30)
    world_is_table: bool = False
    # Distortion beyond the polynomial (`splines`): measured points are corrected by it first
    lens_field: LensField | None = None
    allowances: tuple[Allowance, ...] = ()  # parts of the covariance, by cause; the remainder is due to the views

    def facts(self) -> dict[str, str]:
        """Main results (`Brief`)."""
        sizes = [" x ".join(str(n) for n in camera.image_size) for camera in self.cameras]
        return {
            "images": f"{sizes[0]} px" if sizes[0] == sizes[1] else f"{sizes[0]} and {sizes[1]} px",
            "focal length": " and ".join(f"{camera.fx:.1f}" for camera in self.cameras) + " px",
            "baseline": f"{1e3 * self.baseline:.3f} mm",
            "world": "the table" if self.world_is_table else "the left camera's axes",
        }

    @property
    def cameras(self) -> tuple[Camera, Camera]:
        """Left, right."""
        return self.left, self.right

    @property
    def baseline(self) -> float:
        """Distance between the two projection centres [m]."""
        return float(np.linalg.norm(self.t_right_left))

    def camera_poses(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """(R_camera_world, t_camera_world) of the left and of the right camera."""
        R_right_world = self.R_right_left @ self.R_left_world
        t_right_world = self.R_right_left @ self.t_left_world + self.t_right_left
        return (self.R_left_world, self.t_left_world), (R_right_world, t_right_world)

    def project(self, points_world: Array) -> Array:
        """Pixels (..., 2 cameras, n, 2) of points (..., n, 3) [m]; NaN behind a camera."""
        views = zip(self.cameras, self.camera_poses(), strict=True)
        return np.stack([project(points_world @ R.T + t, camera) for camera, (R, t) in views], axis=-3)

    def project_with_jacobians(self, points_world: Array) -> tuple[Array, Array, Array]:
        """Pixels (..., 2, n, 2), d/d point_world (..., 2, n, 2, 3) and d/d RIG_PARAMETERS (..., 2, n, 2, 30)."""
        points_world = np.asarray(points_world, float)
        arm_world = points_world @ self.R_left_world.T
        points_left = arm_world + self.t_left_world
        d_rig = np.zeros((*points_world.shape[:-2], len(OF_CAMERAS), points_world.shape[-2], 2, N_RIG))
        pixels, d_world = [], []
        for i, (R, t) in enumerate(((np.eye(3), np.zeros(3)), (self.R_right_left, self.t_right_left))):
            turned = points_left @ R.T
            pixel, d_point, d_rig[..., i, :, :, OF_CAMERAS[i]] = project_with_jacobians(turned + t, self.cameras[i])
            if i:  # the pair has the axes of the first camera
                d_rig[..., i, :, :, PAIR_TURN] = by_turning(d_point, turned)
                d_rig[..., i, :, :, PAIR_SHIFT] = d_point
                d_point = d_point @ R
            d_rig[..., i, :, :, WORLD_TURN] = by_turning(d_point, arm_world)
            d_rig[..., i, :, :, WORLD_SHIFT] = d_point
            pixels.append(pixel)
            d_world.append(d_point @ self.R_left_world)
        return np.stack(pixels, axis=-3), np.stack(d_world, axis=-4), d_rig

    def perturbed(self, delta: Array) -> "StereoRig":
        """The rig after a small change delta (30,) of RIG_PARAMETERS (SI units, rotation vectors in radians)."""
        delta = np.asarray(delta, float)
        owned = zip(self.cameras, OF_CAMERAS, strict=True)
        left, right = (Camera.from_parameters(c.parameters + delta[own], c.image_size) for c, own in owned)
        return replace(
            self,
            left=left,
            right=right,
            R_right_left=rotation_from_vector(delta[PAIR_TURN]) @ self.R_right_left,
            t_right_left=self.t_right_left + delta[PAIR_SHIFT],
            R_left_world=rotation_from_vector(delta[WORLD_TURN]) @ self.R_left_world,
            t_left_world=self.t_left_world + delta[WORLD_SHIFT],
        )


def by_turning(d_point: Array, arm: Array) -> Array:
    """D pixel / d rotation vector (..., 2, 3) for a rotation of the arm (..., 3), from d pixel / d point (..., 2, 3).

    d_point @ (v x arm) = (arm x d_point) . v
    """
    x, y, z = (arm[..., None, i] for i in range(3))  # numpy.cross takes three times as long
    a, b, c = (d_point[..., i] for i in range(3))
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)


def placed(cameras: Sequence[tuple[Camera, Array, Array]]) -> dict[str, Any]:
    """Fields of a StereoRig from its cameras, left first, each with R (3, 3), t (3,) from world to camera axes."""
    (left, R_left, t_left), (right, R_right, t_right) = cameras
    R = R_right @ R_left.T
    fields = {"left": left, "right": right, "R_right_left": R, "t_right_left": t_right - R @ t_left}
    return fields | {"R_left_world": R_left, "t_left_world": t_left}


def rotation_from_vector(v: Array) -> Array:
    """Rodrigues' formula: rotation vectors (..., 3) [rad] -> (..., 3, 3)."""
    v = np.asarray(v, float)
    square = np.sum(v * v, axis=-1)
    small = square < 1e-12  # for which the series is exact to rounding
    angle = np.sqrt(np.where(small, 1.0, square))
    first = np.where(small, 1.0, np.sin(angle) / angle)[..., None, None]
    second = np.where(small, 0.5, (1 - np.cos(angle)) / angle**2)[..., None, None]
    S = np.zeros((*v.shape, 3))
    S[..., 2, 1], S[..., 0, 2], S[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    S = S - np.swapaxes(S, -1, -2)
    return np.asarray(np.eye(3) + first * S + second * S @ S, np.float64)


def vector_from_rotation(R: Array) -> Array:
    """Rotation vector (..., 3) [rad] of R (..., 3, 3), length in [0, pi]; inverse of `rotation_from_vector`."""
    return converted_rotation(R, "as_rotvec")


def converted_rotation(R: Array, to: str) -> Array:
    """R (..., 3, 3) by a method of SciPy's Rotation; NaN in, NaN out."""
    R = np.asarray(R, float)
    known = np.isfinite(R).all(axis=(-2, -1))
    values = getattr(scipy.spatial.transform.Rotation.from_matrix(R[known]), to)()
    found = np.full((*R.shape[:-2], values.shape[-1]), np.nan)
    found[known] = values
    return found


@checked
def triangulate(pixels: Array, rig: StereoRig) -> Array:
    """World points (n, 3) [m] of pixels (2 cameras, n, 2), least squares in pixels; NaN unless seen by both cameras.

    pixels : as measured; a lens field of the rig is subtracted first
    """
    if rig.lens_field is not None:
        pixels = rig.lens_field.corrected(pixels)
    rays = np.stack([normalise(view, camera) for view, camera in zip(pixels, rig.cameras, strict=True)])
    R, t = (np.stack(of_both)[:, None] for of_both in zip(*rig.camera_poses(), strict=True))
    A = np.moveaxis(R[..., :2, :] - rays[..., None] * R[..., 2:, :], 0, 1).reshape(-1, 4, 3)
    b = np.moveaxis(rays * t[..., 2:] - t[..., :2], 0, 1).reshape(-1, 4, 1)
    good = np.asarray(np.isfinite(b).all(axis=(-2, -1)), bool)
    points = np.full((len(good), 3), np.nan)
    points[good] = solve_each(A[good], b[good])[..., 0]
    for _ in range(10):  # Gauss-Newton: the error of the linear solution is the noise times the perspective
        found, d_world, _ = rig.project_with_jacobians(points[good])
        J = np.moveaxis(d_world, 0, 1).reshape(-1, 4, 3)
        step = solve_each(J, np.moveaxis(pixels[:, good] - found, 0, 1).reshape(-1, 4, 1))[..., 0]
        points[good] += step
        if not np.any(np.abs(step) > 1e-12):
            break
    return points


def causes(rig: StereoRig, shift: Array, further: Mapping[str, Array] | None = None) -> tuple[Array, list[str]]:
    """Standard deviation (k,) of quantities due to the rig, and the largest cause of each: views, or sizes of a board.

    shift : (n, k, 30) their derivative by RIG_PARAMETERS at n places, over which variances are averaged
    further : variances (k,) due to other causes
    """
    parts: dict[str, Array] = {}
    for a in rig.allowances:
        parts[a.cause] = parts.get(a.cause, 0.0) + np.mean((shift @ a.shift) ** 2, axis=0)
    whole = np.einsum("nkp,nkp->k", shift @ rig.covariance, shift) / len(shift)
    parts = {"the views": np.maximum(whole - sum(parts.values()), 0.0), **parts}
    for cause, own in (further or {}).items():
        parts[cause] = parts.get(cause, 0.0) + own
    table = np.array(list(parts.values()))
    return np.sqrt(table.sum(axis=0)), [list(parts)[i] for i in table.argmax(axis=0)]
