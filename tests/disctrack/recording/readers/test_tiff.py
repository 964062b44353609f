"""TIFF files of other programs, against libtiff and Pillow; nothing is made up, and no claim of a page takes memory."""

import io
import tracemalloc

import cv2
import numpy as np
import pytest
import tifffile
from numpy.testing import assert_array_equal
from PIL import Image
from tifffile import COMPRESSION

from disctrack.errors import RecordingError
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.decoding import decode


def ours(content):
    try:
        return decode(content, "file")
    except RecordingError:
        return None


def pictures():
    rng = np.random.default_rng(5)
    noise, white = rng.normal(120, 3, (61, 83)), rng.uniform(0, 255, (61, 83))
    disc = np.where(np.hypot(*(np.mgrid[:61, :83] - 35)) < 20, 40.0, 200.0) + (noise - 120) / 8
    flat = np.full((61, 83), 7.0)
    return {"noise": noise, "flat": flat, "disc": disc, "white noise": white, "a column": noise[:, :1]}


PICTURES = pictures()


def picture(name, bits):
    return np.rint(PICTURES[name] * (257 if bits == 16 else 1)).clip(0, 2**bits - 1).astype(f"u{bits // 8}")


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", PICTURES)
def test_pages_of_other_writers_come_back_in_this_machines_order_of_bytes(name, bits):
    pixels = picture(name, bits)
    for predictor in (1, 2):
        contents = []
        for code in (COMPRESSION.LZW, COMPRESSION.ADOBE_DEFLATE, COMPRESSION.NONE):
            words = [cv2.IMWRITE_TIFF_COMPRESSION, code, cv2.IMWRITE_TIFF_PREDICTOR, predictor]
            contents.append(cv2.imencode(".tif", pixels, words)[1].tobytes())
        for kind in ("tiff_lzw", "tiff_adobe_deflate"):
            file = io.BytesIO()
            Image.fromarray(pixels).save(file, "tiff", compression=kind, tiffinfo={317: predictor})
            contents.append(file.getvalue())
        for order in "<>":
            file = io.BytesIO()
            packing = {"compression": "zlib", "predictor": predictor, "rowsperstrip": 7}
            tifffile.imwrite(file, pixels, byteorder=order, photometric="minisblack", **packing)
            contents.append(file.getvalue())
        for content in contents:
            found = ours(content)
            np.testing.assert_array_equal(found, pixels)
            assert found.dtype == pixels.dtype


@pytest.mark.parametrize("name", ["noise", "flat", "disc"])
def test_damaged_codes_give_what_libtiff_makes_of_them_or_an_error(name):
    rng = np.random.default_rng(8)
    whole = cv2.imencode(".tif", picture(name, 8), [cv2.IMWRITE_TIFF_COMPRESSION, COMPRESSION.LZW])[1].tobytes()
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


def claiming(pixels, compression, **tags):
    """A file of one strip, as tifffile writes it, whose directory says otherwise: tag -> value."""
    file = io.BytesIO()
    rows = {"rowsperstrip": len(pixels), "metadata": None}
    tifffile.imwrite(file, pixels, photometric="minisblack", compression=compression, **rows)
    file.seek(0)
    says_otherwise(file, **tags)
    return file.getvalue()


def says_otherwise(file, **tags):
    """Other values of these tags in the directories of all pages of a file."""
    with tifffile.TiffFile(file, mode="r+") as tiff:
        for page in tiff.pages:
            for tag, value in tags.items():
                page.tags[tag].overwrite(value, dtype="I")


def memory_of(content):
    """What decoding gives, and the most that it took [bytes]."""
    tracemalloc.start()
    found = ours(content)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found, most


def test_a_page_that_claims_more_than_its_codes_can_hold_takes_no_memory():
    content = claiming(picture("flat", 8), "zlib", ImageWidth=60_000, ImageLength=60_000, RowsPerStrip=60_000)
    with pytest.raises(RecordingError, match="claims images of 60000 x 60000"):
        decode(content, "file")
    assert memory_of(content)[1] < 10 << 20


@pytest.mark.parametrize("compression", ["lzw", "zlib"])
def test_a_strip_that_holds_far_more_than_its_page_is_not_unpacked(compression):
    bomb = claiming(np.zeros((1 << 20, 64), np.uint8), compression, ImageLength=64, RowsPerStrip=64)
    assert ours(claiming(np.zeros((64, 64), np.uint8), compression)).shape == (64, 64)
    found, most = memory_of(bomb)
    assert most < 10 << 20
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


DEEP = np.random.default_rng(2).integers(0, 4096, (4, 37, 53)).astype(np.uint16)
FRAMES = {8: (DEEP >> 4).astype(np.uint8), 16: DEEP}
PACKINGS = [{}, {"compression": "deflate", "predictor": 2}, {"tile": (16, 16)}]


def read(folder):
    reader = open_frames("*.tif", folder, "left")
    return np.stack([reader.read(i) for i in range(len(reader))])


def written(folder, frames, stacked, **options):
    """A file for each frame, or one of all of them."""
    folder.mkdir()
    options = {"photometric": "minisblack", "contiguous": False, **options}
    for i, frame in enumerate(frames):
        tifffile.imwrite(folder / ("stack.tif" if stacked else f"{i}.tif"), frame, append=stacked and i > 0, **options)
    return folder


@pytest.mark.parametrize("packing", PACKINGS, ids=str)
@pytest.mark.parametrize("bits", FRAMES)
@pytest.mark.parametrize("stacked", [False, True])
def test_where_white_is_zero_light_is_more_all_the_same(tmp_path, bits, packing, stacked):
    frames = FRAMES[bits]
    assert_array_equal(read(written(tmp_path / "white", frames, stacked, photometric="miniswhite", **packing)), ~frames)
    assert_array_equal(read(written(tmp_path / "black", frames, stacked, **packing)), frames)


@pytest.mark.parametrize("packing", PACKINGS, ids=str)
@pytest.mark.parametrize("orientation", range(1, 9))
def test_frames_stand_upright_in_files_and_stacks_as_in_pillow(tmp_path, orientation, packing):
    tag = {"extratags": [(274, 3, 1, orientation, True)], **packing}
    files, pages = (written(tmp_path / f"{stacked}", FRAMES[8], stacked, **tag) for stacked in (False, True))
    # from bytes: of a file of its own Pillow maps the rows before it turns them
    upright = np.stack([np.array(Image.open(io.BytesIO((files / f"{i}.tif").read_bytes()))) for i in range(4)])
    assert np.array_equal(upright, FRAMES[8]) == (orientation == 1)
    assert_array_equal(read(files), upright)
    assert_array_equal(read(pages), upright)


@pytest.mark.parametrize("stacked", [False, True])
@pytest.mark.parametrize(("code", "name"), [(34712, "JPEG2000"), (34933, "PNG"), (50000, "ZSTD"), (40000, "unkn")])
def test_pixels_by_an_unknown_method_are_refused_by_name_and_never_black(tmp_path, stacked, code, name):
    folder = written(tmp_path / "frames", FRAMES[8], stacked, compression="zlib")
    for file in folder.iterdir():
        says_otherwise(file, Compression=code)
    with pytest.raises(RecordingError, match=rf"compressed by a method \({code}, {name}"):
        read(folder)


def test_a_stack_behind_one_directory_is_read_whole_or_refused(tmp_path):
    for name in ("minisblack", "miniswhite"):
        (tmp_path / name).mkdir()
        tifffile.imwrite(tmp_path / name / "stack.tif", DEEP, truncate=True, photometric=name)
    assert_array_equal(read(tmp_path / "minisblack"), DEEP)
    with pytest.raises(RecordingError, match="4 frames in one directory, whose pixels are not plain"):
        read(tmp_path / "miniswhite")


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "packbits"])
def test_palettes_are_heeded_in_files_and_stacks(tmp_path, compression):
    def picture(frame, colours):
        found = Image.frombytes("P", frame.shape[::-1], frame.tobytes())
        found.putpalette(bytes(colours))
        return found

    level = np.arange(256, dtype=np.uint8)
    grey = np.stack([255 - level] * 3, axis=-1)
    for name, colours in (("grey", grey), ("colour", grey * np.array([1, 1, 0], np.uint8))):
        first, *others = (picture(frame, colours.tobytes()) for frame in FRAMES[8])
        (tmp_path / name).mkdir()
        first.save(tmp_path / name / "stack.tif", save_all=True, append_images=others, compression=compression)
    assert_array_equal(read(tmp_path / "grey"), 255 - FRAMES[8])
    with pytest.raises(RecordingError, match="a colour image"):
        read(tmp_path / "colour")
