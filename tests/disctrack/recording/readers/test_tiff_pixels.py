"""Pages of TIFF files against libtiff, Pillow, and files assembled after the standard."""

import io
import struct
import tracemalloc
import zlib
from itertools import product

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image

from disctrack.errors import RecordingError
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.decoding import decode

LZW, DEFLATE = 5, 8


def ours(content):
    try:
        return decode(content, "file")
    except RecordingError:
        return None


def assembled(order, fields, pieces):
    """A file of one page: header, directory, values, strips. fields: tag -> type, number, values."""
    n = len(pieces)
    sizes = struct.pack(f"{order}{n}I", *map(len, pieces))
    whole = {**fields, 273: (4, n, bytes(4 * n)), 279: (4, n, sizes)}
    values_at = 8 + 2 + 12 * len(whole) + 4
    data_at = values_at + sum(len(content) for *_, content in whole.values() if len(content) > 4)
    starts = np.cumsum([data_at, *map(len, pieces)])[:-1]
    whole[273] = (4, n, struct.pack(f"{order}{n}I", *starts.tolist()))
    entries, values = b"", b""
    for tag, (kind, number, content) in sorted(whole.items()):
        if len(content) > 4:
            entries += struct.pack(f"{order}HHII", tag, kind, number, values_at + len(values))
            values += content
        else:
            entries += struct.pack(f"{order}HHI", tag, kind, number) + content.ljust(4, b"\0")
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(f"{order}IH", 8, len(whole))
    return b"".join([head, entries, bytes(4), values, *pieces])


def tiff_file(pixels, compression, predictor, order, rows):
    """A page by the standard: no library of images has a part in it."""
    height, width = pixels.shape
    bits = 8 * pixels.itemsize
    if predictor == 2:
        pixels = np.diff(pixels, axis=1, prepend=pixels.dtype.type(0))
    strips = [pixels[i : i + rows].astype(pixels.dtype.newbyteorder(order)).tobytes() for i in range(0, height, rows)]
    pieces = [zlib.compress(strip) if compression == DEFLATE else strip for strip in strips]
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
    for (compression, predictor), order, rows in product(((1, 1), (DEFLATE, 1), (DEFLATE, 2)), "<>", (61, 7)):
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


def test_turned_and_inverted_pages_come_back_as_the_light_fell():
    pixels = picture("disc", 8)
    page = tiff_file(pixels, DEFLATE, 1, "<", 61)
    where = page.index(struct.pack("<HHI", 277, 3, 1))
    turned = page[:where] + struct.pack("<HHI", 274, 3, 1) + b"\3" + page[where + 9 :]  # in place of one sample a pixel
    np.testing.assert_array_equal(ours(turned), pixels[::-1, ::-1])
    inverted = page.replace(struct.pack("<HHIHH", 262, 3, 1, 1, 0), struct.pack("<HHIHH", 262, 3, 1, 0, 0))
    assert inverted != page
    np.testing.assert_array_equal(ours(inverted), 255 - pixels)


@pytest.mark.parametrize("name", ["noise", "flat", "disc"])
def test_damaged_codes_give_what_libtiff_makes_of_them_or_an_error(name):
    rng = np.random.default_rng(8)
    whole = cv2.imencode(".tif", picture(name, 8), [cv2.IMWRITE_TIFF_COMPRESSION, LZW])[1].tobytes()
    refused = 0
    for _ in range(300):
        content = bytearray(whole)
        for place in rng.integers(8, 8 + len(whole) // 3, rng.integers(1, 4)):  # strips come first
            content[place] = rng.integers(256)
        found = ours(bytes(content))
        refused += found is None
        theirs = cv2.imdecode(np.frombuffer(content, np.uint8), -1)
        if found is not None and theirs is not None:
            np.testing.assert_array_equal(found, theirs)
    assert 0 < refused < 300


def test_a_page_that_claims_more_than_its_codes_can_hold_takes_no_memory():
    content = tiff_file(picture("flat", 8), DEFLATE, 1, "<", 61)
    for tag, value in ((256, 60_000), (257, 60_000), (278, 60_000)):
        where = content.index(struct.pack("<HHI", tag, 3, 1)) + 8
        content = content[:where] + struct.pack("<H", value) + content[where + 2 :]
    tracemalloc.start()
    with pytest.raises(RecordingError, match="claim"):
        decode(content, "file")
    assert tracemalloc.get_traced_memory()[1] < 10 << 20
    tracemalloc.stop()


def bomb(compression, n):
    """A page of 64 x 64 px whose strip holds n zeros."""
    rows = {DEFLATE: zlib.compress, LZW: imagecodecs.lzw_encode}[compression](bytes(n))
    short = {256: 64, 257: 64, 258: 8, 259: compression, 262: 1, 277: 1, 278: 64}
    return assembled("<", {tag: (3, 1, struct.pack("<H", value)) for tag, value in short.items()}, [rows])


@pytest.mark.parametrize("compression", [LZW, DEFLATE])
def test_a_strip_that_holds_far_more_than_its_page_is_not_unpacked(compression):
    content = bomb(compression, 64 << 20)
    assert ours(bomb(compression, 64 * 64)) is not None
    tracemalloc.start()
    found = ours(content)
    assert tracemalloc.get_traced_memory()[1] < 10 << 20
    tracemalloc.stop()
    assert found is None or not found.any()


def test_pages_of_one_stack_may_differ_in_layout_and_none_is_taken_for_another(tmp_path):
    frames = [picture("noise", 8), picture("disc", 8), picture("white noise", 8)]
    ways = [{"predictor": 2}, {}, {"tile": (16, 16)}]
    with tifffile.TiffWriter(tmp_path / "stack.tif") as file:
        for frame, way in zip(frames, ways, strict=True):
            file.write(frame, contiguous=False, photometric="minisblack", compression="zlib", **way)
    reader = open_frames("stack.tif", tmp_path, "left")
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(reader.read(index), frame)
    assert reader.content_sha256(0, 1) != reader.content_sha256(1, 2)
