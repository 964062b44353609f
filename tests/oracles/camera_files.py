"""Files as high-speed cameras write them, made from the formats' descriptions; shares no line with the readers."""

import struct
from pathlib import Path

import numpy as np

CIH = {
    "Date": "2026/1/18",
    "Time": "11:56:13",
    "Camera Type": "FASTCAM Mini AX200 type 540K-M-32GB",
    "Record Rate(fps)": "2000",
    "Shutter Speed(s)": "1/10000",
    "Trigger Mode": "Start",
    "Original Total Frame": "5000",
    "Start Frame": "0",
    "Save Step": "1",
    "Color Type": "Mono",
    "File Format": "MRaw",
    "EffectiveBit Side": "Lower",
    "Shutter Type2(nsec)": "100000",
}

CIHX = """<?xml version="1.0" encoding="utf-8"?>
<cih>
    <fileInfo><version>1.0</version><date>{Date}</date><time>{Time}</time></fileInfo>
    <imageFileInfo><fileFormat>{File Format}</fileFormat></imageFileInfo>
    <imageDataInfo>
        <resolution><width>{Image Width}</width><height>{Image Height}</height></resolution>
        <colorInfo><type>{Color Type}</type><bit>{Color Bit}</bit></colorInfo>
        <effectiveBit><depth>{EffectiveBit Depth}</depth><side>{EffectiveBit Side}</side></effectiveBit>
    </imageDataInfo>
    <frameInfo>
        <recordedFrame>{Original Total Frame}</recordedFrame><totalFrame>{Total Frame}</totalFrame>
        <startFrame>{Start Frame}</startFrame><skipFrame>{Save Step}</skipFrame>
    </frameInfo>
    <recordInfo>
        <recordRate>{Record Rate(fps)}</recordRate><shutterSpeed>10000</shutterSpeed>
        <shutterSpeedNsec>{Shutter Type2(nsec)}</shutterSpeedNsec>
        <triggerMode><pdcMode>0</pdcMode><afterFrame>5000</afterFrame></triggerMode>
    </recordInfo>
    <deviceInfo><deviceName>{Camera Type}</deviceName></deviceInfo>
    <basicInfo><comment></comment></basicInfo>
</cih>
"""


def packed(values: np.ndarray, bits: int) -> bytes:
    """Values one after the other as one large binary number, most significant bit first."""
    digits = np.unpackbits(values.astype(">u2").view(np.uint8).reshape(-1, 2), axis=1)[:, 16 - bits :]
    return np.packbits(digits).tobytes()


def write_mraw(stem: Path, images: np.ndarray, bits: int, *, kind: str = "cih", depth: int = 0, **entries: str) -> Path:
    """Write images (n, height, width) beside a header of kind "cih" or "cihx"; returns the header.

    entries replace or add to those of the header; spaces in their names are written as underscores, brackets left out.
    """
    n, height, width = images.shape
    sizes = {"Total Frame": n, "Image Width": width, "Image Height": height}
    sizes |= {"Color Bit": bits, "EffectiveBit Depth": depth or bits}
    told = CIH | {name: str(size) for name, size in sizes.items()}
    names = {"".join(c if c.isalnum() else "_" for c in name.split("(")[0]): name for name in told}
    told |= {names[name]: value for name, value in entries.items()}
    stem.parent.mkdir(parents=True, exist_ok=True)
    content = packed(images, bits) if bits in (10, 12) else images.astype("u1" if bits == 8 else "<u2").tobytes()
    stem.with_suffix(".mraw").write_bytes(content)
    header = stem.with_suffix(f".{kind}")
    if kind == "cih":
        lines = ["#Camera Information Header", *(f"{name} : {value}" for name, value in told.items()), "", "node : 0.1"]
        header.write_bytes(("\r\n".join(lines) + "\r\n").encode())
    else:
        binary = bytes(range(256)) + b"!!! This file can not be edited. !!!\0\0CIHX" + bytes(37)
        header.write_bytes(binary + CIHX.format(**told).encode() + bytes(64))
    return header


TRIGGER = (0x40000000 | 1, 1_700_000_000)  # a quarter second after the whole one; lowest bit: no common time signal
CINE = {"first_image": -3, "rate": 2000, "exposure_ns": 50_000, "trigger": TRIGGER, "notes": (8,), "setup_bytes": 12432}
SETUP_AT = 44 + 40  # behind the headers of the file and of the bitmap


def write_cine(
    path: Path,
    images: np.ndarray,
    bits: int,
    *,
    packed_pixels: bool = False,
    times: np.ndarray | None = None,
    **entries,
) -> Path:
    """Write images (n, height, width) of stored codes as a cine; returns the file.

    bits : 8, 16, or 10 to 16 in 16; with packed_pixels 10 or 12. times (n,) [s] after the trigger, None: at the rate.
    entries : in place of those of CINE; notes : bytes in front of each image, taken in turn.
    """
    told, (n, height, width) = CINE | entries, images.shape
    first, trigger, notes = told["first_image"], told["trigger"], told["notes"]
    if packed_pixels:
        packing, pictures = {10: 256, 12: 1024}[bits], [packed(image, bits) for image in images]
    else:  # a bitmap's rows begin with the lowest
        packing, pictures = 0, [image[::-1].astype("u1" if bits == 8 else "<u2").tobytes() for image in images]
    times = (first + np.arange(n)) / told["rate"] if times is None else times
    fixed_point = np.rint((trigger[0] & ~3) + np.asarray(times, float) * 2**32).astype(np.int64) + (trigger[1] << 32)
    stamps = b"".join(struct.pack("<II", t & 0xFFFFFFFC | trigger[0] & 3, t >> 32) for t in fixed_point.tolist())
    blocks = struct.pack("<IHH", 8 + 4 * n, 1003, 0) + bytes(4 * n)
    blocks += struct.pack("<IHH", 8 + len(stamps), 1002, 0) + stamps
    table_at = SETUP_AT + told["setup_bytes"] + len(blocks)
    records, table, position = b"", [], table_at + 8 * n
    for i, picture in enumerate(pictures):
        note = notes[i % len(notes)]
        table.append(position)
        record = struct.pack("<I", note) + bytes(note - 8) + struct.pack("<I", len(picture)) + picture
        records += record
        position += len(record)
    head = struct.pack("<2sHHHiIiIIII", b"CI", 44, 0, 1, first, n, first, n, 44, SETUP_AT, table_at)
    head += struct.pack("<II", *trigger)
    depth = 8 if bits == 8 else 16
    bitmap = struct.pack("<IiiHHIIiiII", 40, width, height, 1, depth, packing, len(pictures[0]), 0, 0, 0, 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    setup = setup_of(told, bits, width, height)
    path.write_bytes(head + bitmap + setup + blocks + struct.pack(f"<{n}q", *table) + records)
    return path


def setup_of(told: dict, bits: int, width: int, height: int) -> bytes:
    """What a cine keeps of the camera's settings; an older one ends before the newer fields."""
    size, rate, exposure_ns = told["setup_bytes"], told["rate"], told["exposure_ns"]
    block = bytearray(size)
    fields = {0: ("H", min(rate, 65535)), 737: ("H", width), 739: ("H", height), 743: ("I", 12345), 768: ("I", rate)}
    fields |= {772: ("I", exposure_ns // 1000), 792: ("I", 711), 896: ("I", bits), 1568: ("I", exposure_ns)}
    fields |= {5732: ("i", 0), 5736: ("i", (1 << bits) - 1)}
    for offset, (kind, value) in fields.items():
        if offset + struct.calcsize(kind) <= size:
            struct.pack_into("<" + kind, block, offset, value)
    struct.pack_into("<2sH", block, 140, b"ST", size)
    return bytes(block)
