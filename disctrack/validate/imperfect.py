"""The same claim in an imperfect laboratory: recordings rendered with what every laboratory has and nobody declares."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.kit.arrays import Array
from disctrack.calibrate.stage import calibrate_recording
from disctrack.frames import POSE_COMPONENTS
from disctrack.recording.declaration import read_recording
from disctrack.synthetic import write_recording
from disctrack.synthetic.description import GlareSettings, ImperfectionSettings, Scene
from disctrack.synthetic.motion import motion_of
from disctrack.validate.comparison import compare
from disctrack.validate.trial import locate, read_images, rolling_scene

ORDINARY = ImperfectionSettings(
    lens_field_px=0.02,
    board_bow_mm=0.06,
    board_stretch=2e-4,
    pixel_gain=0.01,
    column_offset_dn=0.3,
    response_curve=0.03,
)
FALL_OFF, GLEAM_DN = 0.15, 12.0
GOAL_HEIGHT, GOAL_TILT = 5e-6, np.radians(5e-3)  # [m, rad] of the mean error


@dataclass(frozen=True)
class ImperfectTrial:
    """One recording; components are POSE_COMPONENTS [m, rad]."""

    seed: int
    error: Array  # (6,) mean over the frames
    sigma: Array  # (6,) stated for it: what frames share
    scatter: Array  # (6,) about the mean
    noise_ratio: float  # squared scatter from frame to frame over its stated variance, mean of the components
    systematic_px: tuple[float, float]
    warnings: tuple[str, ...]


def imperfect_scene(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with ordinary imperfections; every second board is bowed downwards."""
    sign = 1 if scene.seed % 2 else -1
    width, height = scene.cameras.image_size
    gleams = tuple(
        GlareSettings(name, (rng.uniform(0.3, 0.7) * width, rng.uniform(0.3, 0.7) * height), 0.18 * width, GLEAM_DN)
        for name in ("left", "right")
    )
    return replace(
        scene,
        imperfections=replace(ORDINARY, board_bow_mm=sign * ORDINARY.board_bow_mm),
        optics=replace(scene.optics, vignetting=FALL_OFF),
        light=replace(scene.light, glare=gleams),
    )


def imperfect_trial(scene: Scene, frames: int) -> ImperfectTrial:
    """Render, calibrate and measure one recording of rolling motion."""
    rng = np.random.default_rng([scene.seed, 11])
    rolling = rolling_scene(imperfect_scene(scene, rng), rng.uniform(8, 16), frames, rng)
    with tempfile.TemporaryDirectory(prefix="disctrack-validate-") as name:
        truth = write_recording(Path(name) / "recording", rolling, motion_of(rolling))
        recording = read_recording(Path(name) / "recording")
        rig = calibrate_recording(recording)[0].rig
        images = read_images(recording, 0, frames)
    tracking = locate(images, rig, recording.disc, recording.frame_rate, apart=False)
    found = compare(tracking.trajectory, truth.q)
    ok = found.usable
    error, variance = found.error[ok], np.diagonal(found.covariance[ok], axis1=1, axis2=2)
    shared = np.diagonal(found.calibration_covariance[ok], axis1=1, axis2=2)
    bends = np.diff(error, 2, axis=0) ** 2 / 6.0
    return ImperfectTrial(
        scene.seed,
        error.mean(axis=0),
        np.sqrt(np.median(shared, axis=0)),
        error.std(axis=0),
        float(np.mean(bends / variance[1:-1])),
        tracking.systematic_px,
        tracking.warnings,
    )


def imperfect_trials(
    scenes: Sequence[Scene], frames: int, say: Callable[[str], object] = lambda text: None
) -> list[ImperfectTrial]:
    """Trials of several scenes."""
    trials = []
    for k, scene in enumerate(scenes):
        say(f"imperfect laboratory {k + 1} of {len(scenes)}")
        trials.append(imperfect_trial(scene, frames))
    return trials


def honesty(trials: Sequence[ImperfectTrial]) -> Array:
    """(6,) mean squared error over the stated variance."""
    return np.asarray(np.mean([(trial.error / trial.sigma) ** 2 for trial in trials], axis=0))


def imperfect_table(trials: Sequence[ImperfectTrial]) -> str:
    """Markdown: mean errors with what is stated for them, scatter, honesty."""
    unit = np.array(3 * [1e6] + 3 * [np.degrees(1e3)])
    lines = [
        "## Imperfect laboratory",
        "",
        "Mean error +- what is stated for it, in um and mdeg; scatter about the mean below.",
        "",
        f"| seed | {' | '.join(POSE_COMPONENTS)} | frame to frame, squared over stated | repeating, px |",
        f"|---|{'---|' * (len(POSE_COMPONENTS) + 2)}",
    ]
    for trial in trials:
        cells = [f"{e:.2f} +- {s:.2f}" for e, s in zip(trial.error * unit, trial.sigma * unit, strict=True)]
        left, right = trial.systematic_px
        lines.append(f"| {trial.seed} | {' | '.join(cells)} | {trial.noise_ratio:.2f} | {left:.4f}, {right:.4f} |")
        lines.append(f"| | {' | '.join(f'{s:.2f}' for s in trial.scatter * unit)} | | |")
    lines.append(f"| squared error over variance | {' | '.join(f'{v:.2f}' for v in honesty(trials))} | | |")
    return "\n".join(lines) + "\n"
