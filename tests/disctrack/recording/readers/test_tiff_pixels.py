"""Strips of TIFF pages that are decoded without libtiff, against libtiff and against an encoder after the standard."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from disctrack.recording.readers import _lzw
from disctrack.recording.readers.decoding import decode
from disctrack.recording.readers.tiff_directories import Tiff, TiffContent, assembled
from disctrack.recording.readers.tiff_pixels import plain_grey

LZW, DEFLATE = 5, 8


def ours(content):
    tiff = Tiff(TiffContent(content))
    tags, _ = tiff.directory(tiff.first)
    return plain_grey(tiff, tags, tiff.pieces(tags, ""))


def lzw_codes(content):
    """TIFF 6.0, section 13: codes of 9 to 12 bits, high bits first; the width grows after entries 511, 1023, 2047."""
    bits, table, width, text = "", {bytes([i]): i for i in range(256)}, 9, b""
    bits += f"{256:09b}"
    following = 258
    for byte in content:
        longer = text + bytes([byte])
        if longer in table:
            text = longer
            continue
        bits += f"{table[text]:0{width}b}"
        table[longer], following, text = following, following + 1, bytes([byte])
        if following == 4095:
            bits += f"{table[text]:0{width}b}{256:0{width}b}"
            table, width, following, text = {bytes([i]): i for i in range(256)}, 9, 258, b""
        elif following in (512, 1024, 2048):
            width += 1
    bits += f"{table[text]:0{width}b}" if text else ""
    if following + 1 in (512, 1024, 2048) and text:
        width += 1
    bits += f"{257:0{width}b}"
    return int(bits.ljust(-(-len(bits) // 8) * 8, "0"), 2).to_bytes(-(-len(bits) // 8), "big")


def tiff_file(pixels, compression, predictor, order, rows):
    """A page by the standard: no library has a part in it."""
    height, width = pixels.shape
    bits = 8 * pixels.itemsize
    if predictor == 2:
        pixels = np.diff(pixels, axis=1, prepend=pixels.dtype.type(0))
    strips = [pixels[i : i + rows].astype(pixels.dtype.newbyteorder(order)).tobytes() for i in range(0, height, rows)]
    pieces = [{LZW: lzw_codes, DEFLATE: zlib.compress, 1: bytes}[compression](strip) for strip in strips]
    short = {256: width, 257: height, 258: bits, 259: compression, 262: 1, 277: 1, 278: rows, 317: predictor}
    return assembled(order, {tag: (3, 1, struct.pack(order + "H", value)) for tag, value in short.items()}, pieces)


def pictures():
    rng = np.random.default_rng(5)
    noise = rng.normal(120, 3, (61, 83))
    disc = np.where(np.hypot(*(np.mgrid[:61, :83] - 35)) < 20, 40.0, 200.0)
    yield "noise", noise
    yield "flat", np.full((61, 83), 7.0)  # one string that grows to the end of its strip
    yield "disc", disc + (noise - 120) / 8
    yield "white noise", rng.uniform(0, 255, (61, 83))
    yield "a column", noise[:, :1]
    yield "a period of nine", np.tile(np.arange(9.0), (61, 9))  # strings longer than eight bytes that touch themselves


PICTURES = dict(pictures())


def picture(name, bits):
    return np.rint(PICTURES[name] * (257 if bits == 16 else 1)).clip(0, 2**bits - 1).astype(f"u{bits // 8}")


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", PICTURES)
def test_pages_by_the_standard_come_back_in_either_order_of_bytes(name, bits):
    pixels = picture(name, bits)
    for compression in (1, LZW, DEFLATE):
        for predictor in (1, 2) if compression != 1 else (1,):
            for order in "<>":
                for rows in (61, 7):
                    content = tiff_file(pixels, compression, predictor, order, rows)
                    found = ours(content)
                    np.testing.assert_array_equal(found, pixels)
                    assert found.dtype == pixels.dtype  # in this machine's order
                    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(content, np.uint8), -1), pixels)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", PICTURES)
def test_pages_by_libtiff_are_decoded_without_it(name, bits):
    pixels = picture(name, bits)
    for predictor in (1, 2):
        for code in (LZW, DEFLATE, 1):
            words = [cv2.IMWRITE_TIFF_COMPRESSION, code, cv2.IMWRITE_TIFF_PREDICTOR, predictor]
            np.testing.assert_array_equal(ours(cv2.imencode(".tif", pixels, words)[1].tobytes()), pixels)
        for kind in ("tiff_lzw", "tiff_adobe_deflate"):
            file = io.BytesIO()
            Image.fromarray(pixels).save(file, "tiff", compression=kind, tiffinfo={317: predictor})
            np.testing.assert_array_equal(ours(file.getvalue()), pixels)


def test_what_is_not_plain_grey_is_left_to_libtiff():
    pixels = picture("disc", 8)
    colour = cv2.imencode(".tif", cv2.applyColorMap(pixels, cv2.COLORMAP_JET))[1].tobytes()
    assert ours(colour) is None
    assert decode(colour, "here").shape == (61, 83, 3)
    upside_down = tiff_file(pixels, LZW, 1, "<", 61)
    assert ours(upside_down) is not None
    where = upside_down.index(struct.pack("<HHI", 277, 3, 1))
    assert ours(upside_down[:where] + struct.pack("<HHI", 274, 3, 1) + b"\3" + upside_down[where + 9 :]) is None
    inverted = upside_down.replace(struct.pack("<HHIHH", 262, 3, 1, 1, 0), struct.pack("<HHIHH", 262, 3, 1, 0, 0))
    assert inverted != upside_down
    assert ours(inverted) is None


@pytest.mark.parametrize("name", ["noise", "flat", "disc"])
def test_damaged_codes_give_what_libtiff_makes_of_them_or_are_left_to_it(name):
    rng = np.random.default_rng(8)
    whole = cv2.imencode(".tif", picture(name, 8), [cv2.IMWRITE_TIFF_COMPRESSION, LZW])[1].tobytes()
    left = 0
    for _ in range(300):
        content = bytearray(whole)
        for place in rng.integers(8, 8 + len(whole) // 3, rng.integers(1, 4)):  # strips come first
            content[place] = rng.integers(256)
        found = ours(bytes(content))
        left += found is None
        if found is not None:
            np.testing.assert_array_equal(found, cv2.imdecode(np.frombuffer(content, np.uint8), -1))
    assert 0 < left < 300


def test_no_codes_make_the_decoder_write_beyond_its_room(rng):
    size, guard = 300, 64
    for n in rng.integers(0, 400, 3000):
        codes = rng.integers(0, 256, n + _lzw.SLACK, dtype=np.uint8)
        if n > 4:  # an ordinary beginning: clear, then a literal
            codes[:3] = np.frombuffer(struct.pack(">I", (256 << 15 | int(codes[0]) << 6) << 8)[:3], np.uint8)
        cut = np.sort(rng.integers(0, n + 1, 2))
        ends = np.array([0, *cut, n], np.int64)
        out = np.full(_lzw.HEAD + size + guard, 77, np.uint8)
        _lzw.decode_lzw(codes, ends, out[: _lzw.HEAD + size], 100, size)
        assert (out[_lzw.HEAD + size :] == 77).all()


def test_a_page_that_claims_more_than_its_codes_can_hold_takes_no_memory():
    content = tiff_file(picture("flat", 8), LZW, 1, "<", 61)
    for tag, value in ((256, 60_000), (257, 60_000), (278, 60_000)):
        where = content.index(struct.pack("<HHI", tag, 3, 1)) + 8
        content = content[:where] + struct.pack("<H", value) + content[where + 2 :]
    assert ours(content) is None
