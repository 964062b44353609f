"""From the disc's pose to its dots in the images, with everything that may be wrong about cameras, table and dots.

Quantities of the measurement are addressed by name, as the effects of the motion are: "right_moved.rotation_x". Null is
always zero: as calibrated, as declared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.camera import Camera, StereoRig, project_with_jacobians
from disctrack.diagnosis.engine.system import Candidate, Quantity
from disctrack.disc import Disc
from disctrack.frames import CAMERAS, rotation_from_vector

Array = NDArray[np.float64]
_PX, _TURN, _SHIFT = 0.01, 1e-5, 1e-5  # steps: a hundredth of a pixel or so in the image
RIM_POINTS = 24  # of a dot's outline, for the centre of its image


@dataclass(frozen=True)
class DotImages:
    """Predicted images of the dots and how they move with the pose."""

    pixels: Array  # (n, 2, m, 2)
    by_pose: Array  # (n, 2, m, 2, 6), POSE_COMPONENTS of the disc in the world


def predict(R: Array, t: Array, rig: StereoRig, disc: Disc, faults: Mapping[str, float]) -> DotImages:
    """Images of the dots' centres for poses per camera R (2, n, 3, 3), t (2, n, 3), body -> world.

    faults : quantities of `measurement_candidates` that act on cameras, table and dots; those absent are null
    """
    get = lambda name: float(faults.get(name, 0.0))  # noqa: E731
    centres = moved_centres(disc, faults)
    tilt = rotation_from_vector(np.array([get("table_plane.tilt_x"), get("table_plane.tilt_y"), 0.0]))
    height = np.array([0.0, 0.0, get("table_height.offset")])
    pixels, by_pose = [], []
    for i, (camera, (R_cw, t_cw)) in enumerate(zip(rig.cameras, rig.camera_poses(), strict=True)):
        name = CAMERAS[i]
        arm = centres @ np.swapaxes(R[i], 1, 2)
        world = (arm + t[i][:, None]) @ tilt.T + height
        turn = rotation_from_vector(np.array([get(f"{name}_turned.rotation_{a}") for a in "xyz"])).T
        shift = np.array([get(f"{name}_shifted.translation_{a}") for a in "xyz"])
        in_camera = (world @ R_cw.T + t_cw - shift) @ turn.T
        view, d_point, _ = project_with_jacobians(in_camera, _lens(camera, name, faults))
        d_world = d_point @ (turn @ R_cw @ tilt)
        pixels.append(view)
        by_pose.append(np.concatenate([d_world, np.cross(arm[..., None, :], d_world)], axis=-1))
    return DotImages(np.stack(pixels, axis=1), np.stack(by_pose, axis=1))


def _lens(camera: Camera, name: str, faults: Mapping[str, float]) -> Camera:
    get = lambda key: float(faults.get(f"{name}_{key}", 0.0))  # noqa: E731
    k1, k2, p1, p2, k3 = camera.distortion
    focal = 1.0 + get("focal.change")
    return replace(
        camera,
        fx=camera.fx * focal,
        fy=camera.fy * focal,
        cx=camera.cx + get("principal_point.x"),
        cy=camera.cy + get("principal_point.y"),
        distortion=(k1 + get("distortion.k1"), k2, p1, p2, k3),
    )


def moved_centres(disc: Disc, faults: Mapping[str, float]) -> Array:
    """(m, 3) where the dots are on the body if the pattern or single dots are displaced [m]."""
    get = lambda name: float(faults.get(name, 0.0))  # noqa: E731
    centres = disc.marker_centres_body.copy()
    for i in range(disc.n_markers):
        centres[i, :2] += [get(f"misprint_{i}.x"), get(f"misprint_{i}.y")]
    angle, scale = get("pattern_rotation.angle"), 1.0 + get("pattern_scale.change")
    c, s = np.cos(angle), np.sin(angle)
    centres[:, :2] = scale * centres[:, :2] @ np.array([[c, s], [-s, c]])
    centres[:, :2] += [get("pattern_offset.x"), get("pattern_offset.y")]
    centres[:, 2] += get("pattern_height.offset")
    return centres


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


TYPICAL_STEPS = 30  # a fault of so many steps surprises nobody: 1/3 px, 0.02 deg, 0.3 mm, 0.3 ms


def _named(candidate: str, unit: str, scale: float, names: str, meaning: str, **bounds: float) -> tuple[Quantity, ...]:
    more = {"typical": TYPICAL_STEPS * scale, **bounds}
    return tuple(
        Quantity(f"{candidate}.{n}", unit, scale, meaning=f"{meaning} ({n})" if " " in names else meaning, **more)
        for n in names.split()
    )


def measurement_candidates(disc: Disc) -> tuple[Candidate, ...]:
    """All that may be wrong about the measurement, as candidates of the engine."""
    found: list[Candidate] = []

    def add(name: str, title: str, source: str, quantities: tuple[Quantity, ...]) -> None:
        found.append(Candidate(name, name, "measurement", title, source, quantities))

    add("time_offset", "the right camera exposes later than the left", "synchronisation of the cameras",
        _named("time_offset", "s", 1e-5, "delay", "right minus left", lower=-5e-3, upper=5e-3))  # fmt: skip
    add("frame_rate", "the true frame rate differs from the declared one", "clock of the cameras",
        _named("frame_rate", "1", 1e-4, "change", "true over declared minus one", lower=-0.3, upper=0.3))  # fmt: skip
    for name in CAMERAS:
        knock = "mount, cable, knock"
        turn, shift = "rotation_x rotation_y rotation_z", "translation_x translation_y translation_z"
        lens = f"of the {name} camera"
        add(f"{name}_turned", f"the {name} camera turned after its calibration", knock,
            _named(f"{name}_turned", "rad", _TURN, turn, "in its own axes"))  # fmt: skip
        add(f"{name}_shifted", f"the {name} camera moved after its calibration", knock,
            _named(f"{name}_shifted", "m", _SHIFT, shift, "in its own axes"))  # fmt: skip
        add(f"{name}_focal", f"the focal length {lens} changed", "focus, temperature",
            _named(f"{name}_focal", "1", 1e-5, "change", "relative"))  # fmt: skip
        add(f"{name}_principal_point", f"the principal point {lens} moved", "lens not fixed",
            _named(f"{name}_principal_point", "px", _PX, "x y", "in the image"))  # fmt: skip
        add(f"{name}_distortion", f"the distortion {lens} changed", "focus, aperture, other lens",
            _named(f"{name}_distortion", "1", 1e-3, "k1", "change of Brown's k1"))  # fmt: skip
    for i in range(disc.n_markers):
        add(f"misprint_{i}", f"dot {i} is not where it was declared", "printing",
            _named(f"misprint_{i}", "m", 1e-6, "x y", "body axes"))  # fmt: skip
    add("pattern_offset", "the dots as a whole are off the disc's centre", "gluing of the paper",
        _named("pattern_offset", "m", 1e-6, "x y", "body axes"))  # fmt: skip
    add("pattern_rotation", "the dots as a whole are turned on the face", "gluing; the same as another spin angle",
        _named("pattern_rotation", "rad", 1e-5, "angle", "about e3"))  # fmt: skip
    add("pattern_scale", "the dots as a whole are printed too large", "printer",
        _named("pattern_scale", "1", 1e-5, "change", "relative"))  # fmt: skip
    add("pattern_height", "the dots lie higher than half the thickness", "paper, glue, thickness",
        _named("pattern_height", "m", 1e-6, "offset", "along e3"))  # fmt: skip
    add("table_plane", "the table is not parallel to the calibration's table view", "board on a burr",
        _named("table_plane", "rad", 1e-5, "tilt_x tilt_y", "turn of the true table, calibrated axes"))  # fmt: skip
    add("table_height", "the table is not where the calibration's table view says", "thickness of the board",
        _named("table_height", "m", 1e-6, "offset", "true height of the table in the calibrated axes"))  # fmt: skip
    add("exposure_blur", "dots are averaged over an exposure", "centre moves by T^2/24 times its acceleration",
        _named("exposure_blur", "s^2", 1e-7, "T2", "square of the exposure", lower=0.0, upper=1e-3))  # fmt: skip
    add("ellipse_centre", "centres of ellipses were taken for images of the centres", "perspective of circles",
        _named("ellipse_centre", "1", 0.1, "share", "1: not corrected at all, -1: corrected twice",
               lower=-2.0, upper=2.0))  # fmt: skip
    return tuple(found)
