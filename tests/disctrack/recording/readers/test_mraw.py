"""Photron recordings give the pixels and settings that the camera wrote, or a reason in words."""

import itertools
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from disctrack.errors import RecordingError
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.base import FrameReader
from disctrack.recording.readers.blocks import iter_pair_blocks
from disctrack.recording.readers.camera_header import check_headers
from tests.oracles.camera_files import write_mraw

DEPTHS = (8, 10, 12, 16)


def random_images(rng, bits: int, n: int = 7, height: int = 24, width: int = 32) -> np.ndarray:
    return rng.integers(0, 1 << bits, (n, height, width), dtype=np.uint8 if bits == 8 else np.uint16)


@pytest.mark.parametrize("kind", ["cih", "cihx"])
@pytest.mark.parametrize("bits", DEPTHS)
def test_every_depth_returns_the_pixels_that_were_written(tmp_path, rng, bits, kind):
    images = random_images(rng, bits)
    header = write_mraw(tmp_path / "left", images, bits, kind=kind)
    for named in (header.name, "left.mraw", "left.*"):
        reader = open_frames(named, tmp_path, "left")
        assert isinstance(reader, FrameReader)
        assert (len(reader), reader.image_size, reader.bit_depth) == (7, (32, 24), bits)
        assert reader.header.saturation == (1 << bits) - 1
        out = np.zeros((24, 32), images.dtype)
        for i in range(len(reader)):
            assert_array_equal(reader.read(i), images[i])
            assert reader.read(i, out) is out
            assert_array_equal(out, images[i])


@pytest.mark.parametrize("bits", DEPTHS)
def test_blocks_of_both_cameras_hold_every_pair_in_order(tmp_path, rng, bits):
    images = np.stack([random_images(rng, bits, 23), random_images(rng, bits, 23)], axis=1)
    for camera, name in enumerate(("left", "right")):
        write_mraw(tmp_path / name, images[:, camera], bits)
    readers = [open_frames(f"{name}.cih", tmp_path, name) for name in ("left", "right")]
    blocks = [block.images.copy() for block in iter_pair_blocks(*readers, block=5, threads=3)]
    assert_array_equal(np.concatenate(blocks), images)


@pytest.mark.parametrize("bits", [8, 16])
def test_files_of_another_writer_are_read(tmp_path, rng, bits):
    py_mraw = pytest.importorskip("pyMRAW")
    images = random_images(rng, min(bits, 12))
    settings = {"Record Rate(fps)": "5000", "Shutter Speed(s)": "1/20000"}
    py_mraw.save_mraw(images, str(tmp_path / "left.cih"), bit_depth=bits, info_dict=settings)
    reader = open_frames("left.cih", tmp_path, "left")
    assert_array_equal([reader.read(i) for i in range(7)], images)
    header = reader.header
    assert (header.frame_rate, header.exposure) == (5000.0, 1 / 20000)


@pytest.mark.parametrize("kind", ["cih", "cihx"])
@pytest.mark.parametrize("bits", [8, 12, 16])
def test_another_reader_sees_the_same_pixels(tmp_path, rng, bits, kind):
    py_mraw = pytest.importorskip("pyMRAW")
    images = random_images(rng, min(bits, 12))
    header = write_mraw(tmp_path / "left", images, bits, kind=kind, depth=min(bits, 12))
    if bits == 8:
        with pytest.warns(UserWarning, match="Not 12bit"):
            theirs, _ = py_mraw.load_video(str(header))
    else:
        theirs, _ = py_mraw.load_video(str(header))
    reader = open_frames(header.name, tmp_path, "left")
    assert_array_equal([reader.read(i) for i in range(7)], theirs)


@pytest.mark.parametrize("kind", ["cih", "cihx"])
def test_settings_come_from_the_header(tmp_path, rng, kind):
    header = write_mraw(
        tmp_path / "left", random_images(rng, 12), 16, depth=12, kind=kind, Start_Frame="-40", Save_Step="4"
    )
    found = open_frames(header.name, tmp_path, "left").header
    assert (found.frame_rate, found.step) == (500.0, 4)  # of 2000 frames per second, one in four
    assert found.exposure == pytest.approx(1e-4, rel=1e-12)
    assert (found.trigger, found.first_frame, found.saturation) == ("Start", -40, 4095)
    assert found.recorded.isoformat() == "2026-01-18T11:56:13"
    assert "Mini AX200" in found.sentence()
    assert found.as_dict()["exposure"] == found.exposure


def test_bits_at_the_high_side_are_used_as_they_are(tmp_path, rng):
    images = random_images(rng, 12) << 4
    write_mraw(tmp_path / "left", images, 16, depth=12, EffectiveBit_Side="Higher")
    reader = open_frames("left.cih", tmp_path, "left")
    assert (reader.bit_depth, reader.header.saturation) == (16, 4095 << 4)
    assert_array_equal(reader.read(3), images[3])


def test_values_beyond_the_stated_depth_are_used_and_said(tmp_path, rng):
    write_mraw(tmp_path / "left", random_images(rng, 16), 16, depth=12)
    reader = open_frames("left.cih", tmp_path, "left")
    assert (reader.bit_depth, reader.header.saturation) == (16, 65535)
    assert any("grey values go up to" in note for note in reader.notes)


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"Color_Type": "Color", "Color_Bit": "24"}, "of colour type 'color'"),
        ({"Color_Type": "Raw", "Camera_Type": "FASTCAM Nova S16 type 1100K-C-64GB"}, "a colour mosaic"),
        ({"File_Format": "TIFF"}, "saved as TIFF"),
        ({"Color_Bit": "14"}, "'Color Bit' is 14"),
        ({"Image_Width": "-32"}, "'Image Width' is '-32'"),
        ({"Image_Width": "99999999", "Image_Height": "99999999"}, "99999999 x 99999999 px"),
        ({"Total_Frame": "0"}, "no frame"),
        ({"Total_Frame": "1" + "0" * 14}, "cut short"),
        ({"Total_Frame": "9" * 5000}, "expected a whole number"),
        ({"Record_Rate": "nan"}, "expected a number above 0"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_reason(tmp_path, rng, entries, reason):
    write_mraw(tmp_path / "left", random_images(rng, 8), 8, **entries)
    with pytest.raises(RecordingError, match=reason) as caught:
        open_frames("left.cih", tmp_path, "left")
    assert str(tmp_path) in str(caught.value)


def test_an_impossible_exposure_or_step_is_not_used_and_said(tmp_path, rng):
    write_mraw(tmp_path / "left", random_images(rng, 8), 8, Shutter_Type2="900000", Save_Step="2500")
    reader = open_frames("left.cih", tmp_path, "left")
    assert reader.header.exposure is None
    assert reader.header.frame_rate == 2000
    assert any("longer than a frame" in note for note in reader.notes)
    assert any("taken as consecutive" in doubt for doubt in reader.doubts)


def test_header_and_frames_must_lie_together(tmp_path, rng):
    header = write_mraw(tmp_path / "left", random_images(rng, 8), 8)
    header.rename(tmp_path / "kept")
    with pytest.raises(RecordingError, match=r"there is no left\.cihx or \.cih beside it"):
        open_frames("left.mraw", tmp_path, "left")
    (tmp_path / "kept").rename(header)
    (tmp_path / "left.mraw").unlink()
    with pytest.raises(RecordingError, match=r"there is no left\.mraw beside it"):
        open_frames("left.cih", tmp_path, "left")
    write_mraw(tmp_path / "left", random_images(rng, 8), 8)
    write_mraw(tmp_path / "left_2", random_images(rng, 8), 8)
    with pytest.raises(RecordingError, match="name one recording"):
        open_frames("left*.cih", tmp_path, "left")


@pytest.mark.parametrize("bits", DEPTHS)
def test_a_file_cut_short_loses_only_its_end(tmp_path, rng, bits):
    images = random_images(rng, bits)
    write_mraw(tmp_path / "left", images, bits)
    file = tmp_path / "left.mraw"
    os.truncate(file, file.stat().st_size * 5 // 7 - 1)
    reader = open_frames("left.cih", tmp_path, "left")
    assert len(reader) == 7
    assert any("lacks 3 of 7 frames" in note for note in reader.notes)
    assert_array_equal(reader.read(3), images[3])
    for index in (4, 6):
        with pytest.raises(RecordingError, match=rf"left\.mraw \(left camera, frame {index}\).*copy it again"):
            reader.read(index)
    os.truncate(file, file.stat().st_size // 2)
    with pytest.raises(RecordingError, match="cut short"):
        open_frames("left.cih", tmp_path, "left")


def test_a_file_cut_short_in_mid_run_is_lost_frames_not_the_end_of_the_process(tmp_path, rng):
    for name in ("left", "right"):
        write_mraw(tmp_path / name, random_images(rng, 12, 9), 12)
    readers = [open_frames(f"{name}.cih", tmp_path, name) for name in ("left", "right")]
    os.truncate(tmp_path / "right.mraw", 4 * 24 * 32 * 12 // 8)
    (block,) = iter_pair_blocks(*readers)
    assert {(image.frame, image.camera) for image in block.unreadable} == set(itertools.product(range(4, 9), [1]))


@pytest.mark.parametrize("bits", [8, 12])
def test_the_content_hash_tells_a_changed_frame_and_only_that(tmp_path, rng, bits):
    write_mraw(tmp_path / "left", random_images(rng, bits), bits)
    before = open_frames("left.cih", tmp_path, "left")
    hashes = before.content_sha256(0, 7), before.content_sha256(4, 7)
    file = tmp_path / "left.mraw"
    content = bytearray(file.read_bytes())
    content[24 * 32 * bits // 8 * 3 + 5] ^= 1
    file.write_bytes(content)
    after = open_frames("left.cih", tmp_path, "left")
    assert after.content_sha256(0, 7) != hashes[0]
    assert after.content_sha256(4, 7) == hashes[1]


def pair(folder: Path, rng, left: dict[str, str] | None = None, right: dict[str, str] | None = None):
    images = random_images(rng, 8)
    for name, entries in (("left", left or {}), ("right", right or {})):
        write_mraw(folder / name, images, 8, **entries)
    return [open_frames(f"{name}.cih", folder, name) for name in ("left", "right")]


def test_headers_that_agree_say_nothing(tmp_path, rng):
    assert check_headers(*pair(tmp_path, rng), 2000.0, "recording.toml") == ()


@pytest.mark.parametrize(
    ("left", "right", "declared", "reason"),
    [
        ({}, {}, 1000.0, r"frame_rate_hz is 1000, but the left camera's frames were recorded with 2000 Hz.*left\.cih"),
        ({}, {"Record_Rate": "1000"}, 2000.0, "the right camera's frames were recorded with 1000 Hz"),
        ({}, {"Save_Step": "2"}, 2000.0, r"1000 Hz \(2000 Hz, one frame in 2 saved\)"),
        ({"Record_Rate": "2000.4"}, {}, 2000.0, "does not show the same instant"),
        ({"Start_Frame": "12"}, {}, 2000.0, "begins with the camera's frame 12.*the right one with frame 0"),
    ],
)
def test_headers_that_exclude_each_other_are_an_error(tmp_path, rng, left, right, declared, reason):
    with pytest.raises(RecordingError, match=reason):
        check_headers(*pair(tmp_path, rng, left, right), declared, "recording.toml")


@pytest.mark.parametrize(
    ("right", "reason"),
    [
        ({"Trigger_Mode": "Manual", "Start_Frame": "7"}, "triggered in different modes: left Start, right Manual"),
        ({"Shutter_Type2": "200000"}, "left 100 us, right 200 us.*lie 50 us apart"),
        ({"Date": "2026/1/19"}, "1440 minutes apart"),
    ],
)
def test_headers_that_leave_doubt_are_a_warning(tmp_path, rng, right, reason):
    (warning,) = check_headers(*pair(tmp_path, rng, {}, right), 2000.0, "recording.toml")
    assert re.search(reason, warning)


_fuzz = settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def opened_or_refused(folder: Path, header: Path, size: int) -> None:
    """Whatever the header says: an answer that the file can hold, or a reason."""
    try:
        reader = open_frames(header.name, folder, "left")
    except RecordingError:
        return
    assert len(reader) <= 2 * size
    for index in {0, len(reader) - 1}:
        try:
            assert reader.read(index).nbytes <= 2 * size
        except RecordingError:
            continue


@_fuzz
@given(kind=st.sampled_from(["cih", "cihx"]), bits=st.sampled_from(DEPTHS), data=st.data())
def test_a_header_with_any_bytes_changed_is_read_or_refused(tmp_path, kind, bits, data):
    images = random_images(np.random.default_rng(1), bits, 3, 8, 8)
    header = write_mraw(tmp_path / "left", images, bits, kind=kind)
    content = bytearray(header.read_bytes())
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)))):
        content[place] = value
    header.write_bytes(content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content)
    opened_or_refused(tmp_path, header, images.nbytes)


@pytest.mark.statistical
@_fuzz
@given(
    kind=st.sampled_from(["cih", "cihx"]),
    name=st.sampled_from(
        ["Total_Frame", "Image_Width", "Image_Height", "Color_Bit", "EffectiveBit_Depth", "Save_Step", "Record_Rate"]
    ),
    value=st.one_of(st.integers().map(str), st.floats().map(str), st.text(max_size=20), st.just("9" * 400)),
)
def test_a_header_with_any_value_is_read_or_refused(tmp_path, kind, name, value):
    images = random_images(np.random.default_rng(1), 8, 3, 8, 8)
    header = write_mraw(tmp_path / "left", images, 8, kind=kind, **{name: value})
    opened_or_refused(tmp_path, header, images.nbytes)


def test_a_header_of_nested_or_expanding_xml_costs_nothing(tmp_path, rng):
    header = write_mraw(tmp_path / "left", random_images(rng, 8), 8, kind="cihx")
    bomb = b'<!DOCTYPE cih [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'
    for content in (bomb + b"<cih>&b;</cih>", b"<cih>" + bomb + b"&b;</cih>", b"<cih>" + b"<a>" * 20_000 + b"</cih>"):
        header.write_bytes(content)
        with pytest.raises(RecordingError, match="the XML in it is damaged"):
            open_frames("left.cihx", tmp_path, "left")
    header.write_bytes(b"<cih>" + b"<a>" * 20_000 + b"</a>" * 20_000 + b"</cih>")
    with pytest.raises(RecordingError, match="saved as nothing known"):
        open_frames("left.cihx", tmp_path, "left")


@settings(max_examples=60, deadline=None)
@given(bits=st.sampled_from([10, 12]), groups=st.integers(1, 40), seed=st.integers(0, 2**32 - 1))
def test_packed_pixels_are_the_digits_of_one_large_number(tmp_path_factory, bits, groups, seed):
    folder = tmp_path_factory.mktemp("packed")
    images = np.random.default_rng(seed).integers(0, 1 << bits, (1, 2, 2 * groups), dtype=np.uint16)
    write_mraw(folder / "left", images, bits)
    assert_array_equal(open_frames("left.cih", folder, "left").read(0), images[0])
