"""A recording on disk: a folder with `recording.toml`, read into frozen dataclasses in SI units."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from calibration.board.target import Board, CharucoBoard, Target
from calibration.judge.tolerances import BoardTolerances
from calibration.kit.brief import Outline
from disctrack.disc import AIR_DENSITY, STANDARD_PRESSURE, Disc, disc_from_mm
from disctrack.errors import CalibrationError, RecordingError
from disctrack.files.inputs import RECORDING_FILE, keep, why_not_regular
from disctrack.files.toml_tree import read_toml

FILE_NAME = RECORDING_FILE
_T = TypeVar("_T")

# Every key that a recording.toml may hold, in the order of the reference example.
KEYS: dict[str, tuple[str, ...]] = {
    "": ("name", "case", "surface"),
    "cameras": (
        *("frame_rate_hz", "left", "right", "exposure_us"),
        *("left_flat", "left_dark", "left_part", "right_flat", "right_dark", "right_part"),
    ),
    "disc": ("radius_mm", "thickness_mm", "mass_g", "radius_tolerance_mm", "thickness_tolerance_mm", "name"),
    "markers": ("diameter_mm", "centres_mm"),
    "calibration": (
        "left",
        "right",
        "target",
        "inner_corners",
        "square_mm",
        "squares",
        "marker_mm",
        "dictionary",
        "rig",
        "square_tolerance_mm",
        "flatness_tolerance_mm",
    ),
    "table": ("view", "board_thickness_mm", "from", "board_thickness_tolerance_mm"),
    "gravity": ("g_m_s2",),
    "air": ("pressure_hPa", "density_kg_m3"),
}

# What every number may be, both ends included, in the unit that its key names. Wide enough for a coin and for a mill
# stone, narrow enough that a wrong unit or a slip of the pen is told before it becomes a wrong answer.
RANGES: dict[str, tuple[float, float]] = {
    "frame_rate_hz": (0.1, 1e7),
    "exposure_us": (0, 1e7),
    "radius_mm": (0.1, 1e4),
    "thickness_mm": (0.001, 1e4),
    "mass_g": (0.001, 1e7),
    "radius_tolerance_mm": (0, 2),
    "thickness_tolerance_mm": (0, 2),
    "diameter_mm": (0.001, 1e3),
    "centres_mm": (-1e4, 1e4),
    "square_mm": (0.01, 1e4),
    "marker_mm": (0.01, 1e4),
    "square_tolerance_mm": (0, 2),
    "flatness_tolerance_mm": (0, 2),
    "view": (0, 1e5),
    "board_thickness_mm": (0, 1e3),
    "board_thickness_tolerance_mm": (0, 2),
    "g_m_s2": (0.001, 1e3),
    "pressure_hPa": (1e-9, 1e5),
    "density_kg_m3": (1e-9, 1e3),
}
MOST_DOTS = 100
MOST_CELLS = 100  # corners or squares along a side of a target
MOST_COLUMNS = 10**6  # [px] of an image

# What declares each kind of calibration target.
TARGET_KEYS: dict[str, tuple[str, ...]] = {
    "chessboard": ("inner_corners", "square_mm"),
    "charuco": ("squares", "square_mm", "marker_mm", "dictionary"),
}

# Keys that have a default, or belong to another target than a chessboard; a calibration is either views or a rig.
OPTIONAL = {
    ("air", "pressure_hPa"),
    ("air", "density_kg_m3"),
    ("cameras", "exposure_us"),
    *(("cameras", f"{camera}_{kind}") for camera in ("left", "right") for kind in ("flat", "dark", "part")),
    ("disc", "name"),
    ("calibration", "target"),
    *(("calibration", key) for keys in TARGET_KEYS.values() for key in keys if key not in TARGET_KEYS["chessboard"]),
    ("disc", "radius_tolerance_mm"),
    ("disc", "thickness_tolerance_mm"),
    ("calibration", "rig"),
    ("calibration", "square_tolerance_mm"),
    ("calibration", "flatness_tolerance_mm"),
    ("table", "board_thickness_tolerance_mm"),
    ("table", "from"),
}


@dataclass(frozen=True)
class CalibrationViews:
    """Synchronised views of a flat target."""

    left: str  # file pattern relative to the recording's folder
    right: str
    target: Target


class SensorImages(NamedTuple):
    """What shows the gain and the offset of a camera's pixels: file patterns, or folders of images to be averaged."""

    flat: str | None = None  # an evenly lit surface
    dark: str | None = None  # no light at all


@dataclass(frozen=True)
class TableView:
    """The view whose board lies flat on the table: it defines the lab frame."""

    view: int  # index among the calibration views
    board_thickness: float  # [m] the printed face lies at this height
    source: str = "both"  # what tells where the table is: "board", "disc" (where its rim rolls) or "both"


@dataclass(frozen=True, repr=False)
class Recording(Outline):
    """What recording.toml declares, in SI units; exactly one of `views` and `rig_file` is given."""

    folder: Path
    name: str
    frame_rate: float  # [Hz]
    exposure: float | None  # [s] of both cameras; None where it is not declared
    left: str  # file pattern, or one video file, relative to the folder
    right: str
    disc: Disc
    views: CalibrationViews | None
    table: TableView | None  # None only where a rig file brings the lab frame with it
    rig_file: Path | None
    gravity: float  # [m/s^2]
    board_tolerances: BoardTolerances
    declared: Mapping[str, Any]  # recording.toml as it was written, for the record kept with the results
    air_density: float = AIR_DENSITY  # [kg/m^3] round the disc
    sensors: tuple[SensorImages, SensorImages] = (SensorImages(), SensorImages())  # left, right
    # left, right: x, y of the upper left corner, width and height [px] where a camera's images are a part of the files'
    parts: tuple[tuple[int, int, int, int] | None, ...] = (None, None)

    @property
    def file(self) -> Path:
        """The recording.toml itself."""
        return self.folder / FILE_NAME

    @property
    def chessboard(self) -> Board | None:
        """The chessboard, if the calibration is from one."""
        return self.views.target if self.views is not None and isinstance(self.views.target, Board) else None


def read_recording(path: str | Path) -> Recording:
    """Recording from its folder (or from its recording.toml).

    Raises RecordingError that names the file, the key, what was found, what was expected and what to do.
    """
    file = _recording_file(Path(path))
    keep(file)
    declared = read_toml(file, RecordingError)
    _refuse_unknown_keys(file, declared)
    cameras, disc, markers = (_Section(file, declared, name) for name in ("cameras", "disc", "markers"))
    calibration = _Section(file, declared, "calibration")
    views, rig_file = _calibration_source(calibration)
    for label in ("case", "surface"):  # what repeats are grouped by; kept with the results in `declared`
        if label in declared:
            _Section(file, declared, "").get(label, _text)
    if "name" in declared.get("disc", {}):  # which disc it was, where sizes and mass do not tell; also kept there
        disc.get("name", _text)
    return Recording(
        folder=file.parent,
        name=_Section(file, declared, "").get("name", _text) if "name" in declared else file.parent.resolve().name,
        frame_rate=cameras.number("frame_rate_hz"),
        exposure=_exposure(cameras) if "exposure_us" in cameras else None,
        left=cameras.get("left", _pattern),
        right=cameras.get("right", _pattern),
        disc=_disc(disc, markers),
        views=views,
        table=_table(file, declared, required=rig_file is None),
        rig_file=rig_file,
        board_tolerances=_tolerances(file, declared),
        gravity=_Section(file, declared, "gravity").number("g_m_s2"),
        air_density=_air_density(_Section(file, declared, "air")) if "air" in declared else AIR_DENSITY,
        declared=declared,
        sensors=(_sensor(cameras, "left"), _sensor(cameras, "right")),
        parts=tuple(cameras.get(key, _part) if key in cameras else None for key in ("left_part", "right_part")),
    )


def _air_density(air: _Section) -> float:
    """[kg/m^3] as declared, or in proportion to the pressure at room temperature."""
    if "density_kg_m3" in air and "pressure_hPa" in air:
        raise air.error("has both pressure_hPa and density_kg_m3; expected one of them. Keep the one you measured.")
    if "density_kg_m3" in air:
        return float(air.number("density_kg_m3"))
    return AIR_DENSITY * (float(air.number("pressure_hPa")) / STANDARD_PRESSURE)


def _sensor(cameras: _Section, camera: str) -> SensorImages:
    flat, dark = (
        cameras.get(key, _pattern) if key in cameras else None for key in (f"{camera}_flat", f"{camera}_dark")
    )
    return SensorImages(flat, dark)


def _recording_file(path: Path) -> Path:
    try:
        if path.is_dir():
            path = path / FILE_NAME
        elif not path.exists() and path.name != FILE_NAME:
            raise RecordingError(f"{path}: no such folder. Give the folder that holds {FILE_NAME}.")
        if fault := why_not_regular(path):
            raise RecordingError(f"{path}: cannot be read: {fault}. Give a recording's folder.")
        if not path.is_file():
            raise RecordingError(f"{path}: not found. A recording is a folder with a {FILE_NAME} beside its images.")
    except (OSError, ValueError) as error:  # a name too long, or with a null character
        raise RecordingError(f"{path!s:.200}: not a usable path ({error}). Give a recording's folder.") from error
    return path


def _refuse_unknown_keys(file: Path, declared: Mapping[str, Any]) -> None:
    for key, value in declared.items():
        if key in KEYS and key != "":
            if not isinstance(value, dict):
                raise RecordingError(f"{file}: '{key}' is {_shown(value)}; expected a section [{key}].")
            for name in value:
                if name not in KEYS[key]:
                    raise RecordingError(f"{file}: unknown key '{name}' in [{key}]. {_nearest(name, key)}")
        elif key not in KEYS[""]:
            kind = "section" if isinstance(value, dict) else "key"
            raise RecordingError(f"{file}: unknown {kind} '{key}'. {_nearest(key, '', kind)}")


def _nearest(name: str, section: str, kind: str = "key") -> str:
    """What the writer probably meant: a name in the same section first, then anywhere."""
    here = list(KEYS[section]) if section else ([s for s in KEYS if s] if kind == "section" else list(KEYS[""]))
    close = difflib.get_close_matches(name, here, 1)
    if close:
        return f"Did you mean '{close[0]}'?"
    homes = {key: home for home, keys in KEYS.items() for key in keys if home}
    close = difflib.get_close_matches(name, homes, 1)
    if close:
        return f"Did you mean '{close[0]}' of [{homes[close[0]]}]?"
    return f"Known here: {', '.join(here)}."


def _missing(declared: Mapping[str, Any]) -> list[str]:
    """Keys without a default that sections which are there lack, so that one message names them all."""
    calibration = declared.get("calibration", {})
    target = calibration.get("target", "chessboard")
    needed = {
        section: [key for key in keys if (section, key) not in OPTIONAL] for section, keys in KEYS.items() if section
    }
    needed["calibration"] = ["left", "right", *TARGET_KEYS.get(str(target), ())] if "rig" not in calibration else []
    return [f"[{s}] {key}" for s, keys in needed.items() for key in keys if s in declared and key not in declared[s]]


class _Section:
    """One section of a recording.toml; `get` converts a value or says what is wrong with it."""

    def __init__(self, file: Path, declared: Mapping[str, Any], name: str) -> None:
        self.file, self.name = file, name
        if name and name not in declared:
            raise RecordingError(f"{file}: section [{name}] is missing; it holds {', '.join(KEYS[name])}.")
        self.values: Mapping[str, Any] = declared[name] if name else declared
        self.declared = declared

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def get(self, key: str, convert: Callable[[object], _T]) -> _T:
        where = f"[{self.name}] {key}" if self.name else key
        if key not in self.values:
            names = _missing(self.declared)
            names = names if where in names else [where, *names]
            said = "is missing. Add it" if len(names) == 1 else "are missing. Add them"
            raise RecordingError(f"{self.file}: {', '.join(names)} {said}: every length in mm, mass in g, time in s.")
        try:
            return convert(self.values[key])
        except _Unfit as error:
            raise RecordingError(f"{self.file}: {where} is {_shown(self.values[key])}; expected {error}.") from error

    def number(self, key: str) -> float:
        """The number at a key, within its range."""
        return float(self.get(key, lambda value: _number(value, *RANGES[key])))

    def error(self, message: str) -> RecordingError:
        return RecordingError(f"{self.file}: [{self.name}] {message}")


class _Unfit(Exception):
    """The text says what was expected instead."""


def _shown(value: object) -> str:
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # integers of thousands of digits, arrays in arrays in arrays
        text = type(value).__name__
    return text if len(text) <= 60 else text[:57] + "..."


def _number(value: object, least: float = -math.inf, most: float = math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise _Unfit(f"a number from {least:g} to {most:g}")
    return float(value)


def _index(value: object) -> int:
    if type(value) is not int or not 0 <= value <= RANGES["view"][1]:
        raise _Unfit(f"a whole number from 0 to {RANGES['view'][1]:g}")
    return value


def _text(value: object) -> str:
    if not isinstance(value, str) or not value.strip():
        raise _Unfit('text in quotes, e.g. "rec_a"')
    return value


def _pattern(value: object) -> str:
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        raise _Unfit('a file pattern in quotes, e.g. "left/*.png"')
    return value


def _whole_numbers(value: object, n: int, least: int, most: int) -> list[int]:
    """The value as a list of n whole numbers in a range; an empty list where it is anything else."""
    fits = isinstance(value, list) and len(value) == n and all(type(x) is int and least <= x <= most for x in value)
    return list(value) if fits and isinstance(value, list) else []


def _part(value: object) -> tuple[int, int, int, int]:
    x, y, width, height = _whole_numbers(value, 4, 0, MOST_COLUMNS) or [0, 0, 0, 0]
    if not (width and height):
        raise _Unfit(f"[x, y, width, height] in pixels up to {MOST_COLUMNS}, a width and a height above 0")
    return x, y, width, height


def _table_source(value: object) -> str:
    if value not in ("board", "disc", "both"):
        raise _Unfit('"board", "disc" or "both"')
    return str(value)


def _counts_of(what: str) -> Callable[[object], tuple[int, int]]:
    def convert(value: object) -> tuple[int, int]:
        numbers = _whole_numbers(value, 2, 1, MOST_CELLS)
        if not numbers:
            raise _Unfit(f"two whole numbers from 1 to {MOST_CELLS}, {what}, e.g. [9, 6]")
        return numbers[0], numbers[1]

    return convert


def _target_kind(value: object) -> str:
    if not isinstance(value, str) or value not in TARGET_KEYS:
        raise _Unfit("one of " + ", ".join(f'"{name}"' for name in TARGET_KEYS))
    return value


def _centres(value: object) -> list[list[float]]:
    least, most = RANGES["centres_mm"]
    try:
        if isinstance(value, list) and 3 <= len(value) <= MOST_DOTS:
            return [[_number(x, least, most), _number(y, least, most)] for x, y in value]
    except (_Unfit, TypeError, ValueError):  # not a number, not a list, not two of them
        pass
    raise _Unfit(
        f"a list of [x, y] pairs, at least 3 and at most {MOST_DOTS} of them, each number from {least:g} to {most:g}, "
        "e.g. [[26.0, 0.0], [13.0, 22.5], [-13.0, 22.5]]"
    )


def _exposure(cameras: _Section) -> float:
    exposure, interval = cameras.number("exposure_us") / 1e6, 1 / cameras.number("frame_rate_hz")
    if exposure > 1.001 * interval:
        raise cameras.error(
            f"exposure_us is {1e6 * exposure:g}, longer than a frame: {1e6 * interval:g} us at frame_rate_hz. "
            "It is in microseconds: 0.2 ms is 200."
        )
    return float(exposure)


def _disc(disc: _Section, markers: _Section) -> Disc:
    radius_mm = disc.number("radius_mm")
    diameter_mm = markers.number("diameter_mm")
    centres_mm = markers.get("centres_mm", _centres)
    for number, (x, y) in enumerate(centres_mm):
        if math.hypot(x, y) + diameter_mm / 2 > radius_mm:
            raise markers.error(
                f"centres_mm: dot {number} at ({x:g}, {y:g}) with diameter {diameter_mm:g} reaches over the disc's rim "
                f"(radius {radius_mm:g}). Centres are in mm from the disc's centre."
            )
        for other, (u, v) in enumerate(centres_mm[:number]):
            if math.hypot(x - u, y - v) < diameter_mm:
                raise markers.error(
                    f"centres_mm: dots {other} and {number} overlap: {math.hypot(x - u, y - v):g} mm apart with "
                    f"diameter {diameter_mm:g}. Give each dot once."
                )
    sizes = radius_mm, disc.number("thickness_mm"), disc.number("mass_g")
    tolerances = {key: disc.number(key) for key in ("radius_tolerance_mm", "thickness_tolerance_mm") if key in disc}
    return disc_from_mm(*sizes, centres_mm, diameter_mm, **tolerances)


def _calibration_source(section: _Section) -> tuple[CalibrationViews | None, Path | None]:
    kind = section.get("target", _target_kind) if "target" in section else "chessboard"
    of_targets = {key: [name for name, keys in TARGET_KEYS.items() if key in keys] for key in KEYS["calibration"]}
    for key, kinds in of_targets.items():
        if kinds and key in section and kind not in kinds and "rig" not in section:
            named = " or ".join(f'target = "{name}"' for name in kinds)
            raise section.error(f"{key} belongs to {named}; the target here is {kind}: {', '.join(TARGET_KEYS[kind])}.")
    views = [key for key in ("left", "right", *dict.fromkeys(sum(TARGET_KEYS.values(), ()))) if key in section]
    if "rig" in section:
        if views:
            raise section.error(f"has both rig and {', '.join(views)}. Keep the rig file, or the chessboard views.")
        return None, section.file.parent / section.get("rig", _pattern)
    return CalibrationViews(section.get("left", _pattern), section.get("right", _pattern), _target(section, kind)), None


def _target(section: _Section, kind: str) -> Target:
    """The target as declared. Raises RecordingError."""
    try:
        if kind == "chessboard":
            corners = section.get("inner_corners", _counts_of("inner corners along the long and the short side"))
            return Board(corners, section.number("square_mm") * 1e-3)
        squares = section.get("squares", _counts_of("columns and rows of squares, dark and light"))
        square, marker = (section.number(key) * 1e-3 for key in ("square_mm", "marker_mm"))
        return CharucoBoard(squares, square, marker, section.get("dictionary", _text))
    except CalibrationError as error:
        raise section.error(str(error)) from error


def _tolerances(file: Path, declared: Mapping[str, Any]) -> BoardTolerances:
    """What is not declared takes its default."""
    given: dict[str, float] = {}
    calibration = _Section(file, declared, "calibration")
    if "square_tolerance_mm" in calibration and "square_mm" in calibration:
        given["square"] = calibration.number("square_tolerance_mm") / calibration.number("square_mm")
    if "flatness_tolerance_mm" in calibration:
        given["flatness"] = calibration.number("flatness_tolerance_mm") * 1e-3
    if "board_thickness_tolerance_mm" in declared.get("table", {}):
        given["thickness"] = _Section(file, declared, "table").number("board_thickness_tolerance_mm") * 1e-3
    return BoardTolerances(**given)


def _table(file: Path, declared: Mapping[str, Any], required: bool) -> TableView | None:
    if "table" not in declared and not required:
        return None
    table = _Section(file, declared, "table")
    source = table.get("from", _table_source) if "from" in table else "both"
    return TableView(table.get("view", _index), table.number("board_thickness_mm") * 1e-3, source)
