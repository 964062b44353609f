"""A complete synthetic recording on disk, and the truth in a separate file."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import h5py
import numpy as np
from scipy.interpolate import PPoly

from calibration.cameras.camera import StereoRig
from calibration.kit.types import Array, Array32, checked
from calibration.rig_file import write_rig_group
from disctrack.disc import AIR_DENSITY, Disc
from disctrack.errors import OutputError, told_as
from disctrack.faults.dots import cameras_with, centres_with, marker_pixels
from disctrack.frames import COORDINATES, rotation_from_euler
from disctrack.recording.declaration import KEYS, declaration_text
from disctrack.synthetic.cameras import board_poses, rig_of
from disctrack.synthetic.description import ImperfectionSettings, Scene, scene_toml
from disctrack.synthetic.images import expected_board_image, expected_disc_image, stages
from disctrack.synthetic.motion import motion_of, rolling_model, true_exposure, true_frame_rate
from disctrack.synthetic.optics import digitise

Progress = Callable[[int, int], None]  # images done, total number of images

TRUTH_NAME = "truth.h5"  # for validation only, no stage of the measurement reads it


@dataclass(frozen=True)
class Truth:
    """True values of a recording, SI and radians."""

    time: Array  # (n,) mid exposure of the left camera's frames [s]
    q: Array  # (n, 6) at `time`, angles not wrapped
    qdot: Array  # (n, 6) rates at `time`
    q_right: Array  # (n, 6) at the right camera's mid exposure; equals q unless that camera is delayed
    frame_rate: float  # true one [Hz]
    rig: StereoRig  # during the calibration
    rig_while_filming: StereoRig  # during the recording of the disc
    disc: Disc  # with the true centres of the dots
    R_world_board: Array  # (v, 3, 3) of the calibration views
    t_world_board: Array  # (v, 3) [m]
    effects: dict[str, float]  # "effect.parameter" of the rolling model, SI

    @property
    def markers_px(self) -> Array:
        """(n, 2, m, 2) images of the centres of the dots at mid exposure, visible or not."""
        q = np.stack([self.q, self.q_right])
        R = rotation_from_euler(*np.moveaxis(q[..., 3:], -1, 0))
        return marker_pixels(R, q[..., :3], self.rig_while_filming, self.disc.marker_centres_body)[0]


# A file, the function that renders its image, and the seed of its own noise, so that the image does not depend on the
# order or the number of threads
Job = tuple[Path, Callable[[], Array32], list[int]]


@checked
def run_render(
    scene: Scene, folder: str | Path, truth_path: str | Path | None = None, progress: Progress | None = None
) -> Truth:
    """`disctrack render SCENE.toml -o RECORDING`: render a scene into a new recording folder, and write its truth.

    scene : or its file
    truth_path : by default truth.h5 in the folder, which recording.toml does not mention

    The folder gets its name when it is complete. Raises OutputError if it exists already or cannot be written,
    SceneError if the scene cannot be read or rendered.

        >>> truth = run_render("scene.toml", "rendered")
        >>> len(truth.time)
        4
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder}: exists and is not an empty folder; choose another name or remove it")
    target = None if truth_path is None else Path(truth_path)
    if target is not None and target.exists():
        raise OutputError(f"{target}: exists; choose another name for the truth or remove it")
    pose, n_frames = motion_of(scene)
    truth = _truth(scene, pose, n_frames, rig_of(scene))
    message = f"{folder}: the recording cannot be written"
    with told_as(OutputError, message, OSError, then="Check the disk and the rights."):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f"{folder.name}.", suffix=".part", dir=folder.parent) as place:
            part = Path(place, "recording")
            for name in ("left", "right", "calibration/left", "calibration/right"):
                (part / name).mkdir(parents=True)
            (part / "recording.toml").write_text(recording_toml(scene), encoding="utf-8")
            _write_all([*_boards(part, scene, truth), *_frames(part, scene, pose, truth)], scene, progress)
            _write_truth(target or part / TRUTH_NAME, truth, scene)
            if folder.exists():
                folder.rmdir()
            part.rename(folder)
    return truth


def true_disc_of(scene: Scene) -> Disc:
    """The disc with its dots at their true positions."""
    disc, faults = scene.declared_disc, scene.faults
    drawn = np.random.default_rng([scene.seed, 6]).standard_normal((disc.n_markers, 2))
    centres = disc.marker_centres_body.copy()
    centres[:, :2] += faults.misprint_sigma_mm * 1e-3 * drawn
    return replace(disc, marker_centres_body=centres_with(faults, replace(disc, marker_centres_body=centres)))


def _truth(scene: Scene, pose: PPoly, n_frames: int, rig: StereoRig) -> Truth:
    rate, faults = true_frame_rate(scene), scene.faults
    time = faults.true_times(np.arange(n_frames) / rate, rate)
    R, t = board_poses(scene, rig)
    return Truth(
        time=time,
        q=pose(time),
        qdot=pose(time, 1),
        q_right=pose(time + _delay(scene)),
        frame_rate=rate,
        rig=rig,
        rig_while_filming=cameras_with(faults, rig),
        disc=true_disc_of(scene),
        R_world_board=R,
        t_world_board=t,
        effects=dict(rolling_model(scene).values) if scene.motion.kind == "rolling" else {},
    )


def _delay(scene: Scene) -> float:
    """Delay of the right camera [s]; zero for poses at rest."""
    return 0.0 if scene.motion.kind == "static" else scene.faults.right_delay_s


def _boards(part: Path, scene: Scene, truth: Truth) -> Iterator[Job]:
    for c, stage in enumerate(stages(truth.rig, scene)):
        for view, (R, t) in enumerate(zip(truth.R_world_board, truth.t_world_board, strict=True)):
            path = part / "calibration" / stage.name / f"{view:02d}.png"
            yield path, partial(expected_board_image, R, t, stage, scene), [scene.seed, 3, c, view]


def _frames(part: Path, scene: Scene, pose: PPoly, truth: Truth) -> Iterator[Job]:
    exposure = 0.0 if scene.motion.kind == "static" else true_exposure(scene)
    dots = np.delete(truth.disc.marker_centres_body, scene.faults.hidden_markers, axis=0)
    drawn = replace(truth.disc, marker_centres_body=dots)
    for c, stage in enumerate(stages(truth.rig_while_filming, scene)):
        missing = (scene.faults.left, scene.faults.right)[c].missing_frames
        for i in sorted(set(range(len(truth.time))) - set(missing)):
            around = partial(lambda mid, dt: pose(mid + dt), truth.time[i] + c * _delay(scene))
            render = partial(expected_disc_image, around, exposure, i, stage, scene, drawn)
            yield part / stage.name / f"{i:06d}.png", render, [scene.seed, 4, c, i]


def _write_all(jobs: list[Job], scene: Scene, progress: Progress | None) -> None:
    # noisy images have no repeated patterns: run-length encoding is faster, and the files are smaller
    settings = [cv2.IMWRITE_PNG_COMPRESSION, scene.render.png_compression]
    settings += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]

    def write(job: Job) -> None:
        path, render, seed = job
        image = digitise(render(), scene.sensor, scene.cameras.bit_depth, np.random.default_rng(seed))
        if not cv2.imwrite(str(path), image, settings):
            raise OSError(f"{path} not written")

    with ThreadPoolExecutor(max_workers=max(scene.render.threads, 1)) as pool:
        for done, _ in enumerate(pool.map(write, jobs), start=1):
            if progress is not None:
                progress(done, len(jobs))


def recording_toml(scene: Scene) -> str:
    """The declaration of the experimenter, without the faults of the scene.

    Without imperfections the declared sizes are exact, with tolerances of zero; otherwise the tolerances are the usual.
    """
    board, cameras = scene.board, scene.cameras
    views = {"left": "calibration/left/*.png", "right": "calibration/right/*.png"}
    declared: dict[str, dict[str, object]] = {
        "cameras": {"frame_rate_hz": cameras.frame_rate_hz, "left": "left/*.png", "right": "right/*.png"},
        "disc": asdict(scene.disc),
        "markers": asdict(scene.markers),
        "calibration": {**views, "inner_corners": board.inner_corners, "square_mm": board.square_mm},
        "table": {"board_thickness_mm": board.thickness_mm},
        "gravity": {"g_m_s2": scene.gravity_m_s2},
        "air": {} if scene.air_density_kg_m3 == AIR_DENSITY else {"density_kg_m3": scene.air_density_kg_m3},
    }
    declaration = {(section, key): (value, "") for section, values in declared.items() for key, value in values.items()}
    if scene.imperfections == ImperfectionSettings():
        tolerances = [(section, key) for section, keys in KEYS.items() for key in keys if "_tolerance_" in key]
        declaration |= dict.fromkeys(tolerances, (0.0, "here, what is declared is exact"))
    declaration["table", "view"] = 0, "in this view, counted from 0, the board lies flat on the table"
    return declaration_text(scene.name, declaration, {}, {})[0]


def _write_truth(path: Path, truth: Truth, scene: Scene) -> None:
    """Write `truth` and its scene, and create the folder if necessary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pose, disc = ", ".join(f"{c} {'m' if c in 'xyz' else 'rad'}" for c in COORDINATES), truth.disc
    datasets = (
        ("time", truth.time, "s", "mid exposure of the left camera"),
        ("q", truth.q, pose, "pose at time, world frame = table"),
        ("qdot", truth.qdot, "m/s, rad/s", "rates of q at time"),
        ("q_right", truth.q_right, pose, "pose at the right camera's mid exposure"),
        ("markers_px", truth.markers_px, "px", "images of the dots' own centres (frame, camera, marker, xy)"),
        ("disc/marker_centres_body", disc.marker_centres_body, "m", "true centres of the dots"),
        ("board/R_world_board", truth.R_world_board, "1", "orientation of the board in the calibration views"),
        ("board/t_world_board", truth.t_world_board, "m", "lower left inner corner in the calibration views"),
    )
    with h5py.File(path, "w") as file:
        file.attrs["schema"], file.attrs["schema_version"] = "disctrack truth", 3
        file.attrs["scene"] = scene_toml(scene)  # renders the same recording again
        file.attrs["frame_rate_hz"] = truth.frame_rate
        for place, values, units, text in datasets:
            data = file.create_dataset(place, data=values, compression="gzip" if values.size > 1000 else None)
            data.attrs["units"], data.attrs["description"] = units, text
        sizes = ("radius", "half_thickness", "mass", "marker_diameter")
        file["disc"].attrs.update({name: getattr(disc, name) for name in sizes})
        for name in ("rig", "rig_while_filming"):
            write_rig_group(file.create_group(name), getattr(truth, name))
        file.create_group("effects").attrs.update(truth.effects)
