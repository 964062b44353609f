"""What zlib compressed, by the fastest library that is there, and never more of it than announced."""

from __future__ import annotations

import zlib

try:
    import deflate  # libdeflate: 0.4 of zlib's time
except ImportError:  # no wheel for this machine
    deflate = None  # type: ignore[assignment]


def inflated(stream: bytes, size: int) -> bytes | bytearray | None:
    """The `size` bytes that a zlib stream holds, never more; None where it holds another number or is damaged."""
    if deflate is not None:
        try:
            whole: bytearray = deflate.zlib_decompress(stream, size)
        except deflate.DeflateError:
            return None
        return whole if len(whole) == size else None
    try:
        inflater = zlib.decompressobj()
        raw = inflater.decompress(stream, size)
    except zlib.error:
        return None
    return raw if len(raw) == size and (inflater.eof or _ends_here(inflater)) else None


def _ends_here(inflater: zlib._Decompress) -> bool:
    """True if nothing but the stream's checksum was left when the output was full, and it is right."""
    try:
        return not inflater.decompress(inflater.unconsumed_tail, 1) and inflater.eof
    except zlib.error:
        return False
