"""Scatter of the measurement beside the Cramer-Rao bound: noisy copies of the same images, pose by pose."""

from dataclasses import dataclass
from typing import cast

import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Mask
from disctrack.frames import euler_jacobian
from disctrack.synthetic.description import Scene
from disctrack.synthetic.sensor import digitise
from disctrack.trajectory import MarkerStatus
from disctrack.validate.bound import camera_maps, inverse_information, pose_bound
from disctrack.validate.comparison import QUANTITIES, PoseErrors, compare
from disctrack.validate.poses import STRATA_DEG, cameras_in_sight, static_poses
from disctrack.validate.trial import Image, every, locate


@dataclass(frozen=True)
class Efficiency:
    """n poses, seen by both cameras at rest, measured through the true cameras; columns as QUANTITIES [m, rad]."""

    q: Array  # (n, 6)
    bound: Array  # (n, 7) Cramer-Rao sigma from the pixels of the dots
    bound_image: Array  # (n, 7) the same from all pixels
    scatter: Array  # (n, 7) of the copies about their mean
    bias: Array  # (n, 7) mean of the copies minus truth; rotation: root mean square of its components
    reported: Array  # (n, 7) sigma that the measurement states
    excess: Array  # (n,) mean of e^T F e / 6 about the mean: variance over the bound's, 1 at best
    all_dots: Mask  # (n,) every dot was used in both cameras in every copy
    copies: int

    @property
    def judged(self) -> Mask:
        """(n,) poses that `efficiency` is taken from: those with all dots, or all where there are none.

        A dot seen nearly edge-on, or in part, is refused though its pixels count in the bound.
        """
        return self.all_dots if self.all_dots.any() else np.ones_like(self.all_dots)

    @property
    def efficiency(self) -> float:
        """Bound over scatter, all six components of all judged poses together."""
        return float(1 / np.sqrt(np.mean(self.excess[self.judged])))

    @property
    def efficiency_uncertainty(self) -> float:
        """Standard error of `efficiency`."""
        return float(self.efficiency * np.sqrt(2 / (6 * self.judged.sum() * (self.copies - 1))) / 2)


def measure_efficiency(scene: Scene, rig: StereoRig, n_poses: int, copies: int) -> Efficiency:
    """Efficiency at n_poses, strata of nutation in turn, from `copies` noisy images of each; rig: the true cameras."""
    disc, rng = scene.declared_disc, np.random.default_rng([scene.seed, 9])
    poses = _seen_poses(scene, rig, n_poses, rng)
    maps = camera_maps(rig)
    bounds = [pose_bound(q, rig, disc, scene, maps) for q in poses]
    images = np.stack(
        [
            digitise(bound.expected, scene.sensor, scene.cameras.bit_depth, rng)
            for bound in bounds
            for _ in range(copies)
        ]
    )
    tracking = locate(cast(Image, images), rig, disc, scene.cameras.frame_rate_hz, apart=True)
    trajectory = every(tracking.trajectory, 2)
    comparison = compare(trajectory, np.repeat(poses, copies, axis=0))
    used = (trajectory.marker_status == MarkerStatus.MEASURED).all(axis=(1, 2)).reshape(len(poses), copies)
    per_pose = [comparison.part(np.arange(len(images)) // copies == k) for k in range(len(poses))]
    kept = [k for k, part in enumerate(per_pose) if part.usable.sum() > 2]
    return Efficiency(
        q=poses[kept],
        bound=np.array([coordinate_sigma(bounds[k].covariance, poses[k]) for k in kept]),
        bound_image=np.array([coordinate_sigma(inverse_information(bounds[k].image), poses[k]) for k in kept]),
        scatter=np.array([_scatter(per_pose[k]) for k in kept]),
        bias=np.array([_bias(per_pose[k]) for k in kept]),
        reported=np.array([_reported(per_pose[k]) for k in kept]),
        excess=np.array([_excess(per_pose[k], bounds[k].dots) for k in kept]),
        all_dots=used[kept].all(axis=1),
        copies=copies,
    )


def _seen_poses(scene: Scene, rig: StereoRig, n: int, rng: np.random.Generator) -> Array:
    """Poses that both cameras see, strata of nutation in turn; a stratum that never shows its face is left out."""
    middle = (scene.rig.target_mm[0] * 1e-3, scene.rig.target_mm[1] * 1e-3)
    strata = len(STRATA_DEG)
    drawn = static_poses(strata * (20 + n), rig, scene.declared_disc, middle, rng)
    seen = drawn[cameras_in_sight(drawn, rig, scene.declared_disc) == 2]
    stratum = np.searchsorted([high for _, high in STRATA_DEG], np.degrees(seen[:, 4]))
    chosen = [rng.permutation(np.flatnonzero(stratum == k % strata))[k // strata :][:1] for k in range(n)]
    return np.asarray(seen[np.sort(np.concatenate(chosen))])


def coordinate_sigma(covariance: Array, q: Array) -> Array:
    """(7,) standard deviations of QUANTITIES from a covariance (6, 6) of POSE_COMPONENTS at q (6,)."""
    J = euler_jacobian(q[3], q[4])
    with np.errstate(invalid="ignore"):
        angles = np.diag(J @ covariance[3:, 3:] @ J.T)
        rotation = np.trace(covariance[3:, 3:]) / 3
        return np.asarray(np.sqrt(np.concatenate([np.diag(covariance)[:3], angles, [rotation]])))


def _scatter(part: PoseErrors) -> Array:
    ok = part.usable
    e = np.concatenate([part.error[ok, :3], part.angles[ok]], axis=1)
    rotation = np.sqrt(np.mean(part.error[ok, 3:].var(axis=0, ddof=1)))
    return np.append(e.std(axis=0, ddof=1), rotation)


def _bias(part: PoseErrors) -> Array:
    ok = part.usable
    e = np.concatenate([part.error[ok, :3], part.angles[ok]], axis=1).mean(axis=0)
    return np.append(e, np.sqrt(np.mean(part.error[ok, 3:].mean(axis=0) ** 2)))


def _reported(part: PoseErrors) -> Array:
    sigma = [coordinate_sigma(C, q) for C, q in zip(part.covariance[part.usable], part.q[part.usable], strict=True)]
    return np.asarray(np.sqrt(np.mean(np.square(sigma), axis=0)))


def _excess(part: PoseErrors, information: Array) -> float:
    e = part.error[part.usable]
    e = e - e.mean(axis=0)
    return float(np.einsum("ni,ij,nj->", e, information, e) / (6 * (len(e) - 1)))


def law_constant(efficiency: Efficiency) -> float:
    """The constant c [rad] of the law sigma(psi) = c / sin(theta), from the measured scatter of psi and phi."""
    s = np.sin(efficiency.q[:, 4])
    i = [QUANTITIES.index("psi"), QUANTITIES.index("phi")]
    low = s < np.sin(np.radians(20.0))  # at larger nutation the cameras' directions matter more than the law
    return float(np.sqrt(np.mean((efficiency.scatter[low][:, i] * s[low, None]) ** 2)))
