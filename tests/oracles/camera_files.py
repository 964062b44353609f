"""Files as high-speed cameras write them, made from the formats' descriptions; shares no line with the readers."""

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
    digits = "".join(f"{int(value):0{bits}b}" for value in values.ravel())
    return int(digits, 2).to_bytes(len(digits) // 8, "big")


def write_mraw(stem: Path, images: np.ndarray, bits: int, *, kind: str = "cih", depth: int = 0, **entries: str) -> Path:
    """Write images (n, height, width) beside a header of kind "cih" or "cihx"; returns the header.

    entries replace or add to those of the header; spaces in their names are written as underscores, brackets left out.
    """
    n, height, width = images.shape
    told = {
        **CIH,
        "Total Frame": f"{n}",
        "Image Width": f"{width}",
        "Image Height": f"{height}",
        "Color Bit": f"{bits}",
        "EffectiveBit Depth": f"{depth or bits}",
    }
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
