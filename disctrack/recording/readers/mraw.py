"""Photron recordings: a header, .cih (text) or .cihx (XML), and an .mraw file of contiguous frames."""

import contextlib
import math
import re
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from disctrack.errors import RecordingError, told_as
from disctrack.files.whole import MOST_TEXT
from disctrack.recording.readers.base import CameraHeader, FrameReader, only_file, refuse_colour
from disctrack.recording.readers.files import content_of
from disctrack.recording.readers.raw import PixelLayout, RawFile, bit_depth_of, check_frame_size, raw_frames

# Entries that are used: name in the .cih, path below <cih> in the .cihx.
_ENTRIES = {
    "Camera Type": "deviceInfo/deviceName",
    "User Defined Camera Name": "basicInfo/cameraName",
    "Record Rate(fps)": "recordInfo/recordRate",
    "Shutter Speed(s)": "recordInfo/shutterSpeed",
    "Shutter Type2(nsec)": "recordInfo/shutterSpeedNsec",
    "Trigger Mode": "recordInfo/triggerMode/mode",
    "Total Frame": "frameInfo/totalFrame",
    "Original Total Frame": "frameInfo/recordedFrame",
    "Start Frame": "frameInfo/startFrame",
    "Save Step": "frameInfo/skipFrame",
    "Image Width": "imageDataInfo/resolution/width",
    "Image Height": "imageDataInfo/resolution/height",
    "Color Type": "imageDataInfo/colorInfo/type",
    "Color Bit": "imageDataInfo/colorInfo/bit",
    "File Format": "imageFileInfo/fileFormat",
    "EffectiveBit Depth": "imageDataInfo/effectiveBit/depth",
    "EffectiveBit Side": "imageDataInfo/effectiveBit/side",
    "Date": "fileInfo/date",
    "Time": "fileInfo/time",
}
# Names of the trigger codes 0 to 7 in a .cihx, which newer cameras store in the highest byte of `pdcMode`. Higher codes
# contain parameters and are shown as numbers.
_NAMES = ("Start", "Center", "End", "Random", "Manual", "Random Reset", "Random Center", "Random Manual")
_TRIGGERS = {str(code << shift): name for code, name in enumerate(_NAMES) for shift in (0, 24)}


def open_mraw(files: Sequence[Path], camera: str) -> FrameReader:
    """Frames of one camera. files: the header, or the .mraw file, or both.

    Raises RecordingError if header or frames are missing or inconsistent, or if pixels are not grey values.
    """
    header_file, data_file = _pair_of(files, camera)
    entries = _entries(header_file)
    layout, depth = _layout(entries)
    file, notes = RawFile(data_file), []
    n = _whole(entries, "Total Frame")
    file.check_announced(camera, layout, n, min(n, file.size // layout.frame_bytes))
    if layout.stored_bits == 16 and depth < 16:
        largest = int(np.frombuffer(file.bytes_at(0, layout.frame_bytes, str(file)), "<u2").max())
        if largest >> depth:
            notes.append(f"grey values go up to {largest}, not {2**depth - 1} as the header says; used as they are")
            depth = 16
    if file.size >= (n + 1) * layout.frame_bytes:
        notes.append(f"{data_file.name} is longer than the {n} frames of its header; what follows them is not read")
    header, remarks, doubts = _header(entries)
    return raw_frames(
        files=[file] * n,
        offsets=np.arange(n, dtype=np.int64) * layout.frame_bytes,
        layout=layout,
        bit_depth=depth,
        frame_rate=header.frame_rate,
        header=header,
        notes=(header.sentence(), *remarks, *notes),
        doubts=doubts,
    )


def _pair_of(files: Sequence[Path], camera: str) -> Iterator[Path]:
    """The files of the header and of the frames, from one of them or both. If PFV wrote both headers, .cihx is used."""
    stem = only_file(sorted({file.with_suffix("") for file in files}), camera)
    with told_as(RecordingError, f"{stem.parent}: cannot be read", OSError):
        beside = {file.suffix.lower(): file for file in stem.parent.iterdir() if file.with_suffix("") == stem}
    for suffixes in ((".cihx", ".cih"), (".mraw",)):
        there = [beside[suffix] for suffix in suffixes if suffix in beside]
        if not there:
            said = f"{files[0]}: there is no {stem.name}{' or '.join(suffixes)} beside it for the {camera} camera"
            raise RecordingError(f"{said}. Copy it from the camera's folder, or name exported images instead.")
        yield there[0]


Entries = dict[str, str]  # of a header, by their names in the .cih, "" if missing; and "file", its path


def _entries(file: Path) -> Entries:
    content = content_of(file, str(file), MOST_TEXT)
    if file.suffix.lower() == ".cihx":
        return _from_xml(content, file) | {"file": str(file)}
    rows = [line.partition(" : ") for line in content.decode("utf-8", "replace").splitlines()]
    texts = {name.strip(): value.strip() for name, separator, value in reversed(rows) if separator}  # the first counts
    return dict.fromkeys(_ENTRIES, "") | texts | {"file": str(file)}


def _whole(entries: Entries, name: str) -> int:
    """A whole number of at least 0. Raises RecordingError if there is none."""
    found = entries[name]
    if not re.fullmatch(r"[0-9]{1,15}", found):
        raise RecordingError(f"{entries['file']}: '{name}' is {found[:40]!r}; expected a whole number. {_EXPORT}")
    return int(found)


def _number(text: str) -> float | None:
    """A positive finite number, or None; fractions such as "1/800" are allowed."""
    with contextlib.suppress(ValueError, ZeroDivisionError):
        numerator, _, denominator = text.partition("/")
        value = float(numerator) / (float(denominator) if denominator else 1.0)
        return value if math.isfinite(value) and value > 0 else None
    return None


_EXPORT = "Export the recording again, or copy its header again."


def _from_xml(content: bytes, file: Path) -> dict[str, str]:
    """Entries of the XML between <cih> and </cih>, which is in a binary container.

    Content before it is omitted, so that no document type can define entities.
    """
    start, stop = content.find(b"<cih>"), content.rfind(b"</cih>")
    if start < 0 or stop < start:
        raise RecordingError(f"{file}: holds no <cih> ... </cih>, so it is no Photron header, or cut short. {_EXPORT}")
    with told_as(RecordingError, f"{file}: the XML in it is damaged", ElementTree.ParseError, ValueError, then=_EXPORT):
        root = ElementTree.fromstring(content[start : stop + len(b"</cih>")].decode("utf-8", "replace"))
    texts = {name: (root.findtext(path) or "").strip() for name, path in _ENTRIES.items()}
    code = texts["Trigger Mode"] or (root.findtext("recordInfo/triggerMode/pdcMode") or "").strip()
    texts["Trigger Mode"] = _TRIGGERS.get(code, code)
    rate = texts["Shutter Speed(s)"]  # in a .cihx it is in 1/s
    texts["Shutter Speed(s)"] = f"1/{rate}" if rate else ""
    return texts


def _layout(entries: Entries) -> tuple[PixelLayout, int]:
    """Layout of the pixels, and their significant bits. Raises RecordingError."""
    file = entries["file"]
    if entries["File Format"].lower() != "mraw":
        saved = entries["File Format"][:20] or "nothing known"
        raise RecordingError(f"{file}: the frames were saved as {saved}, not as MRAW. Name the image files instead.")
    kind, device = entries["Color Type"].lower(), entries["Camera Type"]
    mosaic = kind == "raw" and re.search(r"-C\b", device)  # the type's letter: -M- monochrome, -C- colour
    if kind not in ("mono", "raw", "") or mosaic:
        found = "a colour mosaic" if mosaic else f"of colour type {kind[:20]!r}"
        refuse_colour(file, f"the frames are {found} ({device[:60]})")
    width, height = _whole(entries, "Image Width"), _whole(entries, "Image Height")
    bits, effective = _whole(entries, "Color Bit"), _whole(entries, "EffectiveBit Depth")
    if bits not in (8, 10, 12, 16):
        raise RecordingError(f"{file}: 'Color Bit' is {bits}; expected 8, 10, 12 or 16. Save the frames with 16.")
    check_frame_size(width, height, str(file), bits)
    high = bits == 16 and entries["EffectiveBit Side"].lower() == "higher"
    packed = bits if bits in (10, 12) else 0
    layout = PixelLayout(width, height, np.dtype("u1" if bits == 8 else "<u2"), packed)
    return layout, 16 if high else bit_depth_of(bits, effective)


def _header(entries: Entries) -> tuple[CameraHeader, list[str], tuple[str, ...]]:
    """Settings of the recording, notes on impossible ones, and doubts about the times of the frames."""
    rate = _number(entries["Record Rate(fps)"])
    if rate is None:
        said = f"'Record Rate(fps)' is {entries['Record Rate(fps)'][:40]!r}; expected a number above 0"
        raise RecordingError(f"{entries['file']}: {said}. {_EXPORT}")
    remarks, doubts = [], []
    step, n = max(int(_number(entries["Save Step"]) or 1), 1), _whole(entries, "Total Frame")
    recorded = _number(entries["Original Total Frame"])
    if step > 1 and recorded is not None and (n - 1) * step >= recorded:
        saved = f"one frame in {step} was saved, but {n} of {recorded:g} recorded frames are there"
        doubts.append(f"the header says that {saved}; taken as consecutive")
        step = 1
    nanoseconds = _number(entries["Shutter Type2(nsec)"])
    exposure = nanoseconds / 1e9 if nanoseconds else _number(entries["Shutter Speed(s)"])
    if exposure is not None and exposure * rate > 1.001:
        remarks.append(f"the header's exposure of {exposure:g} s is longer than a frame of {1 / rate:g} s; not used")
        exposure = None
    first, name = entries["Start Frame"], entries["User Defined Camera Name"]
    header = CameraHeader(
        file=entries["file"],
        device=entries["Camera Type"][:80] + (f" ({name[:40]})" if name else ""),
        frame_rate=rate / step,
        step=step,
        exposure=exposure,
        trigger=entries["Trigger Mode"][:40],
        first_frame=int(first) if re.fullmatch(r"-?[0-9]{1,15}", first) else None,
        recorded=_date(f"{entries['Date']} {entries['Time']}".strip()),
    )
    return header, remarks, tuple(doubts)


def _date(text: str) -> datetime | None:
    for form in ("%Y/%m/%d %H:%M:%S", "%Y/%m/%d %H:%M", "%Y/%m/%d"):
        with contextlib.suppress(ValueError):
            return datetime.strptime(text, form)
    return None
