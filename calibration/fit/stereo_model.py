"""Model of the images of a flat target in two cameras: parameters, observations, derivatives."""

from dataclasses import dataclass, fields

import numpy as np

from calibration.cameras.camera import N_RIG, PAIR_SHIFT, StereoRig, by_turning, rotation_from_vector
from calibration.kit.errors import ArgumentError
from calibration.kit.types import AnyArray, Array, Indices, Mask, checked

N_STEREO = PAIR_SHIFT.stop  # left and right intrinsics, rotation and translation of the pair come first


@checked
@dataclass(frozen=True)
class Observations:
    """Image points of target points of all views and cameras, in flat arrays."""

    view: Indices  # (m,) 0..n_views-1
    camera: Indices  # (m,) 0 left, 1 right
    point: Indices  # (m,) index into the target's points
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

    def __getitem__(self, keep: AnyArray) -> "Observations":
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

    stereo : empty if these parameters are fixed;  poses : (n_views, 2, 6) of each image, or (n_views, 1, 6) of both
    """
    return StereoModel(
        rig=model.rig.perturbed(np.pad(stereo, (0, N_RIG - len(stereo)))),
        R_left_board=rotation_from_vector(poses[..., :3]) @ model.R_left_board,
        t_left_board=model.t_left_board + poses[..., 3:],
        points=model.points + displacement,
    )
