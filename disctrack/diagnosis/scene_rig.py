"""The rig of a recording as a scene describes rigs: where the cameras stand, towards what they look, their lenses."""

from dataclasses import replace

import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array
from disctrack.synthetic.description import RigSettings, Scene


def scene_with_rig(scene: Scene, rig: StereoRig) -> Scene:
    """The scene with cameras like these, without seeded scatter.

    Like, not equal: a scene's cameras look straight at one point, and their pixels are as large there. Principal points
    off the middle and unequal focal lengths are lost, the view is the same to some pixels.
    """
    poses = rig.camera_poses()
    eyes = [-R.T @ t for R, t in poses]
    target = _between(eyes, [R[2] for R, _ in poses])
    distances, off_vertical, azimuth, roll = [], [], [], []
    for (R, _), eye in zip(poses, eyes, strict=True):
        away = eye - target
        distances.append(float(np.linalg.norm(away)))
        away = away / distances[-1]
        off_vertical.append(float(np.degrees(np.arccos(np.clip(away[2], -1.0, 1.0)))))
        azimuth.append(float(np.degrees(np.arctan2(away[1], away[0]))))
        # image x of an upright camera is horizontal; the roll turns it within the image
        horizontal = np.array([-away[1], away[0], 0.0]) / np.hypot(away[0], away[1])
        seen = R @ horizontal
        roll.append(float(np.degrees(np.arctan2(seen[1], seen[0]))))
    focal = [0.5 * (c.fx + c.fy) for c in rig.cameras]
    mm_per_px = float(np.mean([1e3 * d / f for d, f in zip(distances, focal, strict=True)]))
    settings = RigSettings(
        mm_per_px=mm_per_px,
        distance_mm=_pair([1e3 * d for d in distances]),
        off_vertical_deg=_pair(off_vertical),
        azimuth_deg=_pair(azimuth),
        roll_deg=_pair(roll),
        target_mm=(1e3 * float(target[0]), 1e3 * float(target[1]), 1e3 * float(target[2])),
        **{
            name: _pair([c.distortion[i] for c in rig.cameras]) for i, name in enumerate(("k1", "k2", "p1", "p2", "k3"))
        },
        variation=0.0,
    )
    width, height = rig.left.image_size
    return replace(scene, rig=settings, cameras=replace(scene.cameras, image_size=(int(width), int(height))))


def _pair(values: list[float]) -> tuple[float, float]:
    left, right = values
    return float(left), float(right)


def _between(points: list[Array], directions: list[Array]) -> Array:
    """The point nearest to all lines."""
    normals = [np.eye(3) - np.outer(d, d) for d in directions]
    return np.linalg.solve(
        np.sum(normals, axis=0), np.sum([N @ p for N, p in zip(normals, points, strict=True)], axis=0)
    )
