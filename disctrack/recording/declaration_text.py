"""Text of a recording.toml with remarks and with keys to fill in; differences between two declarations."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from disctrack.errors import RecordingError
from disctrack.files.toml_tree import read_toml, toml_value
from disctrack.recording.declaration import FILE_NAME, KEYS

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
            yield f"{section}{key} {_shown(new)} ({_shown(old)} when it was measured)"


def _shown(value: object) -> str:
    text = "not declared" if value is None else json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
