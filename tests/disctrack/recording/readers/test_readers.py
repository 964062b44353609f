"""Frames reach the measurement in order, without loss, in bounded memory; what cannot be read or be meant is named."""

import gc
import threading
import zlib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from disctrack import FrameReader, iter_pair_blocks, open_frames
from disctrack.errors import RecordingError
from disctrack.recording.readers.decoding import decode
from disctrack.recording.readers.same_instants import check_same_numbers, check_time_stamps, usable_times
from tests.disctrack.recording.readers.written import assert_refused, write_sequence


@pytest.fixture
def frames(rng):
    return rng.integers(0, 256, (11, 2, 24, 32), dtype=np.uint8)


@pytest.fixture
def pair(tmp_path, frames):
    for camera, name in enumerate(("left", "right")):
        write_sequence(tmp_path / name, frames[:, camera])
    return tmp_path


def open_pair(folder: Path) -> tuple[FrameReader, FrameReader]:
    return open_frames("left/*", folder, "left"), open_frames("right/*", folder, "right")


def collect(readers, **how):
    blocks = [(b.frames, b.images.copy(), b.unreadable) for b in iter_pair_blocks(*readers, **how)]
    numbers, images = (np.concatenate([block[i] for block in blocks]) for i in (0, 1))
    return numbers, images, [(*place, reason) for block in blocks for place, reason in block[2].items()]


@pytest.mark.parametrize("channels", [3, 4])
def test_grey_stored_as_colour_is_read_without_loss_and_said(tmp_path, frames, channels):
    code = {3: cv2.COLOR_GRAY2BGR, 4: cv2.COLOR_GRAY2BGRA}[channels]
    write_sequence(tmp_path / "left", [cv2.cvtColor(image, code) for image in frames[:, 0]])
    reader = open_frames("left/*", tmp_path, "left")
    assert_array_equal(reader.read(5), frames[5, 0])
    assert any("channels of equal value" in note for note in reader.notes)


@pytest.mark.parametrize(
    ("dtype", "channels", "suffix", "reason"),
    [("uint8", 3, "png", "a colour image"), ("float32", 1, "tiff", "float32")],
)
def test_pixels_that_are_no_grey_values_are_refused(tmp_path, rng, dtype, channels, suffix, reason):
    images = (200 * rng.random((2, 24, 32, channels))).astype(dtype)
    write_sequence(tmp_path / "left", images, suffix)
    assert_refused(tmp_path, "left/*", rf"none of the 2 left frames can be read.*{reason}")


@pytest.mark.parametrize("gone", [range(2, 9), [1, 2, 3, 5, 8], [9]])
def test_a_gap_in_the_numbers_is_as_many_lost_frames_whatever_its_size(tmp_path, frames, gone):
    files = write_sequence(tmp_path / "left", frames[:, 0])
    for i in gone:
        files[i].unlink()
    reader = open_frames("left/*.png", tmp_path, "left")
    assert len(reader) == 11
    assert_array_equal(reader.read(10), frames[10, 0])
    with pytest.raises(RecordingError, match=f"frame {gone[0]}"):
        reader.read(gone[0])
    assert any(f"{len(gone)} file" in note and "missing" in note for note in reader.notes)


def test_numbers_in_steps_are_consecutive_frames_and_in_doubt(tmp_path, frames):
    files = write_sequence(tmp_path / "left", frames[:, 0], names=[f"{10 * i:05d}" for i in range(11)])
    files[4].unlink()
    reader = open_frames("left/*.png", tmp_path, "left")
    assert len(reader) == 11
    assert_array_equal(reader.read(5), frames[5, 0])
    assert any("steps of 10" in doubt for doubt in reader.doubts)


@pytest.mark.parametrize("stray", ["Copy of 000005", "000005 (1)", "000005_1", "background", "frame_000011"])
def test_a_file_that_is_not_named_like_the_others_is_named_not_measured(tmp_path, frames, stray):
    write_sequence(tmp_path / "left", frames[:, 0])
    write_sequence(tmp_path / "left", frames[:1, 0], names=[stray])
    with pytest.raises(RecordingError) as caught:
        open_frames("left/*.png", tmp_path, "left")
    assert f"{stray}.png: not named like the other 11 left frames" in str(caught.value)


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (["7", "07", "8"], "two left frames of number 7"),
        (["a", "b", "c"], "hold no number"),
        ([f"cam_{t}" for t in (1000013, 1001021, 1001998, 1003004, 1004017)], "no common step.*time stamps"),
        ([f"2026-11-22_10-15-59.{t}" for t in (310, 411, 509, 613)], "no common step"),
        ([f"take{take}_{i}" for take in (1, 2) for i in range(3)], "two left frames of number 0"),
        (["0", "1", "20261122"], "no common step"),
        (["1_1", "2_2", "4_3", "5_5"], "several numbers"),  # which of them tells the lost frame?
    ],
)
def test_names_that_are_no_clock_stop_the_run(tmp_path, frames, names, reason):
    write_sequence(tmp_path / "left", frames[: len(names), 0], names=names)
    assert_refused(tmp_path, "left/*.png", reason)


def test_a_counter_beside_a_time_stamp_is_found_or_told_by_the_pattern(tmp_path, frames):
    stamps = np.cumsum([7, 998, 1003, 1000, 2001, 997])
    names = [f"cam2_{stamp}_{i}" for stamp, i in zip(stamps, (0, 1, 2, 3, 5, 6), strict=True)]
    write_sequence(tmp_path / "left", frames[:6, 0], names=names)
    assert len(open_frames("left/*.png", tmp_path, "left")) == 7
    assert len(open_frames("left/cam2_*_{number}.png", tmp_path, "left")) == 7
    assert_refused(tmp_path, "left/cam{number}_*.png", "two left frames of number 2")


@pytest.mark.parametrize(
    ("theirs", "verdict"),
    [(range(11), None), (range(100, 111), "as pairs"), (range(1, 12), "equal numbers"), (range(0, 22, 2), "equal")],
)
def test_equal_numbers_are_the_same_instant(tmp_path, frames, theirs, verdict):
    write_sequence(tmp_path / "left", frames[:, 0])
    write_sequence(tmp_path / "right", frames[:, 1], names=[f"{i:06d}" for i in theirs])
    left, right = (open_frames(f"{camera}/*.png", tmp_path, camera) for camera in ("left", "right"))
    if verdict is not None and verdict.startswith("equal"):
        with pytest.raises(RecordingError, match=verdict):
            list(check_same_numbers(left, right))
    else:
        assert [verdict in doubt for doubt in check_same_numbers(left, right)] == ([True] if verdict else [])


def test_a_range_of_frames_is_read_alone(pair, frames):
    numbers, images, _ = collect(open_pair(pair), start=3, stop=8, block=2)
    assert_array_equal(numbers, np.arange(3, 8))
    assert_array_equal(images, frames[3:8])
    assert list(iter_pair_blocks(*open_pair(pair), start=5, stop=5)) == []


def test_a_caller_that_stops_early_leaves_no_thread_behind(pair):
    blocks = iter_pair_blocks(*open_pair(pair), block=2)
    next(blocks)
    blocks.close()
    gc.collect()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("read")]


def _truncate(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _flip(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 0x55]) + content[middle + 1 :]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [(_truncate, "truncated"), (_flip, "checksum"), (lambda c: b"", "empty"), (lambda c: b"text", "not a readable")],
)
@pytest.mark.parametrize(("camera", "frame"), [("right", 6), ("left", 0)])
def test_a_damaged_image_is_named_and_the_others_are_delivered(pair, frames, capfd, damage, reason, camera, frame):
    file = pair / camera / f"{frame:06d}.png"
    file.write_bytes(damage(file.read_bytes()))
    _, images, ((at, side, told),) = collect(open_pair(pair), block=4)
    assert (at, ("left", "right")[side]) == (frame, camera)
    assert all(part in told for part in (file.name, f"{camera} camera", reason))
    expected = frames.copy()
    expected[frame, side] = 0
    assert_array_equal(images, expected)
    assert "libpng" not in capfd.readouterr().err


def test_a_truncated_jpeg_is_not_half_an_image(tmp_path, frames):
    files = write_sequence(tmp_path / "left", [cv2.GaussianBlur(image, (0, 0), 2) for image in frames[:, 0]], "jpg")
    files[3].write_bytes(_truncate(files[3].read_bytes()))
    with pytest.raises(RecordingError, match=r"frame 3.*truncated"):
        open_frames("left/*", tmp_path, "left").read(3)


def test_a_frame_of_another_size_or_depth_is_refused(tmp_path, frames):
    files = write_sequence(tmp_path / "left", frames[:, 0])
    cv2.imwrite(str(files[7]), frames[7, 0, :20])
    cv2.imwrite(str(files[8]), frames[8, 0].astype(np.uint16))
    reader = open_frames("left/*", tmp_path, "left")
    for index, found in ((7, "32 x 20"), (8, "16 bit")):
        with pytest.raises(RecordingError, match=f"frame {index}.*{found}"):
            reader.read(index)


@settings(max_examples=150, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    sixteen=st.booleans(),
    kinds=st.lists(st.integers(0, 4), min_size=9, max_size=9),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_png_row_filter_is_undone_as_libpng_does(shape, sixteen, kinds, seed):
    height, width = shape
    stride = width * (2 if sixteen else 1)
    rows = np.random.default_rng(seed).integers(0, 256, (height, stride + 1), dtype=np.uint8)
    rows[:, 0] = kinds[:height]
    content = _png(width, height, 16 if sixteen else 8, zlib.compress(rows.tobytes()))
    out = np.zeros(shape, np.uint16 if sixteen else np.uint8)
    assert decode(content, "file", out) is out
    assert_array_equal(out, cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED))


def _png(width: int, height: int, depth: int, compressed: bytes) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([depth, 0, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", compressed) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("rows", "flipped"), [(3, 0), (5, 0), (4, 1)])
def test_png_pixels_too_few_or_too_many_or_of_a_wrong_checksum_are_refused(rows, flipped):
    compressed = bytearray(zlib.compress(bytes(9 * rows)))
    compressed[-1] ^= flipped
    with pytest.raises(RecordingError, match="damaged"):
        decode(_png(8, 4, 8, bytes(compressed)), "file")


RATE, N = 1000.0, 400
EVEN = 17.25 + np.arange(N) / RATE


def warnings_of(left, right=EVEN) -> tuple[str, ...]:
    readers = [
        SimpleNamespace(camera=name, timestamps=stamps, header=None)
        for name, stamps in (("left", left), ("right", right))
    ]
    return tuple(finding.text for finding in check_time_stamps(*readers, RATE))


def without(times: np.ndarray, *lost: int) -> np.ndarray:
    """Times of a camera that lost these frames; as many frames as before."""
    return np.delete(17.25 + np.arange(N + len(lost)) / RATE, lost)


def test_cameras_that_run_together_are_not_warned_of(rng):
    jitter = rng.normal(scale=5e-7, size=N)  # a twentieth of what counts
    assert warnings_of(EVEN, EVEN + jitter) == ()
    assert warnings_of(None) == ()
    assert usable_times(SimpleNamespace(timestamps=EVEN), RATE) is EVEN


@pytest.mark.parametrize(
    ("times", "reason"),
    [
        (1e3 * EVEN, "give 1 frames/s, frame_rate_hz of 1000"),
        (np.where(np.arange(N) == 31, np.nan, EVEN), "frame 31 is not a number"),
        (np.where(np.arange(N) == 31, EVEN[30], EVEN), "do not increase from frame 30 to 31"),
        (EVEN * 1.02, "give 980.392 frames/s"),
    ],
)
def test_stamps_that_cannot_be_meant_are_not_used_and_why_is_said(times, reason):
    (warning,) = warnings_of(times)
    assert "left camera: time stamps are not used" in warning
    assert reason in warning
    assert usable_times(SimpleNamespace(timestamps=times), RATE) is None


def test_frames_lost_by_both_cameras_together_are_counted_and_numbered():
    both = without(EVEN, 101, 102, 300)
    left, right = warnings_of(both, both)
    assert left == "left camera: by its time stamps 3 frames missing, after frame 100, 297"
    assert right.startswith("right camera")


def test_a_frame_lost_by_one_camera_alone_parts_the_pairs_from_there_on():
    lost, parted = warnings_of(EVEN, without(EVEN, 101))
    assert "right camera: by its time stamps 1 frame missing, after frame 100" in lost
    assert "does not show the same instant from frame 101 on" in parted
    *_, parted = warnings_of(without(EVEN, 200), without(EVEN, 101))
    assert "from frame 101 on" in parted
    assert "at frame 101, 200)" in parted


@pytest.mark.parametrize("offset", [2.5e-4, -0.3])
def test_a_constant_offset_is_measured(offset):
    (warning,) = warnings_of(EVEN, EVEN + offset)
    assert f"{1e6 * offset:.4g} µs after" in warning


def test_clocks_of_their_own_are_told_by_their_drift_and_jitter_by_its_worst_frame():
    (drift,) = warnings_of(EVEN, EVEN[0] + (EVEN - EVEN[0]) * (1 + 4e-5) - 8e-6)
    assert "drift apart by +40 µs per second" in drift
    (jitter,) = warnings_of(EVEN, EVEN + np.where(np.arange(N) == 222, 1e-4, 0))
    assert "most at frame 222: +99" in jitter
