"""A whole recording on disk, as the pair of cameras would have written it, and the truth apart from it."""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Array32, Image
from disctrack.disc import AIR_DENSITY, Disc
from disctrack.errors import OutputError
from disctrack.files.toml_tree import toml_value
from disctrack.frames import CAMERAS
from disctrack.synthetic.cameras import board_poses, rig_after_faults, rig_of
from disctrack.synthetic.description import ImperfectionSettings, Scene, load_scene
from disctrack.synthetic.images import Stage, TrueDisc, expected_board_image, expected_disc_image, stages
from disctrack.synthetic.motion import SceneMotion, motion_of, true_exposure, true_frame_rate
from disctrack.synthetic.sensor import digitise
from disctrack.synthetic.truth import Truth, write_truth

Progress = Callable[[int, int], None]  # images done, images in all

TRUTH_NAME = "truth.h5"


@dataclass(frozen=True)
class _Image:
    """One file to be written."""

    path: Path
    expose: Callable[[], Image]


def write_recording(
    folder: str | Path,
    scene: Scene,
    motion: SceneMotion | None = None,
    *,
    truth_path: str | Path | None = None,
    progress: Progress | None = None,
) -> Truth:
    """Render `scene` into a new recording folder, and what is true of it into an HDF5 file.

    motion     : pose over time; None: as the scene's motion section says
    truth_path : None: truth.h5 in the folder; recording.toml does not name it, so that no reader finds it by that

    The folder appears under its name when all is written. Raises OutputError where it exists already or cannot be
    written, SceneError where the scene cannot be rendered.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder}: exists and is not an empty folder; choose another name or remove it")
    target = None if truth_path is None else Path(truth_path)
    if target is not None and target.exists():
        raise OutputError(f"{target}: exists; choose another name for the truth or remove it")
    motion = motion or motion_of(scene)
    truth = _truth(scene, motion, rig_of(scene))
    part = Path()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f"{folder.name}.", suffix=".part", dir=folder.parent))
        part.chmod(0o755)  # as any new folder, not the user's alone
        for name in ("left", "right", "calibration/left", "calibration/right"):
            (part / name).mkdir(parents=True)
        (part / "recording.toml").write_text(recording_toml(scene), encoding="utf-8")
        images = [*_board_images(part, scene, truth), *_disc_images(part, scene, motion, truth)]
        _write_all(images, scene, progress)
        if target is not None:
            target.parent.mkdir(parents=True, exist_ok=True)
        write_truth(target or part / TRUTH_NAME, truth, scene)
        if folder.exists():
            folder.rmdir()
        part.rename(folder)
    except OSError as error:
        raise OutputError(
            f"{folder}: the recording cannot be written ({error}); check the disk and the rights"
        ) from error
    finally:
        if part.name:
            shutil.rmtree(part, ignore_errors=True)
    return truth


def run_render(
    scene_path: str | Path, folder: str | Path, truth_path: str | Path | None = None, progress: Progress | None = None
) -> Truth:
    """`disctrack render SCENE.toml -o RECORDING`: load, render, write; errors as in load_scene and write_recording.

    >>> truth = run_render("scene.toml", "rendered")
    >>> len(truth.time)
    4
    """
    return write_recording(folder, load_scene(scene_path), truth_path=truth_path, progress=progress)


def true_disc_of(scene: Scene) -> TrueDisc:
    """The disc with its dots and paper where they really are."""
    declared, faults = scene.declared_disc, scene.faults
    centres = declared.marker_centres_body.copy()
    if faults.misprint_mm:
        centres[:, :2] += np.array(faults.misprint_mm) * 1e-3
    if faults.misprint_sigma_mm > 0:
        rng = np.random.default_rng([scene.seed, 6])
        centres[:, :2] += faults.misprint_sigma_mm * 1e-3 * rng.standard_normal((declared.n_markers, 2))
    c, s = np.cos(np.radians(faults.pattern_turn_deg)), np.sin(np.radians(faults.pattern_turn_deg))
    centres[:, :2] = faults.pattern_scale * centres[:, :2] @ np.array([[c, s], [-s, c]])
    centres += np.array([*faults.pattern_offset_mm, faults.pattern_height_mm]) * 1e-3
    x, y = faults.pattern_offset_mm
    disc = replace(declared, marker_centres_body=centres)
    return TrueDisc(disc, (x * 1e-3, y * 1e-3))


def _truth(scene: Scene, motion: SceneMotion, rig: StereoRig) -> Truth:
    n, rate, delay = motion.n_frames, true_frame_rate(scene), scene.faults.right_delay_s
    time = np.arange(n) / rate
    visible = np.ones(scene.declared_disc.n_markers, bool)
    visible[list(scene.faults.hidden_markers)] = False
    R, t = board_poses(scene, rig)
    true_disc = true_disc_of(scene)
    return Truth(
        time=time,
        q=motion.pose(time),
        qdot=motion.rates(time),
        q_right=motion.pose(time + delay) if scene.motion.kind != "static" else motion.pose(time),
        frame_rate=rate,
        rig=rig,
        rig_while_filming=rig_after_faults(rig, scene),
        disc=true_disc.disc,
        paper_centre_body=np.array(true_disc.paper_centre_body),
        markers_printed=visible,
        R_world_board=R,
        t_world_board=t,
        effects={} if motion.simulated is None else dict(motion.simulated.model.values),
    )


def _board_images(part: Path, scene: Scene, truth: Truth) -> Iterator[_Image]:
    for c, stage in enumerate(stages(truth.rig, scene)):
        for view, (R, t) in enumerate(zip(truth.R_world_board, truth.t_world_board, strict=True)):

            def expose(
                stage: Stage = stage, R: Array = R, t: Array = t, key: tuple[int, ...] = (scene.seed, 3, c, view)
            ) -> Image:
                return _digitise(expected_board_image(R, t, stage, scene), stage, scene, key)

            yield _Image(part / "calibration" / CAMERAS[c] / f"{view:02d}.png", expose)


def _disc_images(part: Path, scene: Scene, motion: SceneMotion, truth: Truth) -> Iterator[_Image]:
    true_disc = TrueDisc(truth.disc, (float(truth.paper_centre_body[0]), float(truth.paper_centre_body[1])))
    still = scene.motion.kind == "static"
    exposure = 0.0 if still else true_exposure(scene)
    for c, stage in enumerate(stages(truth.rig_while_filming, scene)):
        fault = (scene.faults.left, scene.faults.right)[c]
        delay = 0.0 if still or c == 0 else scene.faults.right_delay_s
        for i in sorted(set(range(len(truth.time))) - set(fault.missing_frames)):
            rods = [r for r in scene.faults.occluders if r.camera == stage.name and r.first_frame <= i <= r.last_frame]

            def expose(
                i: int = i, mid: float = truth.time[i] + delay, stage: Stage = stage, rods: list = rods, c: int = c
            ) -> Image:
                image = expected_disc_image(
                    lambda dt: motion.pose(mid + dt), exposure, stage, true_disc, scene, truth.markers_printed, rods
                )
                return _digitise(image, stage, scene, (scene.seed, 4, c, i))

            yield _Image(part / CAMERAS[c] / f"{i:06d}.png", expose)


def _digitise(image: Array32, stage: Stage, scene: Scene, key: tuple[int, ...]) -> Image:
    """Own noise for every image, so that neither order nor number of threads matters."""
    return digitise(image, scene.sensor, scene.cameras.bit_depth, np.random.default_rng(key), stage.hot)


def _write_all(images: list[_Image], scene: Scene, progress: Progress | None) -> None:
    # noisy pictures have no repeats worth searching for: run lengths give smaller files, sooner
    settings = [cv2.IMWRITE_PNG_COMPRESSION, scene.render.png_compression]
    settings += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]

    def write(image: _Image) -> None:
        if not cv2.imwrite(str(image.path), image.expose(), settings):
            raise OSError(f"{image.path} not written")

    with ThreadPoolExecutor(max_workers=max(scene.render.threads, 1)) as pool:
        for done, _ in enumerate(pool.map(write, images), start=1):
            if progress is not None:
                progress(done, len(images))


def _exact(length_mm: float) -> str:
    """With four decimals where these are all; as declared, the disc is exact."""
    short = f"{length_mm:.4f}"
    return short if float(short) == length_mm else toml_value(length_mm)


def recording_toml(scene: Scene) -> str:
    """What the experimenter declares: nothing of the scene's faults.

    A scene without imperfections is exact, and says so; with them, the tolerances are the usual ones.
    """
    disc: Disc = scene.declared_disc
    centres = ", ".join(f"[{_exact(x)}, {_exact(y)}]" for x, y in scene.markers.centres_mm)
    board, cameras = scene.board, scene.cameras
    text = f"""\
# A recording of a disc rolling on a table. Lengths in mm, masses in g, times in s.
name = {toml_value(scene.name)}

[cameras]                       # two synchronised cameras; frame i of the left and of the right belong together
frame_rate_hz = {cameras.frame_rate_hz!r}
left = "left/*.png"             # {cameras.image_size[0]} x {cameras.image_size[1]}, {cameras.bit_depth} bit
right = "right/*.png"

[disc]                          # a homogeneous steel disc with a sharp edge
radius_mm = {scene.disc.radius_mm!r}
thickness_mm = {scene.disc.thickness_mm!r}
mass_g = {scene.disc.mass_g!r}
radius_tolerance_mm = 0.0       # here, what is declared is exact
thickness_tolerance_mm = 0.0

[markers]                       # black dots on the white paper of the disc's upper face (z = +h)
diameter_mm = {scene.markers.diameter_mm!r}
centres_mm = [{centres}]        # {disc.n_markers} dots, body frame: origin at the disc's centre

[calibration]                   # synchronised views of a flat chessboard
left = "calibration/left/*.png"
right = "calibration/right/*.png"
inner_corners = [{board.inner_corners[0]}, {board.inner_corners[1]}]  # along the long side, along the short side
square_mm = {board.square_mm!r}
square_tolerance_mm = 0.0
flatness_tolerance_mm = 0.0

[table]                         # the lab frame: k up from the table, which is z = 0
view = 0                        # in this calibration view the board lies flat on the table
board_thickness_mm = {board.thickness_mm!r}        # its printed face is at that height
board_thickness_tolerance_mm = 0.0

[gravity]
g_m_s2 = {scene.gravity_m_s2!r}
"""
    if scene.air_density_kg_m3 != AIR_DENSITY:
        text += f"\n[air]\ndensity_kg_m3 = {scene.air_density_kg_m3!r}\n"
    if scene.imperfections == ImperfectionSettings():
        return text
    return "".join(line for line in text.splitlines(keepends=True) if "_tolerance_" not in line)
