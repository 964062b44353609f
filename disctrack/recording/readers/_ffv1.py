"""Checksums of FFV1 packets: the decoder reports a wrong one to its log alone and delivers the damaged frame.

RFC 9043, section 4.9: a packet is a chain of slices, each ending in its size (24 bits), and with error detection in an
error status (8 bits) and a parity that makes the CRC of the whole slice zero (polynomial 0x04C11DB7, start 0, most
significant bit first).
"""

import zlib

import numpy as np

_FOOTER = 8
# zlib computes the same CRC with the bits of every byte in the other order
_REVERSED = np.packbits(np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)[:, ::-1], axis=1).ravel()


def checksums_hold(packet: bytes) -> bool:
    """True if the packet is a chain of slices whose checksums are right."""
    mirrored = _REVERSED[np.frombuffer(packet, np.uint8)].tobytes()
    stop = len(packet)
    while stop:
        if stop < _FOOTER:
            return False
        start = stop - _FOOTER - int.from_bytes(packet[stop - _FOOTER : stop - _FOOTER + 3], "big")
        if start < 0 or packet[stop - 5] or zlib.crc32(memoryview(mirrored)[start:stop], 0xFFFFFFFF) != 0xFFFFFFFF:
            return False
        stop = start
    return True
