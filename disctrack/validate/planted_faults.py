"""Effect of undeclared faults on a measurement, and their detection.

Faults are planted at three sizes, from just visible to gross, into different recordings. Faults of the catalogue are
rendered into the images of a scene; for a filmed recording, the rig and the declaration are changed instead. Faults of
files and of declared numbers are planted into both. Each recording is then processed by `disctrack run` in a process of
its own. Its poses are compared with the truth, or with those without the fault.
"""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from json import JSONDecodeError, loads
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from warnings import catch_warnings

import cv2
import numpy as np

from calibration.kit.types import AnyArray, Array
from calibration.rig_file import read_rig, write_rig
from disctrack.errors import DiscTrackError
from disctrack.faults.catalogue import FAULTS, HEIGHT, MOVED, TYPICAL_STEPS, Fault, each_of
from disctrack.faults.dots import cameras_with, centres_with
from disctrack.faults.keys import Faults
from disctrack.files.toml_tree import toml_value
from disctrack.findings import DoubtWarning, Finding, Kind, Severity, finding_from_json
from disctrack.frames import CAMERAS
from disctrack.recording.declaration import Recording, read_recording
from disctrack.synthetic.description import CameraSettings, Scene
from disctrack.synthetic.recording import run_render
from disctrack.trajectory import Trajectory
from disctrack.trajectory.file import read_trajectory
from disctrack.validate.rendered import compare, reordered, rolling_scene, scene_of
from disctrack.validate.tables import Validation, grouped, table

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
    yield _ground(folder / scene.name, scene, run_render(scene, folder / scene.name).q)
    for path in recordings:
        yield _ground(_first_pairs(read_recording(path), folder), None, None)


def _ground(folder: Path, scene: Scene | None, q: Array | None) -> Ground:
    code, findings, trajectory = _run(folder)
    if code or trajectory is None:
        raise DiscTrackError(f"{folder.name}: something is wrong before anything is planted: {_said(findings)}")
    return Ground(folder, scene, trajectory.q if q is None else q)


def _first_pairs(recording: Recording, folder: Path) -> Path:
    """Copy the first pairs and the views of a recording into a folder of its name, renumbered; returns the folder."""
    folder, tree = folder / recording.name, dict(recording.declared)
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
    with TemporaryDirectory(dir=ground.recording.parent) as place:
        folder = Path(place, fault)
        shutil.copytree(ground.recording, folder, ignore=shutil.ignore_patterns("results"))
        tree = dict(read_recording(folder).declared)
        if not planting.of_views:
            tree["calibration"] = {"rig": str(ground.recording / "results" / "rig.h5")}
        q = planting.change(folder, tree, size)
        declare(folder, tree)
        code, findings, trajectory = _run(folder)
    worst = 0.0 if trajectory is None else _in_sigmas(trajectory, ground.q if q is None else q)
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
        why = ended.stderr.strip()[-300:].replace(str(folder), folder.name)
        return ended.returncode, [Finding(Kind.OTHER, Severity.REFUSAL, why)], None
    with catch_warnings(action="ignore", category=DoubtWarning):
        return ended.returncode, found, read_trajectory(folder / "results" / "trajectory.h5")


def _said(findings: Sequence[Finding]) -> str:
    """The most severe finding, shortened."""
    return "".join(f"{f.kind.value}, {f.grave}: {f.text}"[:160].replace("\n", " ") for f in findings[:1])


def _in_sigmas(trajectory: Trajectory, q: Array) -> float:
    """Largest error of a pose in its stated sigmas; 0 without a pose."""
    error = compare(trajectory, q[np.minimum(trajectory.frame, len(q) - 1)])
    variance = np.diagonal(error.covariance + error.calibration_covariance, axis1=1, axis2=2)
    return float(np.max(np.abs(error.error / np.sqrt(variance))[error.found], initial=0.0))


def plantings(ground: Ground) -> dict[str, Planting]:
    """All faults that can be planted into such a recording, by name; of those of each camera or dot, only one."""
    scene, recording, found = ground.scene, read_recording(ground.recording), {}
    for fault in FAULTS:
        one = [*each_of(fault, recording.disc.n_markers)][-1 if scene and fault.each == "camera" else 0]
        declarable = not fault.in_images and fault.key != "right_delay_s"  # equivalent to a wrong declaration
        if fault.named_by and (scene or declarable):
            change: Change = partial(_rendered, one, scene) if scene else partial(_declared_wrong, one)
            sizes = [TYPICAL_STEPS * fault.step * size for size in SIZES]
            if fault.in_images:  # the square of an exposure, which is shorter than the period
                sizes = [size for size in sizes if size * recording.frame_rate**2 < 1]
            found[fault.name] = Planting(sizes, fault.unit, change, fault.named_by)
    return found | CHANGES


def _with(fault: Fault, size: float, rate: float = 1.0) -> Faults:
    """The fault alone, with equal numbers; rate : declared [Hz]."""
    n = len(fault.parts)
    return fault.to_scene(Faults(), np.full(n, size / np.sqrt(n)), rate)


def _rendered(fault: Fault, scene: Scene, folder: Path, tree: Tree, size: float) -> Array:
    """Render the scene with the fault."""
    wrong = _with(fault, size, scene.cameras.frame_rate_hz)
    shutil.rmtree(folder)
    return run_render(scene.changed(faults=wrong, board={"n_views": 1}), folder).q


def _declared_wrong(fault: Fault, folder: Path, tree: Tree, size: float) -> None:
    """Change the declaration and the rig so that the unchanged images have the fault."""
    wrong, disc = _with(fault, -size), read_recording(folder).disc
    write_rig(folder / "rig.h5", cameras_with(wrong, read_rig(tree["calibration"]["rig"])))
    tree["markers"]["centres_mm"] = (1e3 * centres_with(wrong, disc)[:, :2]).tolist()
    tree["disc"]["thickness_mm"] = 2e3 * float(disc.half_thickness + 1e-3 * wrong.pattern_height_mm)
    tree["cameras"]["frame_rate_hz"] *= wrong.frame_rate_hz or 1.0
    tree["calibration"] = {"rig": str(folder / "rig.h5")}


def declare(folder: Path, tree: Tree) -> None:
    """Write the recording.toml of a folder."""
    lines = [f"{name} = {toml_value(value)}\n" for name, value in tree.items()]
    (folder / "recording.toml").write_text("".join(lines), encoding="utf-8")


def redrawn(files: list[bytes], change: Callable[[AnyArray, float], AnyArray]) -> Iterator[AnyArray]:
    """Changed images; the second argument of `change` is the share of the recording before the image."""
    for number, file in enumerate(files):
        image = np.asarray(cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED))
        yield change(image, number / len(files))


def _files(**orders: Callable[..., Iterable[bytes | AnyArray]]) -> Change:
    """Change of the files of folders; orders : by folder, a function of the files and the size."""

    def change(folder: Path, tree: Tree, size: float) -> None:
        for name, order in orders.items():
            reordered(folder / name, partial(order, size=size))

    return change


def _images(change: Callable[[float, AnyArray, float], AnyArray], *folders: str) -> Change:
    """Change of the images of folders; change : a function of the size, an image and the share before it."""
    return _files(**dict.fromkeys(folders, lambda files, size: redrawn(files, partial(change, size))))


def _lost(files: list[bytes], size: int, after: float = 0.5) -> list[bytes]:
    """Remove files behind this share of all: the first (0), some in the middle, or the last (1)."""
    first = min(int(after * len(files)), len(files) - size)
    return files[:first] + files[first + size :]


def _repeated(files: list[bytes], size: int) -> list[bytes]:
    """Replace files in the middle by copies of the one before."""
    middle = len(files) // 2
    return files[:middle] + size * [files[middle - 1]] + files[middle + size :]


def _damaged(files: list[bytes], size: int) -> list[bytes]:
    """Truncate the last files."""
    return files[:-size] + [file[: len(file) // 2] for file in files[-size:]]


def _exchanged(folder: Path, tree: Tree, size: float) -> None:
    tree["cameras"] |= dict(zip(CAMERAS, [tree["cameras"][camera] for camera in CAMERAS[::-1]], strict=True))


def _shifted(most: float, image: AnyArray, share: float) -> AnyArray:
    """Shift an image along x and y by this share of `most` [px]."""
    move, size = np.eye(2, 3), image.shape[::-1]
    move[:, 2] = share * most
    return cv2.warpAffine(image, move, size, flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)


def _knocked(most: float, image: AnyArray, share: float) -> AnyArray:
    """Shift the second half of the images."""
    return _shifted(most, image, round(share))


def _with_glare(size: float, image: AnyArray, share: float) -> AnyArray:
    """Add the reflection of a lamp with a maximum of `size` grey values of 8 bits."""
    height, width = image.shape
    y, x = np.mgrid[:height, :width]
    spot = np.exp(-8.0 * ((x / width - 0.6) ** 2 + (y / height - 0.5) ** 2))
    most = np.iinfo(image.dtype).max
    return np.clip(np.rint(image + size / 255 * most * spot), 0, most).astype(image.dtype)


def _wrong(section: str, key: str, *kinds: Kind, smallest: float = 3e-3) -> Planting:
    """A wrong declared number, with relative errors as sizes and the default tolerances."""

    def change(folder: Path, tree: Tree, size: float) -> None:
        for part in (tree["disc"], tree.get("table", {}), tree["calibration"]):
            for tolerance in [name for name in part if "_tolerance_" in name]:
                del part[tolerance]
        tree[section][key] *= 1 + size

    return Planting([smallest * size for size in (1, 10, 100)], "1", change, kinds, section == "calibration")


_first_lost, _last_lost = partial(_lost, after=0), partial(_lost, after=1)  # both cameras then have as many files
_LOST = (Kind.DROPPED_FRAMES, Kind.DELAY, Kind.ONE_SIDED)
_REPEATED = (Kind.REPEATED_IMAGES,)
_VIEWS = ("calibration/left", "calibration/right")
_of_views = partial(Planting, named_by=(Kind.CALIBRATION,), of_views=True)
CHANGES = {
    "pairs lost by both": Planting((1, 3, 10), "pairs", _files(left=_lost, right=_lost), (Kind.CLOCK_JUMP,)),
    "images lost by one": Planting((1, 3, 10, 20), "images", _files(left=_last_lost, right=_lost), _LOST),
    "pairs repeated": Planting((1, 3, 10), "pairs", _files(left=_repeated, right=_repeated), _REPEATED),
    "images repeated by one": Planting((1, 3, 10), "images", _files(right=_repeated), _REPEATED),
    "files damaged": Planting((1, 5, 50), "files", _files(right=_damaged), (Kind.UNREADABLE,)),
    "glare": Planting((3, 30, 300), "grey values", _images(_with_glare, "right"), (Kind.LIGHT, Kind.ONE_SIDED, *MOVED)),
    "camera knocked": Planting((0.02, 0.2, 2.0), "px", _images(_knocked, "right"), MOVED),
    "camera drifts": Planting((0.03, 0.3, 3.0), "px", _images(_shifted, "right"), MOVED),
    "reversed": Planting((1,), "", _files(**dict.fromkeys(CAMERAS, lambda files, size: files[::-1])), (Kind.REVERSED,)),
    "exchanged": Planting((1,), "", _exchanged, (Kind.EXCHANGED,)),
    "mirrored": Planting((1,), "", _images(lambda size, image, _: cv2.flip(image, 1), "right"), (Kind.MIRRORED,)),
    "radius": _wrong("disc", "radius_mm", Kind.RADIUS, *HEIGHT),
    "thickness": _wrong("disc", "thickness_mm", *HEIGHT),
    "dot diameter": _wrong("markers", "diameter_mm", Kind.DIAMETER),
    "gravity": _wrong("gravity", "g_m_s2", Kind.GRAVITY_OR_RATE),
    "square": _wrong("calibration", "square_mm", Kind.SQUARE, smallest=1e-3),
    "negative views": _of_views((1,), "", _images(lambda size, image, _: cv2.bitwise_not(image), *_VIEWS)),
    "repeated views": _of_views((2, 3, 6), "times", _files(**dict.fromkeys(_VIEWS, lambda files, size: size * files))),
    "views late in one": _of_views((1, 2, 4), "views", _files(**{_VIEWS[0]: _last_lost, _VIEWS[1]: _first_lost})),
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
    rows: dict[str, dict[str, float]] = {}
    for (fault, unit, make), planted in grouped(outcomes, lambda o: (o.fault, o.unit, o.make)).items():
        unnamed = [o for o in planted if not o.named]
        named = [o.size for o in planted if all(o.size > other.size for other in unnamed)]
        row = rows.setdefault(f"{fault.replace('_', ' ')} [{unit or '-'}]", {})
        row[f"{make}: named from"] = min(named, default=np.nan)
        row[f"{make}: unnamed, sigma"] = max((o.worst for o in unnamed), default=np.nan)
    note = "Named at this size and at all larger ones that were planted. Unnamed: the largest error of a pose in its "
    limits = table("Detection limits", "fault", rows, note + "stated sigmas that nothing named.")
    return Validation("faults", headline, [limits], outcomes, [*complaints(outcomes)])
