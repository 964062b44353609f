"""Model of the images of a flat target in two cameras: parameters, observations, derivatives."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import (
    INTRINSIC_PARAMETERS,
    N_INTRINSIC,
    N_RIG,
    PAIR_SHIFT,
    StereoRig,
    by_turning,
    rotation_from_vector,
)
from calibration.kit.arguments import checked
from calibration.kit.arrays import Array, Mask
from calibration.kit.errors import ArgumentError, CalibrationError

RICHEST = "k1 k2 p1 p2 k3"
DISTORTION_MODELS = ("none", "k1", "k1 k2", "k1 k2 p1 p2", "k1 k2 k3", RICHEST)  # by the terms that are free
BOARD_MODELS = ("flat", "warped", "free")
N_STEREO = PAIR_SHIFT.stop  # left and right intrinsics, rotation and translation of the pair come first


@checked
@dataclass(frozen=True)
class Observations:
    """Image points of target points of all views and cameras, in flat arrays."""

    view: NDArray[np.intp]  # (m,) 0..n_views-1
    camera: NDArray[np.intp]  # (m,) 0 left, 1 right
    point: NDArray[np.intp]  # (m,) index into the target's points
    pixels: Array  # (m, 2) [px]
    covariance: Array  # (m, 2, 2) [px^2]

    def __post_init__(self) -> None:
        shapes = tuple(np.shape(getattr(self, f.name)) for f in fields(self))
        m = self.view.size
        if shapes != ((m,), (m,), (m,), (m, 2), (m, 2, 2)):
            raise ArgumentError(f"Observations: shapes {shapes}; expected (m,), (m,), (m,), (m, 2), (m, 2, 2)")
        if not (np.isfinite(self.pixels).all() and np.isfinite(self.covariance).all()):
            raise ArgumentError("Observations: pixels and covariance must be finite: leave out what was not seen")

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, keep: NDArray) -> Observations:
        return Observations(*(getattr(self, f.name)[keep] for f in fields(self)))


@dataclass(frozen=True)
class StereoModel:
    """All parameters that predict the images of the target's points."""

    rig: StereoRig  # the cameras; world axes are those of the left one
    R_left_board: Array  # (n_views, 2, 3, 3) of the board at each camera's exposure, in the left camera's axes
    t_left_board: Array  # (n_views, 2, 3) [m]
    points: Array  # (n, 3) target points in board axes [m], as refined

    @property
    def apart(self) -> Mask:
        """(n_views,) views whose two images have different poses of the board."""
        return np.asarray(np.ptp(self.t_left_board, axis=1).any(axis=1), bool)


@dataclass(frozen=True)
class Terms:
    """Free parameters of the refinement."""

    distortion: str = RICHEST  # one of DISTORTION_MODELS, the same for both cameras
    board: str = "flat"  # one of BOARD_MODELS

    def __post_init__(self) -> None:
        if self.distortion not in DISTORTION_MODELS:
            raise CalibrationError(
                f"distortion {self.distortion!r} is unknown; choose of {', '.join(DISTORTION_MODELS)}"
            )
        if self.board not in BOARD_MODELS:
            raise CalibrationError(f"board model {self.board!r} is unknown; choose of {', '.join(BOARD_MODELS)}")

    @property
    def free(self) -> Mask:
        """(24,) which of intrinsics and stereo pose are free."""
        free = {*INTRINSIC_PARAMETERS[:4], *self.distortion.split()}
        own = np.array([name in free for name in INTRINSIC_PARAMETERS])
        return np.concatenate([own, own, np.ones(6, bool)])

    def stereo_basis(self) -> Array:
        """(24, n_free) columns span the free directions of intrinsics and stereo pose."""
        return np.eye(N_STEREO)[:, self.free]


def board_basis(nominal: Array, board: str) -> Array:
    """(n, 3, n_shape): displacement of the target's points [m] per unit of each shape parameter [m].

    flat: none. warped: out of the plane as x^2, x y, y^2 over the half size; in the plane stretch of one side against
    the other, and shear, as of a print stretched by the paper feed. free: every coordinate of every point.
    Shift, rotation and scale of the whole target are excluded: they are equivalent to another pose and baseline. So the
    mean plane is the declared one, and errors of the two sides are equal and opposite, the most likely size if both
    were made equally well.
    """
    n = len(nominal)
    if board == "flat":
        return np.zeros((n, 3, 0))
    d = nominal - nominal.mean(0)
    size = np.abs(d).max()
    rows = [np.broadcast_to(axis * size, d.shape) for axis in np.eye(3)]
    spread = np.sum(d**2, axis=0)[:2]
    rows += [np.cross(axis, d) for axis in np.eye(3)] + [d * [*spread[::-1] / spread.sum(), 0.0]]
    gauge = np.stack([row.reshape(-1) for row in rows], axis=-1)
    q, _ = np.linalg.qr(gauge, mode="complete")
    if board == "free":
        return q[:, 7:].reshape(n, 3, 3 * n - 7)
    x, y = (d / np.abs(d).max(0).clip(1e-12))[:, :2].T
    warp = np.zeros((n, 3, 5))
    warp[:, 2, :3] = np.stack([x * x, x * y, y * y], axis=-1)
    warp[:, :2, 3] = d[:, :2] * [0.5, -0.5] / size
    warp[:, :2, 4] = d[:, 1::-1] * 0.5 / size
    flat = warp.reshape(3 * n, -1)
    return (flat - q[:, :7] @ (q[:, :7].T @ flat)).reshape(warp.shape)


def predict_pixels(model: StereoModel, observations: Observations) -> Array:
    """Pixels (m, 2) without derivatives."""
    return predict(model, observations)[0]


def predict(model: StereoModel, observations: Observations) -> tuple[Array, Array, Array, Array]:
    """Pixels (m, 2) and derivatives: d/d stereo (m, 2, 24), d/d view pose (m, 2, 6), d/d target point (m, 2, 3)."""
    R, t = (of[observations.view, observations.camera] for of in (model.R_left_board, model.t_left_board))
    arm = np.einsum("mij,mj->mi", R, model.points[observations.point])
    seen = observations.camera, np.arange(len(observations))
    pixels, d_left, d_rig = (of_both[seen] for of_both in model.rig.project_with_jacobians(arm + t))
    d_pose = np.concatenate([by_turning(d_left, arm), d_left], axis=-1)
    return pixels, d_rig[..., :N_STEREO], d_pose, d_left @ R


def moved(model: StereoModel, stereo: Array, poses: Array, displacement: Array) -> StereoModel:
    """The model after a step: stereo (24,), displacement (n, 3), and poses, rotation vectors and shifts.

    poses : (n_views, 2, 6) of each image, or (n_views, 1, 6) of both
    """
    return StereoModel(
        rig=model.rig.perturbed(np.pad(stereo, (0, N_RIG - N_STEREO))),
        R_left_board=rotation_from_vector(poses[..., :3]) @ model.R_left_board,
        t_left_board=model.t_left_board + poses[..., 3:],
        points=model.points + displacement,
    )


def restricted(model: StereoModel, nominal: Array, terms: Terms) -> StereoModel:
    """The model with terms that are not free set to zero: distortion, deformation of the board, fx - fy."""
    basis = board_basis(nominal, terms.board).reshape(nominal.size, -1)
    shape = np.linalg.pinv(basis) @ (model.points - nominal).reshape(-1)
    held = np.zeros(N_RIG)
    held[: 2 * N_INTRINSIC] = np.concatenate([camera.parameters for camera in model.rig.cameras])
    held[:N_STEREO][terms.free] = 0.0
    points = nominal + (basis @ shape).reshape(nominal.shape)
    return replace(model, points=points, rig=model.rig.perturbed(-held))
