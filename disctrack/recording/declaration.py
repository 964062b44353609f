"""A recording on disk: a folder with `recording.toml`, read into frozen dataclasses in SI units, written, compared."""

import difflib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from calibration.board.target import Board, CharucoBoard, Target
from calibration.judge.tolerances import BoardTolerances
from calibration.kit.brief import Brief
from calibration.kit.types import checked
from disctrack.disc import AIR_DENSITY, STANDARD_PRESSURE, Disc, disc_from_mm
from disctrack.errors import CalibrationError, RecordingError, told_as
from disctrack.files.toml_tree import read_toml, toml_value
from disctrack.files.whole import RECORDING_FILE, keep, why_not_regular
from disctrack.frames import CAMERAS
from disctrack.recording.readers.base import Parts

FILE_NAME = RECORDING_FILE
MOST = 100  # dots of a disc; corners or squares along a side of a target


class Key(NamedTuple):
    """Valid values of a key."""

    expected: str  # in words
    fits: Callable[[Any], bool]
    example: str = ""  # only of a key without a default, which is required if its section is there
    remark: str = ""  # comment in a generated declaration

    @property
    def needed(self) -> bool:
        """True if the key has no default."""
        return bool(self.example)

    def like(self, example: str, remark: str) -> "Key":
        """The same key with an example and a remark."""
        return self._replace(example=example, remark=remark)


def _in_range(value: object, least: float, most: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most


def _number(least: float, most: float) -> Key:
    return Key(f"a number from {least:g} to {most:g}", lambda value: _in_range(value, least, most))


def _whole(value: object, n: int, least: int, most: float) -> bool:
    """True for a list of n whole numbers in a range."""
    return isinstance(value, list) and len(value) == n and all(type(x) is int and least <= x <= most for x in value)


def _text(expected: str) -> Key:
    return Key(expected, lambda value: isinstance(value, str) and bool(value.strip()) and "\0" not in value)


def _one_of(*words: str) -> Key:
    quoted = [f'"{word}"' for word in words]
    return Key(f"{', '.join(quoted[:-1])} or {quoted[-1]}", lambda value: value in words)


def _counts(what: str) -> Key:
    return Key(f"two whole numbers from 1 to {MOST}, {what}, e.g. [9, 6]", lambda value: _whole(value, 2, 1, MOST))


def _are_centres(value: object) -> bool:
    return isinstance(value, list) and 3 <= len(value) <= MOST and all(map(_is_centre, value))


def _is_centre(dot: object) -> bool:
    return isinstance(dot, list) and len(dot) == 2 and all(_in_range(x, -_FARTHEST, _FARTHEST) for x in dot)


_FARTHEST = 1e4  # [mm] from the disc's centre
_THREE_DOTS = "[[26.0, 0.0], [13.0, 22.5], [-13.0, 22.5]]"
_LABEL = _text('text in quotes, e.g. "rec_a"')
_FILES = _text('a file pattern in quotes, e.g. "left/*.png"')
_TOLERANCE = _number(0, 2)
_PART = Key(
    "[x, y, width, height] in pixels, a width and a height above 0",
    lambda value: _whole(value, 4, 0, math.inf) and min(value[2:]) > 0,
)
_CORNERS = _counts("inner corners along the long and the short side")
_VIEW = Key("a whole number from 0 to 100000", lambda value: _whole([value], 1, 0, 100_000))
_CENTRES = Key(
    f"a list of [x, y] pairs, at least 3 and at most {MOST} of them, each number from {-_FARTHEST:g} to "
    f"{_FARTHEST:g}, e.g. {_THREE_DOTS}",
    _are_centres,
)

# Keys of the calibration views of each kind of target.
TARGET_KEYS: dict[str, tuple[str, ...]] = {
    "chessboard": ("left", "right", "inner_corners", "square_mm"),
    "charuco": ("left", "right", "squares", "square_mm", "marker_mm", "dictionary"),
}

# All keys of a recording.toml, in the order of the reference example. Ranges include a coin and a mill stone, but
# exclude many wrong units and typing errors.
# A calibration is either views or a rig; the keys of a target are needed if the views show that target.
KEYS: dict[str, dict[str, Key]] = {
    "": {"name": _LABEL, "case": _LABEL, "surface": _LABEL},
    "cameras": {
        "frame_rate_hz": _number(0.1, 1e7).like("1000.0", "frames per second of the cameras"),
        "left": _FILES.like('"left/*.png"', ""),
        "right": _FILES.like('"right/*.png"', ""),
        "exposure_us": _number(0, 1e7),
        "left_flat": _FILES,
        "left_dark": _FILES,
        "left_part": _PART,
        "right_flat": _FILES,
        "right_dark": _FILES,
        "right_part": _PART,
    },
    "disc": {
        "radius_mm": _number(0.1, 1e4).like("37.5", "caliper"),
        "thickness_mm": _number(0.001, 1e4).like("6.0", "caliper, with the paper"),
        "mass_g": _number(0.001, 1e7).like("209.69", "balance, with the paper"),
        "radius_tolerance_mm": _TOLERANCE,
        "thickness_tolerance_mm": _TOLERANCE,
        "name": _LABEL,
    },
    "markers": {
        "diameter_mm": _number(0.001, 1e3).like("7.0", "as printed"),
        "centres_mm": _CENTRES.like(_THREE_DOTS, "[x, y] of dots from the disc's centre"),
    },
    "calibration": {
        "left": _FILES.like('"calibration/left/*.png"', "views of a chessboard, 15 to 40 of them"),
        "right": _FILES.like('"calibration/right/*.png"', "the same views, in the same order"),
        "target": _one_of(*TARGET_KEYS),
        "inner_corners": _CORNERS.like("[9, 6]", "long side first; count them"),
        "square_mm": _number(0.01, 1e4).like("6.0", "side of a square, measured over many squares"),
        "squares": _counts("columns and rows of squares, dark and light"),
        "marker_mm": _number(0.01, 1e4),
        "dictionary": _LABEL,
        "rig": _FILES,
        "square_tolerance_mm": _TOLERANCE,
        "flatness_tolerance_mm": _TOLERANCE,
    },
    "table": {
        "view": _VIEW.like("0", "CHECK: in this view, counted from 0, the board lies flat on the table"),
        "board_thickness_mm": _number(0, 1e3).like("3.0", "height of the printed face above the table"),
        "from": _one_of("board", "disc", "both"),
        "board_thickness_tolerance_mm": _TOLERANCE,
    },
    "gravity": {"g_m_s2": _number(0.001, 1e3).like("9.81", "9.78 (equator) to 9.83")},
    "air": {"pressure_hPa": _number(1e-9, 1e5), "density_kg_m3": _number(1e-9, 1e3)},
}


@dataclass(frozen=True)
class CalibrationViews:
    """Synchronised views of a flat target."""

    left: str  # file pattern relative to the recording's folder
    right: str
    target: Target


@dataclass(frozen=True)
class TableView:
    """The view in which the board lies flat on the table: it defines the lab frame."""

    view: int  # index among the calibration views
    board_thickness: float  # [m] height of the printed face
    source: str = "both"  # the table's plane is determined from: "board", "disc" (path of its rim) or "both"


@dataclass(frozen=True, repr=False)
class Recording(Brief):
    """Content of recording.toml in SI units; exactly one of `views` and `rig_file` is given.

    >>> recording = read_recording("clip")
    >>> recording.frame_rate, recording.gravity
    (1000.0, 9.81)
    """

    read_by: ClassVar[str] = "disctrack.recording.declaration:read_recording"

    folder: Path
    name: str
    frame_rate: float  # [Hz]
    exposure: float | None  # [s] of both cameras; None if not declared
    left: str  # file pattern, or one video file, relative to the folder
    right: str
    disc: Disc
    views: CalibrationViews | None
    table: TableView | None  # None only if a rig file defines the lab frame
    rig_file: Path | None
    gravity: float  # [m/s^2]
    board_tolerances: BoardTolerances
    declared: Mapping[str, Any]  # unchanged content of recording.toml, which is stored with the results
    air_density: float = AIR_DENSITY  # [kg/m^3]
    # left, right: file patterns or folders of images to be averaged, for the flat field (evenly lit surface) and the
    # dark image (no light) of a camera
    sensors: tuple[tuple[str | None, str | None], ...] = ((None, None), (None, None))
    parts: Parts = (None, None)  # left, right: rectangle of the stored images that is a camera's image

    @property
    def file(self) -> Path:
        """The recording.toml itself."""
        return self.folder / FILE_NAME

    @property
    def chessboard(self) -> Board | None:
        """The chessboard, if the calibration is from one."""
        return self.views.target if self.views is not None and isinstance(self.views.target, Board) else None


@checked
def read_recording(path: str | Path) -> Recording:
    """Recording from its folder (or from its recording.toml).

    Raises RecordingError with the file, the key, the value, the expected value and a remedy.

        >>> read_recording("clip").disc.n_markers
        6
    """
    file = _recording_file(Path(path))
    keep(file)
    declared = read_toml(file, RecordingError)
    _refuse_odd(file, declared)
    _refuse_missing(file, declared)
    cameras, calibration = declared["cameras"], declared["calibration"]
    rate = float(cameras["frame_rate_hz"])
    exposure = float(cameras["exposure_us"]) / 1e6 if "exposure_us" in cameras else None
    if exposure is not None and exposure * rate > 1.001:
        said = f"exposure_us is {1e6 * exposure:g}, longer than a frame: {1e6 / rate:g} µs at frame_rate_hz"
        raise RecordingError(f"{file}: [cameras] {said}. It is in microseconds: 0.2 ms is 200.")
    _refuse_mixed_calibration(file, calibration)
    views, table = None, None
    if "rig" not in calibration:
        views = CalibrationViews(calibration["left"], calibration["right"], _target(file, calibration))
    if on_table := declared.get("table", {}):
        thickness = on_table["board_thickness_mm"] * 1e-3
        table = TableView(on_table["view"], thickness, on_table.get("from", "both"))
    return Recording(
        folder=file.parent,
        name=declared.get("name", file.parent.resolve().name),
        frame_rate=rate,
        exposure=exposure,
        left=cameras["left"],
        right=cameras["right"],
        disc=_disc(file, declared["disc"], declared["markers"]),
        views=views,
        table=table,
        rig_file=file.parent / calibration["rig"] if "rig" in calibration else None,
        board_tolerances=_tolerances(calibration, on_table),
        gravity=float(declared["gravity"]["g_m_s2"]),
        air_density=_air_density(file, declared.get("air", {})),
        declared=declared,
        sensors=tuple((cameras.get(f"{name}_flat"), cameras.get(f"{name}_dark")) for name in CAMERAS),
        parts=tuple(tuple(part) if (part := cameras.get(f"{name}_part")) else None for name in CAMERAS),
    )


def _air_density(file: Path, air: Mapping[str, float]) -> float:
    """[kg/m^3] as declared, or proportional to the declared pressure, at room temperature."""
    if "density_kg_m3" in air and "pressure_hPa" in air:
        raise RecordingError(f"{file}: [air] has both pressure_hPa and density_kg_m3. Keep the one you measured.")
    return float(air.get("density_kg_m3", AIR_DENSITY * air.get("pressure_hPa", STANDARD_PRESSURE) / STANDARD_PRESSURE))


def _recording_file(path: Path) -> Path:
    said = f"{path!s:.200}: not a usable path"  # e.g. a name that is too long, or contains a null character
    with told_as(RecordingError, said, OSError, ValueError, then="Give a recording's folder."):
        if path.name != FILE_NAME and not path.is_file():
            path = path / FILE_NAME
        if fault := why_not_regular(path):
            raise RecordingError(f"{path}: cannot be read: {fault}. Give a recording's folder.")
        if not path.is_file():
            raise RecordingError(f"{path}: not found. A recording is a folder with a {FILE_NAME} beside its images.")
    return path


def _refuse_odd(file: Path, declared: Mapping[str, Any]) -> None:
    """Raise RecordingError for an unknown key, and for an invalid value."""
    for key, value in declared.items():
        section, entries = (key, value) if key and key in KEYS else ("", {key: value})
        if not isinstance(entries, dict):
            raise RecordingError(f"{file}: '{key}' is {_shown(value)}; expected a section [{key}].")
        for name, given in entries.items():
            meant, place = KEYS[section].get(name), f"[{section}] " if section else ""
            if meant is None:
                kind = "section" if isinstance(given, dict) and not section else "key"
                within = f" in [{section}]" if section else ""
                raise RecordingError(f"{file}: unknown {kind} '{name}'{within}. {_nearest(name, section, kind)}")
            if not meant.fits(given):
                raise RecordingError(f"{file}: {place}{name} is {_shown(given)}; expected {meant.expected}.")


def _nearest(name: str, section: str, kind: str = "key") -> str:
    """Hint at the name that was probably meant, in the same section or in another."""
    here = list(KEYS[section]) if section or kind == "key" else [s for s in KEYS if s]
    known = {key: f" of [{home}]" for home, keys in KEYS.items() for key in keys if home} | dict.fromkeys(here, "")
    close = difflib.get_close_matches(name, known, 1)
    return f"Did you mean '{close[0]}'{known[close[0]]}?" if close else f"Known here: {', '.join(here)}."


def _refuse_missing(file: Path, declared: Mapping[str, Any]) -> None:
    """Raise RecordingError for a missing section, or with all missing keys that have no default."""
    needed = {section: [key for key, meant in keys.items() if meant.needed] for section, keys in KEYS.items()}
    kind, own = _calibrated_by(declared.get("calibration", {}))
    needed["calibration"] = list(own)
    for section, keys in needed.items():
        if keys and section not in declared and not (section == "table" and kind == "rig"):
            raise RecordingError(f"{file}: section [{section}] is missing; it holds {', '.join(KEYS[section])}.")
    names = [f"[{s}] {key}" for s, keys in needed.items() for key in keys if s in declared and key not in declared[s]]
    if names:
        said = "is missing. Add it" if len(names) == 1 else "are missing. Add them"
        raise RecordingError(f"{file}: {', '.join(names)} {said}: every length in mm, mass in g, time in s.")


def _shown(value: object) -> str:
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # integers of thousands of digits, deeply nested arrays
        text = type(value).__name__
    return text if len(text) <= 60 else text[:57] + "..."


def _disc(file: Path, disc: Mapping[str, Any], markers: Mapping[str, Any]) -> Disc:
    radius, diameter, centres = disc["radius_mm"], markers["diameter_mm"], markers["centres_mm"]
    for number, (x, y) in enumerate(centres):
        if math.hypot(x, y) + diameter / 2 > radius:
            said = f"dot {number} at ({x:g}, {y:g}) with diameter {diameter:g} reaches over the rim (radius {radius:g})"
            raise RecordingError(f"{file}: [markers] centres_mm: {said}. They are in mm from the disc's centre.")
        for other, (u, v) in enumerate(centres[:number]):
            if (apart := math.hypot(x - u, y - v)) < diameter:
                said = f"dots {other} and {number} overlap: {apart:g} mm apart with diameter {diameter:g}"
                raise RecordingError(f"{file}: [markers] centres_mm: {said}. Give each dot once.")
    tolerances = disc.get("radius_tolerance_mm"), disc.get("thickness_tolerance_mm")
    return disc_from_mm(radius, disc["thickness_mm"], disc["mass_g"], centres, diameter, *tolerances)


def _calibrated_by(calibration: Mapping[str, object]) -> tuple[str, tuple[str, ...]]:
    """Kind of a calibration, by a target of its views or by "rig", and the keys that it needs."""
    kind = "rig" if "rig" in calibration else str(calibration.get("target", "chessboard"))
    return kind, TARGET_KEYS.get(kind, ("rig",))


def _refuse_mixed_calibration(file: Path, calibration: Mapping[str, Any]) -> None:
    """Raise RecordingError for keys of another target, and for views in addition to a rig."""
    kind, own = _calibrated_by(calibration)
    if odd := [key for keys in TARGET_KEYS.values() for key in keys if key in calibration and key not in own]:
        both = f"both {own[-1 if kind == 'rig' else 2]} and {', '.join(dict.fromkeys(odd))}"
        remedy = f"By {kind}, it has {', '.join(own)}: keep one kind."
        raise RecordingError(f"{file}: [calibration] has {both}, of different kinds of calibration. {remedy}")


def _target(file: Path, calibration: Mapping[str, Any]) -> Target:
    """The target as declared. Raises RecordingError."""
    square = calibration["square_mm"] * 1e-3
    with told_as(RecordingError, f"{file}: [calibration]", CalibrationError):
        if "inner_corners" in calibration:
            return Board(tuple(calibration["inner_corners"]), square)
        marker = calibration["marker_mm"] * 1e-3
        return CharucoBoard(tuple(calibration["squares"]), square, marker, calibration["dictionary"])


def _tolerances(calibration: Mapping[str, float], table: Mapping[str, float]) -> BoardTolerances:
    """Tolerances, None if not declared; that of the squares is relative to their size, which a rig file lacks."""
    lengths = calibration.get("flatness_tolerance_mm"), table.get("board_thickness_tolerance_mm")
    flatness, thickness = (None if length is None else length * 1e-3 for length in lengths)
    square, side = calibration.get("square_tolerance_mm"), calibration.get("square_mm")
    return BoardTolerances(None if square is None or side is None else square / side, flatness, thickness)


# --- Its text, with remarks and with keys to fill in, and differences from another one ------------------------------

HEADINGS = {  # of sections
    "cameras": "frame i of the left and of the right must show the same instant",
    "markers": "round dots on the upper face, all of one size",
    "calibration": "synchronised views of a flat chessboard",
    "table": "the lab frame: k up from the table, which is z = 0",
}
# Sections whose optional keys are also valid for another recording of the same disc and board
ALIKE = ("disc", "calibration", "table")

Told = dict[tuple[str, str], tuple[Any, str]]  # (section, key) -> value, None if not known; and a remark


def declaration_text(
    name: str, told: Told, known: Mapping[str, float], example: Mapping[str, Any]
) -> tuple[str, tuple[str, ...]]:
    """Text of the recording.toml, and the keys that are missing.

    told : values of this recording;  known : values by key;  example : declaration with the same disc and board
    """
    lines = [
        "# Lengths in mm, masses in g, times in s. Every key: disctrack/docs/recording-toml.md",
        f"name = {toml_value(name)}",
    ]
    missing = []
    by_rig = {"calibration", "table"} if ("calibration", "rig") in told else set()  # sections replaced by a rig file
    for section in KEYS:
        if section in by_rig - {"calibration"} or not section:
            continue
        rows = []
        given = {} if section in by_rig else {**example.get(section, {}), **known}
        for key, meant in KEYS[section].items():
            alike = meant.needed or (section in ALIKE and key != "rig") or key == "exposure_us"
            value, source = told.get((section, key), (given.get(key) if alike else None, ""))
            if value is not None:
                rows.append(_aligned(f"{key} = {toml_value(value)}", source or meant.remark))
            elif meant.needed and section not in by_rig:
                missing.append(f"[{section}] {key}")
                rows.append(_aligned(f"# {key} = {meant.example}", f"FILL IN: {meant.remark}"))
        lines += ["", _aligned(f"[{section}]", HEADINGS.get(section, "")), *rows] if rows else []
    return "\n".join(lines) + "\n", tuple(missing)


def _aligned(text: str, remark: str) -> str:
    return f"{text:<31} # {remark}" if remark else text


def changed_since(folder: Path, measured: Mapping[str, object]) -> str:
    """Keys of the folder's recording.toml whose values have changed since the measurement.

    measured : declaration stored in the trajectory file; empty if there is none
    returns  : "[calibration] square_mm 6.1 (6.0 when it was measured)", separated by commas; empty if nothing has
        changed, if `measured` is empty, or if the file cannot be read
    """
    try:
        now = json.loads(json.dumps(read_toml(folder / FILE_NAME, RecordingError), default=str))
    except (OSError, RecordingError):
        return ""
    return ", ".join(_differences(now, measured)) if measured else ""


def _differences(now: Mapping[str, object], then: Mapping[str, object], section: str = "") -> Iterator[str]:
    for key in dict.fromkeys([*then, *now]):
        new, old = now.get(key), then.get(key)
        if isinstance(new, dict) or isinstance(old, dict):
            now_in, then_in = (item if isinstance(item, dict) else {} for item in (new, old))
            yield from _differences(now_in, then_in, f"[{key}] ")
        elif new != old:
            yield f"{section}{key} {_stated(new)} ({_stated(old)} when it was measured)"


def _stated(value: object) -> str:
    text = "not declared" if value is None else json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
