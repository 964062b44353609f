"""`disctrack validate`: render, measure, compare, write the verdict."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from disctrack.files.json_text import json_file
from disctrack.files.whole import make_folder, write_whole
from disctrack.synthetic.description import BoardSettings, CameraSettings, RigSettings, Scene
from disctrack.validate.controls import Control, planted_faults
from disctrack.validate.efficiency import measure_efficiency
from disctrack.validate.stress import DISTURBANCES, apply_stress, stress_poses
from disctrack.validate.summary import Summary, summarise
from disctrack.validate.tables import as_json, markdown
from disctrack.validate.trial import TrialRecording, run_trial

FIRST_SEED = 2014


@dataclass(frozen=True)
class ValidationPlan:
    """How much is rendered and measured. Poses and frames are shared out among the recordings."""

    recordings: int = 3
    static_poses: int = 96  # in all recordings together
    rolling_frames: int = 90
    final_frames: int = 90
    fewest: int = 12  # of each in one recording
    bound_poses: int = 12
    copies: int = 10
    stress_poses: int = 6
    bisections: int = 2
    disturbances: tuple[str, ...] = tuple(d.name for d in DISTURBANCES)
    planted_faults: bool = True

    def share(self, total: int) -> int:
        """Poses or frames of one recording."""
        return max(self.fewest, -(-total // self.recordings)) if total else 0


QUICK = ValidationPlan(
    recordings=1, static_poses=40, rolling_frames=24, final_frames=24, bound_poses=8, copies=8, stress_poses=4,
    bisections=1, disturbances=("noise of a pixel", "dots that have come off"),
)  # fmt: skip


def scene_of(seed: int, quick: bool = False) -> Scene:
    """The scene of one recording: the paper's format; quick: a quarter of the pixels and fewer chessboard views."""
    scene = Scene(name=f"validation {seed}", seed=seed)
    if not quick:
        return scene
    return replace(
        scene,
        cameras=CameraSettings(image_size=(272, 272)),
        rig=RigSettings(mm_per_px=0.42),
        board=BoardSettings(n_views=12, square_mm=6.0, shift_mm=15.0),
    )


def validate(
    plan: ValidationPlan,
    *,
    quick: bool = False,
    seed: int = FIRST_SEED,
    say: Callable[[str], object] = lambda text: None,
) -> tuple[Summary, list[TrialRecording]]:
    """Run a plan: recording k has the seed `seed` + k. Nothing is left on the disk; `say` tells of every step."""
    trials: list[TrialRecording] = []
    for k in range(plan.recordings):
        with tempfile.TemporaryDirectory(prefix="disctrack-validate-") as folder:
            trials.append(
                run_trial(
                    scene_of(seed + k, quick),
                    Path(folder) / "recording",
                    n_static=plan.share(plan.static_poses),
                    n_rolling=plan.share(plan.rolling_frames),
                    n_final=plan.share(plan.final_frames),
                    say=lambda step, k=k: say(f"recording {k + 1} of {plan.recordings}: {step}"),  # type: ignore[misc]
                )
            )
    scene, true, own = trials[0].scene, trials[0].truth.rig, trials[0].calibration.rig
    efficiency = None
    if plan.bound_poses:
        say("Cramer-Rao bound")
        efficiency = measure_efficiency(scene, true, plan.bound_poses, plan.copies)
    q = stress_poses(plan.stress_poses, true, scene, np.random.default_rng([seed, 13])) if plan.stress_poses else None
    stresses = []
    for disturbance in DISTURBANCES:
        if q is not None and disturbance.name in plan.disturbances:
            say(f"raise {disturbance.name}")
            stresses.append(apply_stress(disturbance, scene, true, own, q, bisections=plan.bisections))
    controls: tuple[Control, ...] = ()
    if plan.planted_faults:
        say("planted faults")
        controls = planted_faults(scene, true, own)
    return summarise(trials, efficiency, stresses, controls), trials


def write_validation(folder: Path, summary: Summary, trials: list[TrialRecording], seconds: float) -> list[Path]:
    """Write validation.json, validation.md and the pictures; returns the files. Raises OutputError."""
    from disctrack.pages.figures import save_figure
    from disctrack.validate.plots import bound_figure, error_figure, stress_figure

    make_folder(folder)
    figures = {"error_against_nutation.png": error_figure(trials, summary.law)}
    if summary.efficiency is not None:
        figures["scatter_and_bound.png"] = bound_figure(summary.efficiency)
    if summary.stresses:
        figures["stress.png"] = stress_figure(summary.stresses)
    text = markdown(summary) + "\n" + "\n".join(f"![{name[:-4].replace('_', ' ')}]({name})" for name in figures) + "\n"
    tree = {**as_json(summary), "seconds": seconds, "seeds": [trial.scene.seed for trial in trials]}
    files = [folder / "validation.json", folder / "validation.md"]
    write_whole(files[0], json_file(tree))
    write_whole(files[1], text.encode())
    for name, figure in figures.items():
        files.append(save_figure(figure, folder / name))
    return files


def run_validate(
    folder: Path,
    *,
    recordings: int | None = None,
    quick: bool = False,
    seed: int = FIRST_SEED,
    say: Callable[[str], object] = lambda text: None,
) -> tuple[Summary, list[Path]]:
    """Validate and write the results into `folder`; returns the summary and the files.

    recordings : None leaves it to the plan   quick : small images and few of everything
    """
    plan = QUICK if quick else ValidationPlan()
    if recordings is not None:
        plan = replace(plan, recordings=recordings)
    make_folder(folder)  # a place that cannot be written to should be known before the work
    began = time.perf_counter()
    summary, trials = validate(plan, quick=quick, seed=seed, say=say)
    return summary, write_validation(folder, summary, trials, time.perf_counter() - began)
