"""A checksum at the end of HDF5 files, checked before reading: the HDF5 library may hang or crash on damaged files.

HDF5 stores its own length and ignores what follows; if it writes to a file, it cuts that off.
"""

import io
import os
import zlib
from pathlib import Path

import numpy as np

_MARK = b"\ncrc32 "


def _seal(content: bytes | memoryview) -> bytes:
    return _MARK + f"{zlib.crc32(content):08x}".encode()


def sealed(buffer: io.BytesIO) -> memoryview:
    """A file in memory, with the checksum of all its bytes appended."""
    seal = _seal(buffer.getbuffer())
    buffer.seek(0, os.SEEK_END)
    buffer.write(seal)
    return buffer.getbuffer()


def check_seal(path: Path) -> None:
    """Raises ValueError if a sealed file has changed; OSError if it cannot be read."""
    content, n = np.memmap(path, np.uint8, "r"), len(_seal(b""))
    end = content[-n:].tobytes()
    if end.startswith(_MARK) and end != _seal(content[:-n].data):
        raise ValueError("its bytes are not those that were written: damaged on the disk or by a copy")
