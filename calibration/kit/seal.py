"""A seal behind HDF5 files: damaged bytes, on which the HDF5 library may hang or crash, never reach it.

HDF5 keeps its own length and takes no notice of what follows; where it writes to a file, it cuts that off.
"""

import io
import mmap
import os
import zlib
from pathlib import Path

_MARK = b"\ncrc32 "


def _seal(content: bytes | memoryview) -> bytes:
    return _MARK + f"{zlib.crc32(content):08x}".encode()


def sealed(buffer: io.BytesIO) -> memoryview:
    """A file in memory, with the checksum of all its bytes behind them."""
    seal = _seal(buffer.getbuffer())
    buffer.seek(0, os.SEEK_END)
    buffer.write(seal)
    return buffer.getbuffer()


def check_seal(path: Path) -> None:
    """Raises ValueError where a sealed file has changed; OSError where it cannot be read."""
    n = len(_seal(b""))
    with open(path, "rb") as file:
        if os.fstat(file.fileno()).st_size < n:
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content, memoryview(content) as whole:
            end = bytes(whole[-n:])
            with whole[:-n] as body:
                changed = end.startswith(_MARK) and end != _seal(body)
    if changed:
        raise ValueError("its bytes are not those that were written: damaged on the disk or by a copy")
