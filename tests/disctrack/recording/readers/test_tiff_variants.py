"""TIFF files that other programs write: what Pillow or OpenCV sees in them is read, and nothing is made up."""

import io
import struct

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_array_equal
from PIL import Image

from disctrack.errors import RecordingError
from disctrack.recording.readers import open_frames

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
        deflate, other = (struct.pack("<HHII", 259, 3, 1, number) for number in (8, code))
        content = file.read_bytes()
        assert deflate in content
        file.write_bytes(content.replace(deflate, other))
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
