"""Effect of undeclared faults on a measurement, and their detection.

Faults are planted at three sizes, from just visible to gross, into different recordings. Faults of the catalogue are
rendered into the images of a scene; for a filmed recording, the rig and the declaration are changed instead. Faults of
files and of declared numbers are planted into both. Each recording is then processed by `disctrack run` in a process of
its own. Its poses are compared with the truth, or with those without the fault.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from json import JSONDecodeError, loads
from pathlib import Path
from typing import Any
from warnings import catch_warnings

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from calibration.rig_file import read_rig, write_rig
from disctrack.disc import Disc
from disctrack.errors import DiscTrackError
from disctrack.faults.catalogue import HEIGHT, MOVED, TYPICAL_STEPS, Fault, faults_of, scene_faults
from disctrack.faults.dots import cameras_with, centres_with
from disctrack.faults.keys import Faults
from disctrack.files.toml_tree import toml_value
from disctrack.findings import DoubtWarning, Finding, Kind, Severity, finding_from_json
from disctrack.frames import CAMERAS
from disctrack.recording.declaration import Recording, read_recording
from disctrack.synthetic.description import CameraSettings, Scene
from disctrack.synthetic.recording import write_recording
from disctrack.trajectory import Trajectory
from disctrack.trajectory.file import read_trajectory
from disctrack.validate.errors import compare
from disctrack.validate.rendered import rolling_scene, scene_of
from disctrack.validate.tables import Validation, table

PAIRS = 100  # the minimum for a test of gravity and frame rate
THETA_DEG = 9.0  # nutation of the scene
SIZES = (0.1, 1.0, 10.0)  # times an ordinary size: just visible, ordinary, gross
MOST_SIGMAS = 5.0  # noise alone reaches 4.1 in six components of a hundred poses
Tree = dict[str, Any]  # content of a recording.toml
# Arguments: a copy of a recording, its declaration, which is written afterwards, and the size; returns the true poses
# if they differ
Change = Callable[[Path, Tree, float], Array | None]


@dataclass(frozen=True)
class Ground:
    """A recording without faults, processed."""

    recording: Path  # its folder
    scene: Scene | None  # None if it was filmed
    q: Array  # (n, 6) by frame: true or measured


FaultCase = tuple[Ground, str, float]  # a recording, a fault, its size


@dataclass(frozen=True)
class Planting:
    """A way to plant a fault."""

    sizes: Sequence[float]
    unit: str
    change: Change
    named_by: tuple[Kind, ...]
    of_views: bool = False  # the recording is calibrated again with its own views


@dataclass(frozen=True)
class FaultOutcome:
    """Outcome of a planted fault."""

    make: str
    fault: str
    size: float
    unit: str
    worst: float  # largest error of a pose in its stated sigmas; 0 without a pose
    told: str  # the finding that names the fault; in brackets if it names another one
    named: bool
    code: int  # exit code


def untouched(folder: Path, recordings: Sequence[Path], seed: int = 29) -> Iterator[Ground]:
    """A rendered recording, and the first pairs of each of these recordings, processed without any fault."""
    scene = rolling_scene(scene_of(seed, quick=True), "rendered", THETA_DEG, PAIRS, np.random.default_rng([seed, 34]))
    scene = scene.changed(cameras={"exposure_s": CameraSettings().exposure_s})
    yield _ground(folder / scene.name, scene, write_recording(folder / scene.name, scene).q)
    for path in recordings:
        yield _ground(_first_pairs(read_recording(path), folder), None, None)


def _ground(folder: Path, scene: Scene | None, q: Array | None) -> Ground:
    code, findings, trajectory = _run(folder)
    if code or trajectory is None:
        raise DiscTrackError(f"{folder.name}: something is wrong before anything is planted: {_said(findings)}")
    return Ground(folder, scene, trajectory.q if q is None else q)


def _first_pairs(recording: Recording, folder: Path) -> Path:
    """Copy the first pairs and the views of a recording into a folder of its name, renumbered; returns the folder."""
    folder, tree = folder / recording.name, deepcopy(dict(recording.declared))
    for section, place, most in (("cameras", "", PAIRS), ("calibration", "calibration/", None)):
        for camera in CAMERAS:
            files = sorted(recording.folder.glob(tree[section][camera]))[:most]
            tree[section][camera] = f"{place}{camera}/*{files[0].suffix}"
            (folder / place / camera).mkdir(parents=True)
            for number, file in enumerate(files):
                shutil.copy(file, folder / place / camera / f"{number:06d}{file.suffix}")
    declare(folder, tree)
    return folder


def fault_cases(grounds: Sequence[Ground]) -> list[FaultCase]:
    """Every fault with all its sizes in each recording."""
    return [(ground, name, size) for ground in grounds for name, p in plantings(ground).items() for size in p.sizes]


def plant_and_run(case: FaultCase) -> FaultOutcome:
    """Plant, run, compare; all files are removed."""
    ground, fault, size = case
    planting = plantings(ground)[fault]
    folder = ground.recording.with_name(f"{ground.recording.name} {fault} {size:g}")
    try:
        shutil.copytree(ground.recording, folder, ignore=shutil.ignore_patterns("results"))
        tree = dict(read_recording(folder).declared)
        if not planting.of_views:
            tree["calibration"] = {"rig": str(ground.recording / "results" / "rig.h5")}
        q = planting.change(folder, tree, size)
        declare(folder, tree)
        code, findings, trajectory = _run(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    worst = _in_sigmas(trajectory, ground.q if q is None else q)
    naming = [f for f in findings if f.kind in planting.named_by]
    told = _said(naming) if naming else f"({_said(findings)})" if findings else ""
    return FaultOutcome(ground.recording.name, fault, size, planting.unit, worst, told, bool(naming), code)


def _run(folder: Path) -> tuple[int, list[Finding], Trajectory | None]:
    """Exit code, findings and poses of `disctrack run`; the reason of a refusal is a finding, too."""
    words = ["run", str(folder), "--json", "--no-figures", "--no-video", "--overwrite"]
    ended = subprocess.run([sys.executable, "-m", "disctrack", *words], capture_output=True, text=True, check=False)
    try:
        found = [finding_from_json(finding) for finding in loads(ended.stdout)["findings"]]
    except JSONDecodeError:
        why = ended.stderr.strip()[-300:].replace(f"{folder.parent}{os.sep}", "")
        return ended.returncode, [Finding(Kind.OTHER, Severity.REFUSAL, why)], None
    with catch_warnings(action="ignore", category=DoubtWarning):
        return ended.returncode, found, read_trajectory(folder / "results" / "trajectory.h5")


def _said(findings: Sequence[Finding]) -> str:
    """The most severe finding, shortened."""
    return "".join(f"{f.kind.value}, {f.grave}: {f.text}"[:160].replace("\n", " ") for f in findings[:1])


def _in_sigmas(trajectory: Trajectory | None, q: Array) -> float:
    """Largest error of a pose in its stated sigmas."""
    if trajectory is None or not trajectory.measured.any():
        return 0.0
    error = compare(trajectory, q[np.minimum(trajectory.frame, len(q) - 1)])
    variance = np.diagonal(error.covariance + error.calibration_covariance, axis1=1, axis2=2)
    return float(np.abs(error.error / np.sqrt(variance))[error.found].max())


def plantings(ground: Ground) -> dict[str, Planting]:
    """All faults that can be planted into such a recording, by name; of those of a camera or a dot, only one."""
    scene, recording, found = ground.scene, read_recording(ground.recording), {}
    others = "right" if scene is None else "left"
    for fault in faults_of(recording.disc):
        alike = fault.name.startswith((others, "misprint")) and fault.name != "misprint_0"
        declarable = not fault.in_images and fault.key != "right_delay_s"  # equivalent to a wrong declaration
        if not fault.named_by or alike or (scene is None and not declarable):
            continue
        change: Change = partial(_rendered, fault, scene) if scene else partial(_declared_wrong, fault, recording.disc)
        sizes = [TYPICAL_STEPS * fault.step * size for size in SIZES]
        if fault.in_images:  # the square of an exposure, which is shorter than the period
            sizes = [size for size in sizes if size * recording.frame_rate**2 < 1]
        found[fault.name] = Planting(sizes, fault.unit, change, fault.named_by)
    return found | CHANGES


def _with(fault: Fault, size: float, disc: Disc, rate: float = 1.0) -> Faults:
    """The fault alone, with equal numbers; rate : declared [Hz]."""
    values = dict.fromkeys(fault.names(), size / np.sqrt(len(fault.parts)))
    return scene_faults(disc, values, rate)


def _rendered(fault: Fault, scene: Scene, folder: Path, tree: Tree, size: float) -> Array:
    wrong = _with(fault, size, scene.declared_disc, scene.cameras.frame_rate_hz)
    shutil.rmtree(folder)
    return write_recording(folder, scene.changed(faults=wrong, board={"n_views": 1})).q


def _declared_wrong(fault: Fault, disc: Disc, folder: Path, tree: Tree, size: float) -> None:
    """Change the declaration and the rig so that the unchanged images have the fault."""
    rig, wrong = read_rig(tree["calibration"]["rig"]), _with(fault, -size, disc)
    tree["markers"]["centres_mm"] = (1e3 * centres_with(wrong, disc)[:, :2]).tolist()
    tree["disc"]["thickness_mm"] = 2e3 * float(disc.half_thickness + 1e-3 * wrong.pattern_height_mm)
    tree["cameras"]["frame_rate_hz"] *= wrong.frame_rate_hz or 1.0
    tree["calibration"]["rig"] = str(folder / "rig.h5")
    write_rig(folder / "rig.h5", cameras_with(wrong, rig))


def declare(folder: Path, tree: Tree) -> None:
    """Write the recording.toml of a folder."""
    lines = [f"{name} = {toml_value(value)}\n" for name, value in tree.items()]
    (folder / "recording.toml").write_text("".join(lines), encoding="utf-8")


def reordered(folder: Path, change: Callable[[list[bytes]], Iterable[bytes]]) -> None:
    """Reorder, remove, repeat or change the files of a folder, and renumber them."""
    files = sorted(folder.iterdir())
    contents = [file.read_bytes() for file in files]
    for file in files:
        file.unlink()  # it may be a link to a file of another recording
    for number, content in enumerate(change(contents)):
        (folder / f"{number:06d}{files[0].suffix}").write_bytes(content)


def redrawn(folder: Path, change: Callable[[NDArray, float], NDArray]) -> None:
    """Change images; the second argument of `change` is the share of the recording before the image."""
    files = sorted(folder.iterdir())
    for number, file in enumerate(files):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert image is not None
        file.unlink()  # it may be a link to a file of another recording
        cv2.imwrite(str(file), change(image, number / len(files)))


def _files(**orders: Callable[[list[bytes], int], list[bytes]]) -> Change:
    """Change of the files of folders; orders : by folder, a function of the files and the size."""

    def change(folder: Path, tree: Tree, size: float) -> None:
        for name, order in orders.items():
            reordered(folder / name, lambda files, order=order: order(files, int(size)))  # type: ignore[misc]

    return change


def _lost(files: list[bytes], k: int) -> list[bytes]:
    """Remove k files in the middle."""
    return files[: len(files) // 2] + files[len(files) // 2 + k :]


def _repeated_image(files: list[bytes], k: int) -> list[bytes]:
    """Replace k files in the middle by copies of the one before."""
    middle = len(files) // 2
    return files[:middle] + k * [files[middle - 1]] + files[middle + k :]


def _last_lost(files: list[bytes], k: int) -> list[bytes]:
    """Remove the last k files, so that both cameras have the same number."""
    return files[:-k]


def _damaged(files: list[bytes], k: int) -> list[bytes]:
    """Truncate the last k files."""
    return files[:-k] + [file[: len(file) // 2] for file in files[-k:]]


def _exchanged(folder: Path, tree: Tree, size: float) -> None:
    tree["cameras"] |= dict(zip(CAMERAS, [tree["cameras"][camera] for camera in CAMERAS[::-1]], strict=True))


def _images(
    change: Callable[[NDArray, float], NDArray], *folders: str, course: Callable[[float], float] = lambda share: 1.0
) -> Change:
    """Change of all images of folders; course : factor on the size, from the share of the recording before an image."""

    def of_all(folder: Path, tree: Tree, size: float) -> None:
        for name in folders:
            redrawn(folder / name, lambda image, share: change(image, size * course(share)))

    return of_all


def _shifted(image: NDArray, by: float) -> NDArray:
    """Shift an image along x and y [px]."""
    move = np.array([[1.0, 0.0, by], [0.0, 1.0, by]])
    shape = image.shape[::-1]
    moved = cv2.warpAffine(image, move, shape, flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    return moved if by else image


def _with_glare(image: NDArray, size: float) -> NDArray:
    """Add the reflection of a lamp with a maximum of `size` grey values of 8 bits."""
    height, width = image.shape
    y, x = np.mgrid[:height, :width]
    spot = np.exp(-8.0 * ((x / width - 0.6) ** 2 + (y / height - 0.5) ** 2))
    most = np.iinfo(image.dtype).max
    return np.clip(np.rint(image + size / 255 * most * spot), 0, most).astype(image.dtype)


def _wrong(section: str, key: str, *kinds: Kind) -> Planting:
    """A wrong declared number, with relative errors as sizes and the default tolerances."""

    def change(folder: Path, tree: Tree, size: float) -> None:
        for part in (tree["disc"], tree.get("table", {}), tree["calibration"]):
            for tolerance in [name for name in part if "_tolerance_" in name]:
                del part[tolerance]
        tree[section][key] *= 1 + size

    of_views = section == "calibration"
    return Planting((1e-3, 1e-2, 1e-1) if of_views else (3e-3, 3e-2, 3e-1), "1", change, kinds, of_views)


_LOST = (Kind.DROPPED_FRAMES, Kind.DELAY, Kind.ONE_SIDED)
_REPEATED = (Kind.REPEATED_IMAGES,)
_of_views = partial(Planting, named_by=(Kind.CALIBRATION,), of_views=True)
_VIEWS = ("calibration/left", "calibration/right")
CHANGES = {
    "pairs lost by both": Planting((1, 3, 10), "pairs", _files(left=_lost, right=_lost), (Kind.CLOCK_JUMP,)),
    "images lost by one": Planting((1, 3, 10, 20), "images", _files(left=_last_lost, right=_lost), _LOST),
    "pairs repeated": Planting((1, 3, 10), "pairs", _files(left=_repeated_image, right=_repeated_image), _REPEATED),
    "images repeated by one": Planting((1, 3, 10), "images", _files(right=_repeated_image), _REPEATED),
    "files damaged": Planting((1, 5, 50), "files", _files(right=_damaged), (Kind.UNREADABLE,)),
    "glare": Planting((3, 30, 300), "grey values", _images(_with_glare, "right"), (Kind.LIGHT, Kind.ONE_SIDED, *MOVED)),
    "camera knocked": Planting((0.02, 0.2, 2.0), "px", _images(_shifted, "right", course=round), MOVED),
    "camera drifts": Planting((0.03, 0.3, 3.0), "px", _images(_shifted, "right", course=float), MOVED),
    "reversed": Planting((1,), "", _files(**dict.fromkeys(CAMERAS, lambda files, k: files[::-1])), (Kind.REVERSED,)),
    "exchanged": Planting((1,), "", _exchanged, (Kind.EXCHANGED,)),
    "mirrored": Planting((1,), "", _images(lambda image, _: cv2.flip(image, 1), "right"), (Kind.MIRRORED,)),
    "radius": _wrong("disc", "radius_mm", Kind.RADIUS, *HEIGHT),
    "thickness": _wrong("disc", "thickness_mm", *HEIGHT),
    "dot diameter": _wrong("markers", "diameter_mm", Kind.DIAMETER),
    "gravity": _wrong("gravity", "g_m_s2", Kind.GRAVITY_OR_RATE),
    "square": _wrong("calibration", "square_mm", Kind.SQUARE),
    "negative views": _of_views((1,), "", _images(lambda image, _: cv2.bitwise_not(image), *_VIEWS)),
    "repeated views": _of_views((2, 3, 6), "times", _files(**dict.fromkeys(_VIEWS, lambda files, k: k * files))),
    "views late in one": _of_views(
        (1, 2, 4), "views", _files(**{_VIEWS[0]: _last_lost, _VIEWS[1]: lambda files, k: files[k:]})
    ),
}


def complaints(outcomes: Iterable[FaultOutcome]) -> Iterator[str]:
    """Failures of the validation."""
    for o in outcomes:
        where = f"{o.make}: {o.fault} of {o.size:.3g} {o.unit}"
        if o.code not in (0, 1, 3):
            yield f"{where}: exit code {o.code}"
        elif o.worst > MOST_SIGMAS and not o.named:
            yield f"{where}: {o.worst:.1f} sigma off, and not named ({o.told})"


def faults_validation(outcomes: Sequence[FaultOutcome]) -> Validation:
    """Smallest size of each fault that is named in each recording, and failures."""
    off = [o for o in outcomes if o.worst > MOST_SIGMAS]
    headline = (
        f"Of {len(outcomes)} planted faults {len(off)} move a pose by more than {MOST_SIGMAS:g} stated sigmas; "
        f"{sum(o.named for o in off)} of these are named."
    )
    return Validation("faults", headline, [_limits(outcomes)], outcomes, [*complaints(outcomes)])


def _limits(outcomes: Sequence[FaultOutcome]) -> str:
    """One row per fault; those of the left and the right camera are one fault."""
    makes = list(dict.fromkeys(o.make for o in outcomes))
    groups: dict[tuple[str, str], list[FaultOutcome]] = {}
    for o in outcomes:
        fault = o.fault.removeprefix("left_").removeprefix("right_").replace("_", " ")
        groups.setdefault((fault, o.unit or "-"), []).append(o)
    rows = []
    for fault_and_unit, of_fault in groups.items():
        row: list[object] = [*fault_and_unit]
        for make in makes:
            planted = [o for o in of_fault if o.make == make]
            unnamed = [o for o in planted if not o.named]
            named = [o.size for o in planted if all(o.size > other.size for other in unnamed)]
            row += [min(named, default=np.nan), max((o.worst for o in unnamed), default=np.nan)]
        rows.append(row)
    head = ["fault", "unit", *(f"{make}: {what}" for make in makes for what in ("named from", "unnamed, sigma"))]
    note = "Named at this size and at all larger ones that were planted. Unnamed: the largest error of a pose in its "
    return table("Detection limits", head, rows, note + "stated sigmas that nothing named.")
