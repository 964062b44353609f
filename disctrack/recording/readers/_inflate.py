"""What zlib compressed, by libdeflate, and never more of it than announced."""

from __future__ import annotations

import imagecodecs


def inflated(stream: bytes, size: int) -> bytes | bytearray | None:
    """The `size` bytes that a zlib stream holds, never more; None where it holds another number or is damaged."""
    try:
        whole: bytes | bytearray = imagecodecs.deflate_decode(stream, out=size)
    except imagecodecs.DeflateError:
        return None
    return whole if len(whole) == size else None
