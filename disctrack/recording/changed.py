"""What differs between the declaration that a result was measured with and the recording.toml that lies there now."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from disctrack.errors import RecordingError
from disctrack.files.toml_tree import read_toml
from disctrack.recording.declaration import FILE_NAME

MOST = 5  # differences that are told one by one


def changed_since(folder: Path, measured: Mapping[str, object]) -> str:
    """Keys of the folder's recording.toml whose values are no longer those declared when it was measured.

    measured : the tree of the declaration that the trajectory file keeps
    returns  : "[calibration] square_mm 6.1 (6.0 when it was measured)", several by commas; empty where all is the
        same, or where there is no declaration that can be read
    """
    try:
        now = json.loads(json.dumps(read_toml(folder / FILE_NAME, RecordingError), default=str))
    except (OSError, RecordingError):
        return ""
    return told_differences(now, measured)


def told_differences(now: Mapping[str, object], then: Mapping[str, object]) -> str:
    """Two declarations key by key, in words; empty where they say the same."""
    found = list(_differences(now, then))
    more = [f"and {len(found) - MOST} more"] if len(found) > MOST else []
    return ", ".join([*found[:MOST], *more])


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
