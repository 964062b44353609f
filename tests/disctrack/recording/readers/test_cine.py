"""Phantom recordings give the pixels, times and settings that the camera wrote, or a reason in words."""

import os
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from disctrack.errors import RecordingError
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.base import FrameReader
from disctrack.recording.readers.blocks import iter_pair_blocks
from disctrack.recording.readers.camera_header import check_headers
from disctrack.recording.readers.cine import linear_from_10_bits
from disctrack.recording.readers.time_stamps import check_time_stamps
from tests.oracles.camera_files import TRIGGER, write_cine

# stored bits, packed without a gap, largest grey value
KINDS = [(8, False, 255), (10, False, 1023), (12, False, 4095), (16, False, 65535), (12, True, 4095), (10, True, 4095)]


def random_codes(rng, bits: int, n: int = 7, height: int = 24, width: int = 32) -> np.ndarray:
    return rng.integers(0, 1 << bits, (n, height, width), dtype=np.uint8 if bits == 8 else np.uint16)


def grey_of(codes: np.ndarray, bits: int, packed: bool) -> np.ndarray:
    return linear_from_10_bits()[codes] if packed and bits == 10 else codes


@pytest.mark.parametrize(("bits", "packed", "largest"), KINDS)
def test_every_depth_returns_the_pixels_that_were_written(tmp_path, rng, bits, packed, largest):
    codes = random_codes(rng, bits)
    write_cine(tmp_path / "left.cine", codes, bits, packed_pixels=packed)
    grey = grey_of(codes, bits, packed)
    reader = open_frames("left.cine", tmp_path, "left")
    assert isinstance(reader, FrameReader)
    assert (len(reader), reader.image_size) == (7, (32, 24))
    assert (reader.bit_depth, reader.header.saturation) == (int(np.log2(largest + 1)), largest)
    out = np.zeros((24, 32), codes.dtype)
    for i in range(len(reader)):
        assert_array_equal(reader.read(i), grey[i])
        assert reader.read(i, out) is out
        assert_array_equal(out, grey[i])


@pytest.mark.parametrize(("bits", "packed", "largest"), KINDS)
def test_blocks_of_both_cameras_hold_every_pair_in_order(tmp_path, rng, bits, packed, largest):
    codes = np.stack([random_codes(rng, bits, 23), random_codes(rng, bits, 23)], axis=1)
    for camera, name in enumerate(("left", "right")):
        write_cine(tmp_path / f"{name}.cine", codes[:, camera], bits, packed_pixels=packed)
    readers = [open_frames(f"{name}.cine", tmp_path, name) for name in ("left", "right")]
    blocks = [block.images.copy() for block in iter_pair_blocks(*readers, block=5, threads=3)]
    assert_array_equal(np.concatenate(blocks), grey_of(codes, bits, packed))


def test_rows_padded_as_in_a_bitmap_are_read(tmp_path, rng):
    codes = random_codes(rng, 8, width=30)
    padded = np.pad(codes, ((0, 0), (0, 0), (0, 2)))
    file = write_cine(tmp_path / "left.cine", padded, 8)
    content = bytearray(file.read_bytes())
    struct.pack_into("<i", content, 44 + 4, 30)  # the bitmap's width
    file.write_bytes(content)
    reader = open_frames("left.cine", tmp_path, "left")
    assert_array_equal([reader.read(i) for i in range(7)], codes)


def test_notes_in_front_of_the_images_may_differ_in_length(tmp_path, rng):
    codes = random_codes(rng, 12)
    write_cine(tmp_path / "left.cine", codes, 12, notes=(8, 24, 4096))
    reader = open_frames("left.cine", tmp_path, "left")
    assert_array_equal([reader.read(i) for i in range(7)], codes)


@pytest.mark.parametrize(("bits", "packed"), [(12, False), (16, False), (10, True)])
def test_another_reader_sees_the_same_pixels(tmp_path, rng, bits, packed):
    """Pycine stretches grey values from black and white level to the full range: of packed ones from 64 and 4064."""
    raw = pytest.importorskip("pycine.raw")
    codes = random_codes(rng, bits)
    if packed:
        codes = np.clip(codes, 64, 1014)  # below and above it clips
    file = write_cine(tmp_path / "left.cine", codes, bits, packed_pixels=packed)
    theirs = np.stack(list(raw.read_frames(str(file), start_frame=1)[0])).astype(int)
    reader = open_frames("left.cine", tmp_path, "left")
    ours = np.stack([reader.read(i) for i in range(7)]).astype(int)
    if not packed:
        assert_array_equal(ours, theirs)
    else:  # within a unit of its table, and another of its rounding down
        assert_allclose((ours - 64) * 4095 / 4000, theirs, atol=2.1)


@pytest.mark.parametrize("bits", [8, 16])
def test_ffmpeg_sees_the_same_pixels_and_rate(tmp_path, rng, bits):
    av = pytest.importorskip("av")
    codes = random_codes(rng, bits)
    file = write_cine(tmp_path / "left.cine", codes, bits)
    with av.open(str(file)) as container:
        frames = [frame.to_ndarray() for frame in container.decode(video=0)]
        assert container.streams.video[0].time_base.denominator == 2000
    reader = open_frames("left.cine", tmp_path, "left")
    assert_array_equal([reader.read(i) for i in range(7)], frames)


def test_codes_of_10_bits_are_linear_in_the_light():
    """Black and white of the format's description; the inverse of BT.709, computed forwards; monotonic throughout."""
    grey = linear_from_10_bits().astype(float)
    assert (np.diff(grey) >= 0).all()
    assert_allclose(grey[[64, 1014, 1015, 1023]], [64, 4064, 4095, 4095], atol=1)
    light = (grey[64:1014] - 64) / 4000
    code = 63.5 + 950.4 * np.where(light < 0.01805, 4.5 * light, 1.0993 * np.maximum(light, 1e-9) ** 0.45 - 0.0993)
    # half a unit of 4000 by rounding, where the curve is steepest (4.5 x 950 / 4000 codes a unit): 0.53
    assert_allclose(code, np.arange(64, 1014), atol=0.6)


def test_codes_of_10_bits_agree_with_the_published_table():
    table = pytest.importorskip("pycine.linLUT").linLUT
    assert np.abs(linear_from_10_bits().astype(int) - table).max() <= 1


def test_settings_and_times_come_from_the_file(tmp_path, rng):
    write_cine(tmp_path / "left.cine", random_codes(rng, 8), 8)
    reader = open_frames("left.cine", tmp_path, "left")
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


def test_an_older_setup_lacks_its_later_fields(tmp_path, rng):
    codes = random_codes(rng, 8)
    write_cine(tmp_path / "left.cine", codes, 8, setup_bytes=1200)
    reader = open_frames("left.cine", tmp_path, "left")
    assert_array_equal(reader.read(0), codes[0])
    assert reader.header.exposure == pytest.approx(50e-6)  # in microseconds there


@pytest.mark.parametrize(
    ("times", "reason"),
    [(np.zeros(7), "do not belong"), (np.arange(7) / 1300, "do not belong"), (-np.arange(7) / 2000, "do not belong")],
)
def test_impossible_time_stamps_are_not_used_and_said(tmp_path, rng, times, reason):
    write_cine(tmp_path / "left.cine", random_codes(rng, 8), 8, times=times)
    reader = open_frames("left.cine", tmp_path, "left")
    assert reader.timestamps is None
    assert any(reason in note for note in reader.notes)


def test_a_recording_of_which_every_tenth_frame_was_saved_has_a_tenth_of_the_rate(tmp_path, rng):
    """The setup keeps the camera's rate; only the time stamps tell."""
    write_cine(
        tmp_path / "left.cine", random_codes(rng, 8), 8, rate=90_000, times=np.arange(7) / 9000, exposure_ns=10_000
    )
    header = open_frames("left.cine", tmp_path, "left").header
    assert (header.frame_rate, header.step) == (9000, 10)
    assert "9000 Hz (90000 Hz, one frame in 10 saved)" in header.sentence()


def test_a_gap_in_the_time_stamps_is_kept(tmp_path, rng):
    times = np.array([0, 1, 2, 3, 9, 10, 11]) / 2000
    write_cine(tmp_path / "left.cine", random_codes(rng, 8), 8, times=times)
    assert_allclose(open_frames("left.cine", tmp_path, "left").timestamps, times, atol=2**-29)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"compression": 1}, "compressed cine"),
        ({"s808": 3}, "colour recording"),
        ({"s808": 0x80000003}, "colour recording"),
        ({"packing": 512}, "biCompression 512"),
        ({"rate": 0, "times": np.arange(7.0)}, "no frame rate"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_reason(tmp_path, rng, options, reason):
    write_cine(tmp_path / "left.cine", random_codes(rng, 8), 8, **options)
    with pytest.raises(RecordingError, match=reason) as caught:
        open_frames("left.cine", tmp_path, "left")
    assert str(tmp_path) in str(caught.value)


def test_a_grey_head_of_a_colour_camera_is_grey(tmp_path, rng):
    write_cine(tmp_path / "left.cine", random_codes(rng, 8), 8, s808=0x80000000)
    assert len(open_frames("left.cine", tmp_path, "left")) == 7


@pytest.mark.parametrize(
    ("offset", "kind", "value", "reason"),
    [
        (0, "2s", b"XX", "not a cine file"),
        (20, "I", 0, "no frame"),
        (20, "I", 0xFFFFFFFF, "table of 4294967295 images"),
        (24, "I", 0xFFFFFF00, "bitmap header"),
        (28, "I", 0xFFFFFF00, "camera setup"),
        (28, "I", 0, "no camera setup"),
        (32, "I", 0xFFFFFF00, "table of 7 images"),
        (48, "i", 1 << 30, "no camera of this kind"),
        (48, "i", 40, "does not have the 960 bytes"),
        (48, "i", -32, "no camera of this kind"),
        (58, "H", 24, "colour recording"),
    ],
)
def test_a_hostile_header_is_refused_before_anything_is_made_of_its_size(tmp_path, rng, offset, kind, value, reason):
    file = write_cine(tmp_path / "left.cine", random_codes(rng, 8), 8)
    content = bytearray(file.read_bytes())
    struct.pack_into("<" + kind, content, offset, value)
    file.write_bytes(content)
    with pytest.raises(RecordingError, match=reason):
        open_frames("left.cine", tmp_path, "left")


@pytest.mark.parametrize(("bits", "packed", "largest"), KINDS)
def test_a_file_cut_short_loses_only_its_end(tmp_path, rng, bits, packed, largest):
    codes = random_codes(rng, bits)
    file = write_cine(tmp_path / "left.cine", codes, bits, packed_pixels=packed)
    each = 8 + 24 * 32 * (bits if packed else 8 if bits == 8 else 16) // 8
    os.truncate(file, file.stat().st_size - 2 * each - 1)
    reader = open_frames("left.cine", tmp_path, "left")
    assert len(reader) == 7
    assert any("lacks 3 of 7 frames" in note for note in reader.notes)
    assert_array_equal(reader.read(3), grey_of(codes[3], bits, packed))
    for index in (4, 6):
        with pytest.raises(RecordingError, match=rf"left\.cine \(left camera, frame {index}\).*copy it again"):
            reader.read(index)
    os.truncate(file, file.stat().st_size - 2 * each)
    with pytest.raises(RecordingError, match="cut short"):
        open_frames("left.cine", tmp_path, "left")


def test_a_damaged_record_is_one_lost_frame(tmp_path, rng):
    codes = random_codes(rng, 8)
    file = write_cine(tmp_path / "left.cine", codes, 8, notes=(8, 12))
    content = bytearray(file.read_bytes())
    (table,) = struct.unpack_from("<I", content, 32)
    (record,) = struct.unpack_from("<q", content, table + 8 * 4)
    content[record + 4] ^= 1  # the size behind its note of 8 bytes
    file.write_bytes(content)
    reader = open_frames("left.cine", tmp_path, "left")
    assert any("lacks 1 of 7 frames" in note for note in reader.notes)
    for index in range(7):
        if index == 4:
            with pytest.raises(RecordingError, match=r"frame 4\): there is no image of the right size"):
                reader.read(index)
        else:
            assert_array_equal(reader.read(index), codes[index])


def pair(folder: Path, rng, left=None, right=None):
    codes = random_codes(rng, 8)
    for name, options in (("left", left or {}), ("right", right or {})):
        write_cine(folder / f"{name}.cine", codes, 8, **options)
    return [open_frames(f"{name}.cine", folder, name) for name in ("left", "right")]


@pytest.mark.parametrize("declared", [2000.0, 2001.0])  # nominal, and as its clock may run
def test_cameras_that_agree_say_nothing(tmp_path, rng, declared):
    readers = pair(tmp_path, rng)
    assert check_headers(*readers, declared, "recording.toml") == ()
    assert check_time_stamps(*readers, declared) == ((), ())


LATER = np.arange(-3, 4) / 2000
LOCKED = (TRIGGER[0] & ~1, TRIGGER[1])


@pytest.mark.parametrize(
    ("left", "right", "reason"),
    [
        ({}, {"rate": 1000}, "the right camera's frames were recorded with 1000 Hz"),
        ({}, {"first_image": 9}, "begins with the camera's frame -3.*the right one with frame 9"),
        ({}, {"times": LATER + 3e-4}, "taken 0.0003 s after that of the left one.*a frame lasts 0.0005 s"),
        ({"trigger": LOCKED}, {"trigger": (LOCKED[0], LOCKED[1] + 60)}, "the common clock.*taken 60 s after"),
    ],
)
def test_frames_of_different_instants_are_an_error(tmp_path, rng, left, right, reason):
    with pytest.raises(RecordingError, match=reason):
        check_headers(*pair(tmp_path, rng, left, right), 2000.0, "recording.toml")


@pytest.mark.parametrize(
    ("right", "reason"),
    [
        ({"times": LATER + 4e-5}, "taken 40 us after the left one's"),
        ({"times": LATER * 1.009}, "drift apart by"),
        ({"times": LATER + np.array([0, 0, 0, 0, 1, 1, 1]) / 2000}, "one camera lost frames.*changes at frame 4"),
        ({"exposure_ns": 60_000}, "left 50 us, right 60 us.*lie 5 us apart"),
        ({"trigger": (TRIGGER[0], TRIGGER[1] + 3600)}, "60 minutes apart"),
    ],
)
def test_frames_that_may_not_be_simultaneous_are_a_warning(tmp_path, rng, right, reason):
    readers = pair(tmp_path, rng, {}, right)
    warnings = check_headers(*readers, 2000.0, "recording.toml") + sum(check_time_stamps(*readers, 2000.0), ())
    assert any(re.search(reason, warning) for warning in warnings)


_fuzz = settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@_fuzz
@given(kind=st.sampled_from(KINDS), data=st.data())
def test_a_file_with_any_bytes_changed_is_read_or_refused(tmp_path, kind, data):
    bits, packed, _ = kind
    images = random_codes(np.random.default_rng(1), bits, 3, 8, 8)
    file = write_cine(tmp_path / "left.cine", images, bits, packed_pixels=packed, setup_bytes=1576)
    content = bytearray(file.read_bytes())
    # places in the headers, where numbers are believed, as often as any other
    place = st.one_of(st.integers(0, 83), st.integers(84, 1800), st.integers(0, len(content) - 1))
    for at, value in data.draw(st.lists(st.tuples(place, st.sampled_from([0, 1, 127, 128, 255])), max_size=8)):
        content[at] = value
    file.write_bytes(content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content)
    try:
        reader = open_frames("left.cine", tmp_path, "left")
    except RecordingError:
        return
    assert len(reader) * reader.layout.frame_bytes <= 2 * len(content)
    for index in range(len(reader)):
        try:
            reader.read(index)
        except RecordingError:
            continue
