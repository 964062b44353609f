"""Files that Photron's and Phantom's own software wrote give the pixels that other readers find in them."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack.errors import RecordingError
from disctrack.recording.readers import open_frames
from tests.disctrack.recording.readers.written import lost_of

SHIPPED = Path(__file__).resolve().parents[4] / "sample_data" / "camera_files"


def folder_of(name: str, request: pytest.FixtureRequest) -> Path:
    """Where a recording from the tests of other readers lies; PROVENANCE.md beside it tells of which."""
    folder = SHIPPED if (SHIPPED / name).is_file() else request.getfixturevalue("shared_data") / "camera_files"
    if not (folder / name).is_file():
        pytest.skip(f"{name} is neither in sample_data/camera_files nor among the shared data")
    return folder


def dice_frame(file: Path, largest: int) -> np.ndarray:
    """A frame as DICe kept it: width, height, bytes per value, values on a scale of 255."""
    width, height, size = np.fromfile(file, "<u4", 3)
    return np.fromfile(file, f"<f{size}", offset=12).reshape(height, width).astype(float) * largest / 255


@pytest.mark.parametrize(
    ("name", "bits"),
    [
        ("phantom_v7_raw_16bpp", 12),
        ("phantom_v9_raw_16bpp", 8),
        ("phantom_v611_raw_16bpp", 12),
        ("phantom_v12_raw_16bpp", 12),
        ("phantom_v1610_raw", 8),
        ("phantom_v2511_raw_16bpp", 12),
        ("packed_raw_12bpp", 12),
    ],
)
def test_cines_of_seven_cameras_have_the_pixels_that_dice_finds(name, bits, request):
    camera_files = folder_of(f"{name}.cine", request)
    reader = open_frames(f"{name}.cine", camera_files, "left")
    assert (len(reader), reader.image_size, reader.bit_depth) == (6, (256, 128), bits)
    # codes of 10 bits are made linear to within a unit of the maker's table; single precision costs 2e-4 of a unit
    tolerance = 1.001 if name.startswith("packed") else 1e-3
    for index in (0, 5):
        expected = dice_frame(camera_files / f"{name}_{index}.rawi", (1 << bits) - 1)
        assert_allclose(reader.read(index), expected, atol=tolerance)


def test_a_cine_s_time_stamps_tell_how_many_frames_were_left_out(request):
    camera_files = folder_of("cine_781.cine", request)
    reader = open_frames("cine_781.cine", camera_files, "left")
    header = reader.header
    assert (len(reader), header.step, header.frame_rate) == (15, 10, 9000)
    assert_allclose(np.diff(reader.timestamps), 1 / 9000, rtol=1e-3)
    assert header.exposure == pytest.approx(10e-6)


def test_a_cine_of_a_colour_sensor_is_refused(request):
    camera_files = folder_of("invalid_color.cine", request)
    with pytest.raises(RecordingError, match="colour recording"):
        open_frames("invalid_color.cine", camera_files, "left")


@pytest.mark.parametrize(
    ("name", "rate", "exposure", "first", "size"),
    [("ball_12bit", 30_000, 20e-6, 52, (384, 384)), ("beam", 50_000, 5e-6, 0, (1024, 80))],
)
def test_mraw_has_the_pixels_that_pymraw_finds(name, rate, exposure, first, size, request):
    camera_files = folder_of(f"{name}.cihx", request)
    py_mraw = pytest.importorskip("pyMRAW")
    theirs, _ = py_mraw.load_video(str(camera_files / f"{name}.cihx"))
    reader = open_frames(f"{name}.cihx", camera_files, "left")
    header = reader.header
    assert (reader.image_size, reader.bit_depth, header.saturation) == (size, 12, 4095)
    assert (header.frame_rate, header.exposure, header.first_frame) == (rate, pytest.approx(exposure), first)
    assert lost_of(reader, theirs) == {}
    assert len(reader) == len(theirs)
