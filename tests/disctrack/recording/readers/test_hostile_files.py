"""Damaged, hostile and vanishing files: an error that names file and frame, never a crash or all the memory."""

import contextlib
import os
import re
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from disctrack.errors import DiscTrackError, RecordingError
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.blocks import iter_pair_blocks
from disctrack.recording.readers.decoding import decode
from tests.disctrack.recording.readers.written import (
    CAMERAS,
    EACH,
    IMAGES,
    Format,
    frames_of,
    lost_of,
    write_hdf5,
    write_tiff,
    write_video,
)

FRAMES = frames_of(8, 8, 6)
PICTURES = [kind for kind in IMAGES if kind.bits == 8]
SINGLE = [
    *(
        Format("tif", 8, write_tiff, options)
        for options in (
            {},
            {"imagej": True},
            {"compression": "zlib"},
            {"compression": "zlib", "tile": (16, 16)},
            {"bigtiff": True},
        )
    ),
    Format("h5", 8, write_hdf5, {"attributes": {"frame_rate": 1000.0}}),
    Format("h5", 8, write_hdf5, {**EACH, "chunks": (2, *FRAMES.shape[1:])}),
    *(Format(suffix, 8, write_video, {"pixels": "gray", "codec": "ffv1"}) for suffix in ("mkv", "mp4")),
    Format("avi", 8, write_video, {"pixels": "gray", "codec": "rawvideo"}),
]
each_kind = pytest.mark.parametrize("kind", [*PICTURES, *SINGLE], ids=str)


def files_in(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.is_file())


def read_all(pattern: str, folder: Path) -> int:
    """Number of frames that came back; what does not must raise an error of ours."""
    try:
        reader = open_frames(pattern, folder, "left")
    except DiscTrackError:
        return 0
    assert len(reader) < 1000
    good = 0
    for index in range(len(reader)):
        with contextlib.suppress(DiscTrackError):
            image = reader.read(index)
            assert image.shape == reader.image_size[::-1]
            good += 1
    with contextlib.suppress(DiscTrackError):
        reader.content_sha256(0, len(reader))
    return good


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """One to eight bytes changed, mostly in the header; sometimes to extremes, sometimes the rest cut off."""
    data = bytearray(content)
    reach = len(data) if rng.random() < 0.4 else min(len(data), 400)
    for place in rng.integers(0, reach, rng.integers(1, 9)):
        data[place] = rng.choice([0, 255, 127, 128, int(rng.integers(256))])
    return bytes(data[: rng.integers(1, len(data))] if rng.random() < 0.1 else data)


@pytest.mark.parametrize("kind", [*PICTURES, *SINGLE, *CAMERAS], ids=str)
def test_damaged_bytes_never_raise_anything_else_nor_take_the_memory(tmp_path, kind):
    pattern = kind.written(tmp_path, frames_of(kind.bits, 8, len(FRAMES)))
    file = files_in(tmp_path)[0]
    content, rng = file.read_bytes(), np.random.default_rng(17)
    assert read_all(pattern, tmp_path) == len(FRAMES)
    read = 0
    for _ in range(60):
        file.write_bytes(damaged(content, rng))
        tracemalloc.start()
        read += read_all(pattern, tmp_path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 300 << 20  # the frames themselves are 2 kB
    assert read < 60 * len(FRAMES)  # the damage was felt


def _tiff(width: int, height: int, offset: int = 8, next_page: int = 8) -> bytes:
    """A page whose directory points to itself, so that it seems to have very many."""
    tags = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, offset), (277, 1), (279, width * height)]
    body = b"".join(struct.pack("<HHII", tag, 4, 1, value & 0xFFFFFFFF) for tag, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + body + struct.pack("<I", next_page)


@pytest.mark.parametrize("following", [8, 1 << 31])
def test_a_chain_of_pages_that_breaks_or_turns_back_ends_there_and_says_so(tmp_path, following):
    (tmp_path / "a.tif").write_bytes(_tiff(10, 10, next_page=following) + bytes(100))
    reader = open_frames("a.tif", tmp_path, "left")
    assert len(reader) == 1
    assert "only 1 pages are whole" in reader.notes[0]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (_tiff(10, 10, offset=60, next_page=0), "100 bytes at byte 60 are announced, but the file has 110"),
        (_tiff(1 << 30, 1 << 30), "claims images of 1073741824 x 1073741824"),
        (b"II*\0" + struct.pack("<IH", 8, 65535), "damaged|announced"),
        (b"II+\0\x08\0\0\0" + struct.pack("<QQ", 16, 1 << 62), "damaged|announced"),
    ],
)
def test_tiff_headers_that_announce_what_cannot_be_are_refused(tmp_path, content, reason):
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(RecordingError, match=reason):
        open_frames("a.tif", tmp_path, "left").read(0)


def _claiming(suffix: str, width: int, height: int) -> bytes:
    """A good image of 22 x 18 px whose header claims another size."""
    data = bytearray(cv2.imencode(f".{suffix}", FRAMES[0])[1].tobytes())
    if suffix == "bmp":
        struct.pack_into("<ii", data, 18, width, height)
    elif suffix == "jpg":
        struct.pack_into(">HH", data, data.index(b"\xff\xc0") + 5, height, width)
    else:
        struct.pack_into(">II", data, 16, width, height)
        struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
    return bytes(data)


@pytest.mark.parametrize("suffix", ["png", "bmp", "jpg"])
def test_an_image_cannot_claim_more_than_its_bytes_can_hold(suffix):
    assert decode(_claiming(suffix, *FRAMES[0].T.shape), "file").shape == FRAMES[0].shape
    with pytest.raises(RecordingError, match="claims images of 30000 x 4000 px"):
        decode(_claiming(suffix, 30000, 4000), "file")


def test_hdf5_chunks_that_no_memory_holds_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", (4000, 1000, 1000), np.uint8, chunks=(1000, 1000, 1000), compression="gzip")
    with pytest.raises(RecordingError, match=r"one chunk .* holds more than 512 MB"):
        open_frames("a.h5", tmp_path, "left")


def test_an_hdf5_view_of_any_length_takes_no_memory(tmp_path):
    layout = h5py.VirtualLayout((10**12, *FRAMES.shape[1:]), np.uint8)
    layout[0] = h5py.VirtualSource("part.h5", "frame", shape=FRAMES.shape[1:])
    with h5py.File(tmp_path / "part.h5", "w") as file:
        file["frame"] = FRAMES[0]
    with h5py.File(tmp_path / "view.h5", "w") as file:
        file.create_virtual_dataset("frames", layout)
    tracemalloc.start()
    reader = open_frames("view.h5", tmp_path, "left")
    assert np.array_equal(reader.read(0), FRAMES[0])
    assert tracemalloc.get_traced_memory()[1] < 100 << 20
    tracemalloc.stop()


def test_a_playlist_under_a_videos_name_opens_no_other_file(tmp_path):
    pytest.importorskip("av")
    SINGLE[-3].written(tmp_path, FRAMES)
    (tmp_path / "list.mkv").write_text("#EXTM3U\n#EXTINF:1,\nleft.mkv\n#EXT-X-ENDLIST\n")
    with pytest.raises(RecordingError, match="not a readable video"):
        open_frames("list.mkv", tmp_path, "left")


@each_kind
def test_a_file_that_is_cut_or_deleted_while_it_is_read_costs_frames_and_names_them(tmp_path, kind):
    reader = open_frames(kind.written(tmp_path, FRAMES), tmp_path, "left")
    assert np.array_equal(reader.read(0), FRAMES[0])
    files = files_in(tmp_path)
    if kind in PICTURES:
        files[4].unlink()
    os.truncate(files[-1], files[-1].stat().st_size // 2 if kind in PICTURES else 200)
    failed = lost_of(reader, FRAMES)
    if kind in PICTURES:
        assert list(failed) == [4, 5]
        assert "shot_4" in failed[4]
        assert "cannot be read: No such file" in failed[4]
    elif (kind.suffix not in ("mkv", "mp4", "avi") and "compression" not in kind.options) or kind.suffix == "tif":
        assert failed  # a short file may lie in the library's buffer as a whole
    assert all(f"frame {index}" in text and str(tmp_path) in text for index, text in failed.items())


@pytest.mark.parametrize("kind", SINGLE, ids=str)
def test_a_single_file_that_is_deleted_while_it_is_read_loses_nothing(tmp_path, kind):
    """It stays open, and its content exists until it is closed."""
    reader = open_frames(kind.written(tmp_path, FRAMES), tmp_path, "left")
    next(tmp_path.iterdir()).unlink()
    for index in (1, 3, 5):
        assert np.array_equal(reader.read(index), FRAMES[index])
    if kind.write is write_video:  # going back opens a video anew
        with pytest.raises(RecordingError, match=rf"left\.{kind.suffix} \(left camera, frame 0\).*No such file"):
            reader.read(0)
    assert len(reader.content_sha256(0, len(FRAMES))) == 64  # what was measured can still be stored


def test_a_network_that_goes_away_is_an_error_of_the_frame(tmp_path, monkeypatch):
    reader = open_frames(SINGLE[2].written(tmp_path, FRAMES), tmp_path, "left")

    def gone(*_: object) -> int:
        raise OSError(116, "Stale file handle")

    monkeypatch.setattr(os, "preadv", gone)
    (block,) = iter_pair_blocks(reader, reader, block=len(FRAMES))
    assert len(block.unreadable) == 2 * len(FRAMES)
    assert re.search(r"left\..*left camera, frame 0.*Stale file handle", block.unreadable[0].reason)
