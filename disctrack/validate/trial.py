"""One validation recording: rendered with its own rig and chessboards, calibrated, measured, compared with its truth.

Frames 0 ... s-1 are static poses, each measured without a prior; then come stretches of rolling motion. The recording
is a folder like any other and passes through the readers, the calibration and the tracking as the user's would.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration import StereoCalibration
from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Image
from disctrack.calibrate.stage import calibrate_recording
from disctrack.disc import Disc
from disctrack.frames import CAMERAS
from disctrack.recording.declaration import Recording, read_recording
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.blocks import PairBlock, Unreadable, iter_pair_blocks
from disctrack.synthetic import Truth, rig_of, write_recording
from disctrack.synthetic.description import MotionSettings, RollingMotion, Scene
from disctrack.synthetic.motion import SceneMotion, motion_of
from disctrack.track.tracking import Tracking, TrackingSettings, track
from disctrack.trajectory import Trajectory, part
from disctrack.validate.comparison import PoseErrors, compare
from disctrack.validate.poses import cameras_in_sight, static_poses

ROLLING = "rolling at 8 to 12 deg"
FINAL = "rolling to rest at 0.5 deg"
EXPOSURE = 0.5e-3  # [s] half the time between frames: rolling at 10 deg smears the outer dots over 0.6 px
K_M = 0.381e-7  # friction coefficient of Ma et al. 2014, equation (5.3), alone: the disc then comes to rest by
TO_REST = (7.93, 1.5)  # (5.11): theta [deg] this time [s] before the end, and theta goes as time^(2/3)


@dataclass(frozen=True)
class MeasuredTwice:
    """The same images measured twice: through the recording's own calibration, and through the true cameras."""

    own: PoseErrors
    true: PoseErrors
    cameras: NDArray[np.int64]  # (n,) that see the upper face
    variance_factor: float  # of the run through the own calibration
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class TrialRecording:
    """What one recording showed."""

    scene: Scene
    truth: Truth
    calibration: StereoCalibration
    static: MeasuredTwice
    rolling: dict[str, MeasuredTwice]  # by the name of the stretch


def rolling_scene(scene: Scene, theta_deg: float, n: int, rng: np.random.Generator) -> Scene:
    """The scene with n frames of rolling from `theta_deg` on, starting at random psi and phi."""
    x, y = scene.rig.target_mm[:2]
    start = RollingMotion(
        theta_deg=theta_deg,
        psi_deg=rng.uniform(-180, 180),
        phi_deg=rng.uniform(-180, 180),
        centre_mm=(x, y),
        effects={"km": {"k_m": K_M}},
    )
    return replace(
        scene,
        cameras=replace(scene.cameras, n_frames=n, exposure_s=EXPOSURE),
        motion=MotionSettings(kind="rolling", rolling=start),
    )


def theta_before_rest_deg(n: int, frame_rate: float) -> float:
    """Nutation [deg] from which the disc takes n frames down to 0.5 deg, by (5.11)."""
    theta, time = TO_REST
    left = time * (0.5 / theta) ** 1.5 + n / frame_rate
    return float(theta * (left / time) ** (2 / 3))


def one_after_the_other(parts: Sequence[SceneMotion], rate: float) -> SceneMotion:
    """Motions in one recording: frame i of part k is frame i + (all frames of the parts before)."""
    starts = np.concatenate([[0], np.cumsum([part.n_frames for part in parts])])

    def joined(name: str, time: Array) -> Array:
        time = np.atleast_1d(np.asarray(time, float))
        part_of = np.searchsorted(starts[1:-1], np.rint(time * rate), side="right")
        q = np.empty((len(time), 6))
        for k in np.unique(part_of):
            rows = part_of == k
            q[rows] = getattr(parts[k], name)(time[rows] - starts[k] / rate)
        return q

    return SceneMotion(partial(joined, "pose"), partial(joined, "rates"), int(starts[-1]))


def run_trial(
    scene: Scene,
    folder: Path,
    *,
    n_static: int,
    n_rolling: int,
    n_final: int,
    say: Callable[[str], object] = lambda text: None,
) -> TrialRecording:
    """Render the recording of `scene` into `folder`, measure it and compare.

    n_static, n_rolling, n_final : static poses, frames of the two stretches of rolling motion (0: none)
    say : called with the name of each step as it begins
    """
    rng = np.random.default_rng([scene.seed, 8])
    rig, disc = rig_of(scene), scene.declared_disc
    poses = static_poses(n_static, rig, disc, (scene.rig.target_mm[0] * 1e-3, scene.rig.target_mm[1] * 1e-3), rng)
    at_rest = SceneMotion(
        lambda time: poses[np.rint(np.asarray(time) * scene.cameras.frame_rate_hz).astype(int).clip(0, n_static - 1)],
        lambda time: np.zeros((len(time), 6)),
        n_static,
    )
    start = rng.uniform(8, 12)
    stretches: dict[str, Scene] = {}
    if n_rolling:
        stretches[ROLLING] = rolling_scene(scene, start, n_rolling, rng)
    if n_final:
        last = theta_before_rest_deg(n_final, scene.cameras.frame_rate_hz)
        stretches[FINAL] = rolling_scene(scene, last, n_final, rng)
    motions = [at_rest, *(motion_of(stretch) for stretch in stretches.values())]
    base = replace(scene, motion=MotionSettings(kind="rolling"), cameras=replace(scene.cameras, exposure_s=EXPOSURE))
    say("render")
    truth = write_recording(folder, base, one_after_the_other(motions, scene.cameras.frame_rate_hz))
    recording = read_recording(folder)
    say("calibrate")
    calibration, _ = calibrate_recording(recording)
    say("measure")
    edges = np.concatenate([[0], np.cumsum([motion.n_frames for motion in motions])])
    measured = [
        measure_twice(
            read_images(recording, int(a), int(b)),
            truth.q[a:b],
            recording.disc,
            calibration.rig,
            truth.rig,
            scene,
            apart=k == 0,
        )
        for k, (a, b) in enumerate(itertools.pairwise(edges))
    ]
    return TrialRecording(scene, truth, calibration, measured[0], dict(zip(stretches, measured[1:], strict=True)))


def read_images(recording: Recording, start: int, stop: int) -> Image:
    """(n, 2, height, width) pairs start ... stop-1 of a recording."""
    left, right = (
        open_frames(pattern, recording.folder, camera)
        for pattern, camera in zip((recording.left, recording.right), CAMERAS, strict=True)
    )
    return np.concatenate([block.images.copy() for block in iter_pair_blocks(left, right, start, stop)])


def measure_twice(
    images: Image,
    q_true: Array,
    disc: Disc,
    own: StereoRig,
    true: StereoRig,
    scene: Scene,
    *,
    apart: bool,
) -> MeasuredTwice:
    """Comparison of images (n, 2, height, width) measured through both rigs; `apart` as in `locate`."""
    rate = scene.cameras.frame_rate_hz
    through_own = locate(images, own, disc, rate, apart=apart)
    through_true = locate(images, true, disc, rate, apart=apart)
    step = 2 if apart else 1
    return MeasuredTwice(
        own=compare(every(through_own.trajectory, step), q_true),
        true=compare(every(through_true.trajectory, step), q_true),
        cameras=cameras_in_sight(q_true, true, disc),
        variance_factor=through_own.variance_factor,
        warnings=through_own.warnings,
    )


def locate(images: Image, rig: StereoRig, disc: Disc, frame_rate: float, *, apart: bool) -> Tracking:
    """Track pairs in memory. apart: an unreadable pair follows each one, so that each is found without a prior."""
    step = 2 if apart else 1

    def read_blocks(start: int, stop: int) -> Iterator[PairBlock]:
        block = 32
        for first in range(start, stop, block):
            frames = np.arange(first, min(first + block, stop))
            real = frames % step == 0
            pairs = np.zeros((len(frames), *images.shape[1:]), images.dtype)
            pairs[real] = images[frames[real] // step]
            none = tuple(Unreadable(int(i), camera, "") for i in frames[~real] for camera in (0, 1))
            yield PairBlock(frames, pairs, none)

    settings = TrackingSettings(search_always=apart)
    return track(read_blocks, range(step * len(images)), rig, disc, frame_rate, settings=settings)


def every(trajectory: Trajectory, step: int) -> Trajectory:
    """The trajectory's frames 0, step, 2 step, ..."""
    return part(trajectory, slice(None, None, step))
