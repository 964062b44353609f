"""Recordings of Photron (MRAW) and Phantom (cine) give what was written, or a reason; real files, what others read."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from disctrack.errors import RecordingError
from disctrack.recording.readers import FrameReader, open_frames
from disctrack.recording.readers.cine import linear_from_10_bits
from disctrack.recording.readers.same_instants import check_headers, check_time_stamps
from tests.disctrack.recording.readers.written import assert_refused, lost_of
from tests.oracles.camera_files import SETUP_AT, TRIGGER, write_cine, write_mraw


def random_codes(rng, bits: int, n: int = 7, height: int = 24, width: int = 32) -> np.ndarray:
    return rng.integers(0, 1 << bits, (n, height, width), dtype=np.uint8 if bits == 8 else np.uint16)


def write(folder: Path, rng, kind: str = "cih", camera: str = "left", bits: int = 8, **options) -> Path:
    """A recording of seven random frames; the file that names it."""
    codes = random_codes(rng, bits)
    if kind == "cine":
        return write_cine(folder / f"{camera}.cine", codes, bits, **options)
    return write_mraw(folder / camera, codes, bits, kind=kind, **options)


def overwrite(file: Path, offset: int, kind: str, value) -> None:
    content = bytearray(file.read_bytes())
    struct.pack_into("<" + kind, content, offset, value)
    file.write_bytes(content)


def opened(folder: Path) -> FrameReader:
    return open_frames("left.cine", folder, "left")


def pair(folder: Path, rng, kind: str, left=None, right=None) -> list[FrameReader]:
    sides = {"left": left or {}, "right": right or {}}
    return [open_frames(write(folder, rng, kind, side, **how).name, folder, side) for side, how in sides.items()]


@pytest.mark.parametrize(
    ("kind", "options", "reason"),
    [
        ("cih", {"Color_Type": "Color", "Color_Bit": "24"}, "of colour type 'color'"),
        ("cih", {"Color_Type": "Raw", "Camera_Type": "FASTCAM Nova S16 type 1100K-C-64GB"}, "a colour mosaic"),
        ("cih", {"File_Format": "TIFF"}, "saved as TIFF"),
        ("cih", {"Color_Bit": "14"}, "'Color Bit' is 14"),
        ("cih", {"Image_Width": "-32"}, "'Image Width' is '-32'"),
        ("cih", {"Image_Width": "99999999", "Image_Height": "99999999"}, "99999999 x 99999999 px"),
        ("cih", {"bits": 12, "Image_Width": "31", "Image_Height": "23"}, "do not fill whole bytes"),
        ("cih", {"Total_Frame": "0"}, "no frame"),
        ("cih", {"Total_Frame": "1" + "0" * 14}, "cut short"),
        ("cih", {"Total_Frame": "9" * 5000}, "expected a whole number"),
        ("cih", {"Record_Rate": "nan"}, "expected a number above 0"),
        ("cine", {"at": (4, "H", 1)}, "compressed cine"),
        ("cine", {"at": (SETUP_AT + 808, "I", 3)}, "colour recording"),
        ("cine", {"at": (SETUP_AT + 808, "I", 0x80000003)}, "colour recording"),
        ("cine", {"at": (60, "I", 512)}, "biCompression 512"),
        ("cine", {"rate": 0, "times": np.arange(7.0)}, "no frame rate"),
        # hostile headers, before anything is made of their sizes
        ("cine", {"at": (0, "2s", b"XX")}, "not a cine file"),
        ("cine", {"at": (20, "I", 0)}, "no frame"),
        ("cine", {"at": (20, "I", 0xFFFFFFFF)}, "table of 4294967295 images"),
        ("cine", {"at": (24, "I", 0xFFFFFF00)}, "bitmap header"),
        ("cine", {"at": (28, "I", 0xFFFFFF00)}, "camera setup"),
        ("cine", {"at": (28, "I", 0)}, "no camera setup"),
        ("cine", {"at": (32, "I", 0xFFFFFF00)}, "table of 7 images"),
        ("cine", {"at": (48, "i", 1 << 30)}, "no camera of this kind"),
        ("cine", {"at": (48, "i", 40)}, "does not have the 960 bytes"),
        ("cine", {"at": (48, "i", -32)}, "no camera of this kind"),
        ("cine", {"at": (58, "H", 24)}, "colour recording"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_reason(tmp_path, rng, kind, options, reason):
    at = options.get("at")
    file = write(tmp_path, rng, kind, **{key: value for key, value in options.items() if key != "at"})
    if at:
        overwrite(file, *at)
    with pytest.raises(RecordingError, match=reason) as caught:
        open_frames(file.name, tmp_path, "left")
    assert str(tmp_path) in str(caught.value)


LATER = np.arange(-3, 4) / 2000


def locked(later):
    """To a common clock, and triggered so many seconds later."""
    return {"trigger": (TRIGGER[0] & ~1, TRIGGER[1] + later)}


@pytest.mark.parametrize(
    ("kind", "left", "right", "declared", "reason"),
    [
        ("cih", {}, {}, 1000.0, r"is 1000, but the left camera's frames were recorded with 2000 Hz.*left\.cih"),
        ("cih", {}, {"Record_Rate": "1000"}, 2000.0, "the right camera's frames were recorded with 1000 Hz"),
        ("cih", {}, {"Save_Step": "2"}, 2000.0, r"1000 Hz \(2000 Hz, one frame in 2 saved\)"),
        ("cih", {"Record_Rate": "2000.4"}, {}, 2000.0, "does not show the same instant"),
        ("cih", {"Start_Frame": "12"}, {}, 2000.0, "begins with the camera's frame 12.*the right one with frame 0"),
        ("cine", {}, {"rate": 1000}, 2000.0, "the right camera's frames were recorded with 1000 Hz"),
        ("cine", {}, {"first_image": 9}, 2000.0, "begins with the camera's frame -3.*the right one with frame 9"),
        ("cine", {}, {"times": LATER + 3e-4}, 2000.0, "taken 0.0003 s after that of the left one.*lasts 0.0005 s"),
        ("cine", locked(0), locked(60), 2000.0, "the common clock.*taken 60 s after"),
    ],
)
def test_frames_of_different_instants_are_an_error(tmp_path, rng, kind, left, right, declared, reason):
    with pytest.raises(RecordingError, match=reason):
        list(check_headers(*pair(tmp_path, rng, kind, left, right), declared, None, "recording.toml"))


@pytest.mark.parametrize(
    ("kind", "right", "reason"),
    [
        ("cih", {"Trigger_Mode": "Manual", "Start_Frame": "7"}, "in different modes: left Start, right Manual"),
        ("cih", {"Shutter_Type2": "200000"}, "left 100 µs, right 200 µs.*lie 50 µs apart"),
        ("cih", {}, "exposure_us is 500, the left camera's header says 100 µs"),
        ("cih", {"Date": "2026/1/19"}, "1440 minutes apart"),
        ("cine", {"times": LATER + 4e-5}, "taken 40 µs after the left one's"),
        ("cine", {"exposure_ns": 60_000}, "left 50 µs, right 60 µs.*lie 5 µs apart"),
        ("cine", {"trigger": (TRIGGER[0], TRIGGER[1] + 3600)}, "60 minutes apart"),
    ],
)
def test_frames_that_may_not_be_simultaneous_are_a_warning(tmp_path, rng, kind, right, reason):
    readers = pair(tmp_path, rng, kind, {}, right)
    stamps = [finding.text for finding in check_time_stamps(*readers, 2000.0)]
    warnings = [*check_headers(*readers, 2000.0, 5e-4, "recording.toml"), *stamps]
    assert any(re.search(reason, warning) for warning in warnings)


@pytest.mark.parametrize(
    ("kind", "declared"),
    [("cih", 2000.0), ("cine", 2000.0), ("cine", 2001.0)],  # nominal, and as a clock may run
)
def test_cameras_that_agree_say_nothing(tmp_path, rng, kind, declared):
    readers = pair(tmp_path, rng, kind)
    assert not list(check_headers(*readers, declared, None, "recording.toml"))
    assert not list(check_time_stamps(*readers, declared))


@pytest.mark.parametrize("bits", [8, 16])
def test_files_of_another_writer_are_read(tmp_path, rng, bits):
    py_mraw = pytest.importorskip("pyMRAW")
    images = random_codes(rng, min(bits, 12))
    settings = {"Record Rate(fps)": "5000", "Shutter Speed(s)": "1/20000"}
    py_mraw.save_mraw(images, str(tmp_path / "left.cih"), bit_depth=bits, info_dict=settings)
    reader = open_frames("left.cih", tmp_path, "left")
    assert lost_of(reader, images) == {}
    header = reader.header
    assert (header.frame_rate, header.exposure) == (5000.0, 1 / 20000)


@pytest.mark.parametrize("kind", ["cih", "cihx"])
def test_settings_come_from_the_header(tmp_path, rng, kind):
    header = write_mraw(
        tmp_path / "left", random_codes(rng, 12), 16, depth=12, kind=kind, Start_Frame="-40", Save_Step="4"
    )
    found = open_frames(header.name, tmp_path, "left").header
    assert found == open_frames("left.mraw", tmp_path, "left").header == open_frames("left.*", tmp_path, "left").header
    assert (found.frame_rate, found.step) == (500.0, 4)  # of 2000 frames per second, one in four
    assert found.exposure == pytest.approx(1e-4, rel=1e-12)
    assert (found.trigger, found.first_frame) == ("Start", -40)
    assert found.recorded.isoformat() == "2026-01-18T11:56:13"
    assert "Mini AX200" in found.sentence()
    assert found.as_dict()["exposure"] == found.exposure


@pytest.mark.parametrize(("side", "shift"), [("Higher", 4), ("Lower", 0)])
def test_values_beyond_the_stated_depth_are_used_and_said_but_not_bits_at_the_high_side(tmp_path, rng, side, shift):
    images = random_codes(rng, 16 - shift) << shift
    write_mraw(tmp_path / "left", images, 16, depth=12, EffectiveBit_Side=side)
    reader = open_frames("left.cih", tmp_path, "left")
    assert reader.bit_depth == 16
    assert_array_equal(reader.read(3), images[3])
    assert any("grey values go up to" in note for note in reader.notes) == (side == "Lower")


def test_an_impossible_exposure_or_step_is_not_used_and_said(tmp_path, rng):
    write(tmp_path, rng, Shutter_Type2="900000", Save_Step="2500")
    reader = open_frames("left.cih", tmp_path, "left")
    assert reader.header.exposure is None
    assert reader.header.frame_rate == 2000
    assert any("longer than a frame" in note for note in reader.notes)
    assert any("taken as consecutive" in doubt for doubt in reader.doubts)


def test_header_and_frames_must_lie_together(tmp_path, rng):
    header = write(tmp_path, rng)
    header.rename(tmp_path / "kept")
    assert_refused(tmp_path, "left.mraw", r"there is no left\.cihx or \.cih beside it")
    (tmp_path / "kept").rename(header)
    (tmp_path / "left.mraw").unlink()
    assert_refused(tmp_path, "left.cih", r"there is no left\.mraw beside it")
    write(tmp_path, rng)
    write(tmp_path, rng, camera="left_2")
    assert_refused(tmp_path, "left*.cih", "name one recording")


def test_a_header_of_nested_or_expanding_xml_costs_nothing(tmp_path, rng):
    header = write(tmp_path, rng, "cihx")
    bomb = b'<!DOCTYPE cih [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'
    for content in (bomb + b"<cih>&b;</cih>", b"<cih>" + bomb + b"&b;</cih>", b"<cih>" + b"<a>" * 20_000 + b"</cih>"):
        header.write_bytes(content)
        assert_refused(tmp_path, "left.cihx", "the XML in it is damaged")
    header.write_bytes(b"<cih>" + b"<a>" * 20_000 + b"</a>" * 20_000 + b"</cih>")
    assert_refused(tmp_path, "left.cihx", "saved as nothing known")


def test_rows_padded_as_in_a_bitmap_are_read(tmp_path, rng):
    codes = random_codes(rng, 8, width=30)
    padded = np.pad(codes, ((0, 0), (0, 0), (0, 2)))
    file = write_cine(tmp_path / "left.cine", padded, 8)
    overwrite(file, 44 + 4, "i", 30)  # the bitmap's width
    assert lost_of(opened(tmp_path), codes) == {}


def test_codes_of_10_bits_are_linear_in_the_light():
    """Black and white of the format's description; the inverse of BT.709, computed forwards; monotonic throughout."""
    grey = linear_from_10_bits().astype(float)
    assert (np.diff(grey) >= 0).all()
    assert_allclose(grey[[64, 1014, 1015, 1023]], [64, 4064, 4095, 4095], atol=1)
    light = (grey[64:1014] - 64) / 4000
    code = 63.5 + 950.4 * np.where(light < 0.01805, 4.5 * light, 1.0993 * np.maximum(light, 1e-9) ** 0.45 - 0.0993)
    # half a unit of 4000 by rounding, where the curve is steepest (4.5 x 950 / 4000 codes a unit): 0.53
    assert_allclose(code, np.arange(64, 1014), atol=0.6)


def test_settings_and_times_come_from_the_file(tmp_path, rng):
    write(tmp_path, rng, "cine")
    reader = opened(tmp_path)
    header = reader.header
    assert (header.frame_rate, reader.frame_rate, header.first_frame) == (2000.0, 2000.0, -3)
    assert header.exposure == pytest.approx(50e-6, rel=1e-12)
    assert header.trigger_time == TRIGGER[1] + 0.25
    assert header.first_time == pytest.approx(-3 / 2000, abs=2**-30)
    assert not header.locked_clock
    assert header.recorded.isoformat() == "2023-11-14T22:13:20"
    # time stamps have 2**-30 s
    assert_allclose(reader.timestamps, np.arange(7) / 2000, atol=2**-29)
    assert "Phantom 711, serial number 12345" in " ".join(reader.notes)


@pytest.mark.parametrize("times", [[0, 1, 2, 3, 9, 10, 11], np.zeros(7), np.arange(7) / 0.65, -np.arange(7)])
def test_time_stamps_keep_gaps_and_are_not_used_where_they_are_impossible(tmp_path, rng, times):
    times = np.array(times) / 2000
    write(tmp_path, rng, "cine", times=times)
    reader = opened(tmp_path)
    if times[-1] == 11 / 2000:
        assert_allclose(reader.timestamps, times, atol=2**-29)
    else:
        assert reader.timestamps is None
        assert any("do not belong" in note for note in reader.notes)


def test_a_recording_of_which_every_tenth_frame_was_saved_has_a_tenth_of_the_rate(tmp_path, rng):
    """The setup keeps the camera's rate; only the time stamps tell."""
    write_cine(
        tmp_path / "left.cine", random_codes(rng, 8), 8, rate=90_000, times=np.arange(7) / 9000, exposure_ns=10_000
    )
    header = opened(tmp_path).header
    assert (header.frame_rate, header.step) == (9000, 10)
    assert "9000 Hz (90000 Hz, one frame in 10 saved)" in header.sentence()


@pytest.mark.parametrize(
    ("written", "grey_head"), [({"notes": (8, 24, 4096)}, 0), ({}, 0x80000000), ({"setup_bytes": 1200}, 0)]
)
def test_notes_of_any_length_a_grey_head_of_a_colour_camera_and_an_older_setup_are_read(
    tmp_path, rng, written, grey_head
):
    codes = random_codes(rng, 8)
    overwrite(write_cine(tmp_path / "left.cine", codes, 8, **written), SETUP_AT + 808, "I", grey_head)
    assert lost_of(opened(tmp_path), codes) == {}
    exposure = opened(tmp_path).header.exposure
    assert exposure == pytest.approx(50e-6)  # an older setup has it in microseconds


def test_a_damaged_record_is_one_lost_frame(tmp_path, rng):
    codes = random_codes(rng, 8)
    file = write_cine(tmp_path / "left.cine", codes, 8, notes=(8, 12))
    content = file.read_bytes()
    (table,) = struct.unpack_from("<I", content, 32)
    (record,) = struct.unpack_from("<q", content, table + 8 * 4)
    overwrite(file, record + 4, "B", content[record + 4] ^ 1)  # the size behind its note of 8 bytes
    reader = opened(tmp_path)
    assert any("lacks 1 of 7 frames" in note for note in reader.notes)
    lost = lost_of(reader, codes)
    assert list(lost) == [4]
    assert "frame 4): there is no image of the right size" in lost[4]


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
    assert_refused(camera_files, "invalid_color.cine", "colour recording")


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
    assert (reader.image_size, reader.bit_depth) == (size, 12)
    assert (header.frame_rate, header.exposure, header.first_frame) == (rate, pytest.approx(exposure), first)
    assert lost_of(reader, theirs) == {}
    assert len(reader) == len(theirs)
