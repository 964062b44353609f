"""Every format gives back what another library wrote; what is lost or damaged is named and takes no memory."""

import contextlib
import os
import re
import struct
import tracemalloc
import zlib
from pathlib import Path
from unittest.mock import Mock

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from disctrack import DiscTrackError, FrameReader, iter_pair_blocks, open_frames
from disctrack.errors import RecordingError
from disctrack.recording.readers.decoding import decode
from tests.disctrack.recording.readers.written import (
    CAMERAS,
    EACH,
    FORMATS,
    HEIGHT,
    IMAGES,
    STACKS,
    TIFFS,
    VIDEOS,
    WIDTH,
    Format,
    N,
    assert_refused,
    frames_of,
    lost_of,
    picture_of,
    write_hdf5,
    write_pictures,
    write_tiff,
    write_video,
)


@pytest.mark.parametrize("kind", FORMATS, ids=str)
def test_frames_come_back_as_they_were_written_in_any_order(tmp_path, kind):
    frames, folder = frames_of(kind.bits), tmp_path / "run [1]"  # no pattern
    folder.mkdir()
    reader = open_frames(kind.written(folder, frames), folder, "left")
    assert isinstance(reader, FrameReader)
    assert (len(reader), reader.image_size, reader.bit_depth) == (N, (WIDTH, HEIGHT), kind.bits)
    for index in (*range(N), 17, 3, N - 1, 0, 20, 21, 5):
        assert_array_equal(reader.read(index), frames[index])
    out = np.zeros_like(frames[0])
    assert reader.read(4, out) is out
    assert_array_equal(out, frames[4])
    told = " ".join(reader.notes)
    assert ("not stretched" in told) == ("gray" not in kind.options.get("pixels", "gray"))


@pytest.mark.parametrize("kind", [IMAGES[0], TIFFS[0], STACKS[3], CAMERAS[0], *VIDEOS], ids=str)
def test_blocks_of_both_cameras_hold_every_pair_once_and_in_order(tmp_path, kind):
    both = [frames_of(kind.bits, seed) for seed in (1, 2)]
    readers = [
        open_frames(kind.written(tmp_path, frames, name), tmp_path, name)
        for name, frames in zip(("left", "right"), both, strict=True)
    ]
    for size, threads in ((1, 3), (4, 2), (N, 3), (50, 1)):
        seen = []
        for block in iter_pair_blocks(*readers, block=size, threads=threads):
            assert not block.unreadable
            for camera, frames in enumerate(both):
                assert_array_equal(block.images[:, camera], frames[block.frames])
            seen.extend(block.frames)
        assert seen == list(range(N))


@pytest.mark.parametrize(
    "kind", [IMAGES[0], TIFFS[0], TIFFS[4], *STACKS, CAMERAS[0], *(k for k in VIDEOS if k.suffix == "mkv")], ids=str
)
def test_the_content_hash_tells_a_changed_frame_and_nothing_else(tmp_path, kind):
    frames = frames_of(kind.bits)
    changed = frames.copy()
    changed[7, 3, 4] ^= 1
    found = []
    for name, content in (("a", frames), ("b", frames), ("c", changed)):
        (tmp_path / name).mkdir()
        reader = open_frames(kind.written(tmp_path / name, content), tmp_path / name, "left")
        if name == "b":  # computed while reading, or apart
            assert lost_of(reader, content) == {}
        found.append((reader.content_sha256(0, N), reader.content_sha256(0, 5)))
    if kind.suffix != "mkv":  # a container has an identity of its own
        assert found[0] == found[1]
        assert found[0][1] == found[2][1]
    assert found[0][0] != found[2][0]


@pytest.mark.parametrize("kind", FORMATS, ids=str)
def test_a_file_cut_short_loses_its_end_and_says_so(tmp_path, kind):
    frames = frames_of(kind.bits)
    pattern = kind.written(tmp_path, frames)
    path = tmp_path / f"left.{kind.suffix}".replace("cihx", "mraw").replace("cih", "mraw")
    path = tmp_path / "left" / f"shot_{N - 1}.{kind.suffix}" if kind in IMAGES else path
    content = path.read_bytes()
    path.write_bytes(content[: -int(0.3 * frames.nbytes)] if kind in CAMERAS else content[: int(0.6 * len(content))])
    try:
        reader = open_frames(pattern, tmp_path, "left")
    except RecordingError:
        assert kind.suffix in ("h5", "mp4") or "compress" in kind.options  # the table of all frames stands at the end
        return
    lost = lost_of(reader, frames)
    assert all(path.name in text and f"left camera, frame {index}" in text for index, text in lost.items())
    assert list(lost) == list(range(len(reader) - len(lost), len(reader)))  # the end, and nothing else
    assert len(reader) - len(lost) < N
    assert len(reader) < N or lost
    if kind in CAMERAS or (kind.suffix == "tif" and kind not in IMAGES and not lost):
        assert any("pages are whole" in note or f"lacks {len(lost)} of {N} frames" in note for note in reader.notes)
    if kind in CAMERAS:
        path.write_bytes(content[: -int(0.6 * frames.nbytes)])
        assert_refused(tmp_path, pattern, "cut short")


def test_several_tiff_files_of_one_camera_continue_one_another(tmp_path):
    frames = frames_of(16)
    for number, part in enumerate((frames[:13], frames[13:14], frames[14:])):
        write_tiff(tmp_path / f"left_{number}.tif", part)
    reader = open_frames("left_*.tif", tmp_path, "left")
    assert len(reader) == N
    assert lost_of(reader, frames) == {}


def test_the_frame_rate_and_times_that_imagej_ome_and_hdf5_note_are_found(tmp_path):
    times = np.arange(N) * 1e-3 + np.where(np.arange(N) > 9, 2e-3, 0)
    write_tiff(tmp_path / "imagej.tif", frames_of(8), imagej=True, metadata={"finterval": 0.0005})
    planes = {"DeltaT": list(1e3 * times), "DeltaTUnit": ["ms"] * N}
    ome = {"axes": "TYX", "TimeIncrement": 1.0, "TimeIncrementUnit": "ms", "Plane": planes}
    write_tiff(tmp_path / "notes.ome.tif", frames_of(8), metadata=ome)
    write_hdf5(tmp_path / "stack.h5", frames_of(8), {"frame_rate": 1000, "timestamps": times})
    assert open_frames("imagej.tif", tmp_path, "left").frame_rate == pytest.approx(2000)
    for name in ("notes.ome.tif", "stack.h5:/camera/frames", "stack.h5"):
        reader = open_frames(name, tmp_path, "left")
        assert reader.frame_rate == pytest.approx(1000)
        assert_allclose(reader.timestamps, times, rtol=0, atol=1e-12)  # decimal text of milliseconds
    write_hdf5(tmp_path / "short.h5", frames_of(8), {"timestamps": times[1:]})
    assert_refused(tmp_path, "short.h5", rf"timestamps are \({N - 1},\) of float64; expected {N} times in s")


@pytest.mark.parametrize(("declared", "found"), [(12, 12), (8, 16), (99, 16), ("many", 16)])
def test_a_bit_depth_that_cannot_be_is_not_believed(tmp_path, declared, found):
    write_hdf5(tmp_path / "stack.h5", frames_of(12), {"bit_depth": declared})
    reader = open_frames("stack.h5", tmp_path, "left")
    assert reader.bit_depth == found
    (block,) = iter_pair_blocks(reader, reader, block=N)
    assert_array_equal(block.images[:, 0], frames_of(12))


def test_one_of_several_data_sets_must_be_named(tmp_path):
    with h5py.File(tmp_path / "both.h5", "w") as file:
        file["left"], file["right"] = frames_of(8, 1), frames_of(8, 2)
        file["mask"] = np.ones((HEIGHT, WIDTH), np.uint8)
    assert_refused(tmp_path, "both.h5", r"several stacks.*/left, /right")
    assert_refused(tmp_path, "both.h5:/mask", r"both\.h5:/mask is .* of uint8; expected.*There are /left, /right")
    assert_array_equal(open_frames("both.h5:/right", tmp_path, "right").read(3), frames_of(8, 2)[3])


def test_hdf5_frames_that_were_never_written_are_not_taken_for_black_and_what_cannot_be_read_is_refused(tmp_path):
    frames = frames_of(8)
    with h5py.File(tmp_path / "stack.h5", "w") as file:
        late = file.create_dataset("late", (N, HEIGHT, WIDTH), np.uint8, chunks=(3, 10, WIDTH))
        late[:9], late[12:27] = frames[:9], frames[12:27]
        late[27:, :10] = frames[27:, :10]  # the upper rows alone
        huge = file.create_dataset("huge", (10**15, HEIGHT, WIDTH), np.uint8, chunks=(1, HEIGHT, WIDTH))
        huge[:2] = frames[:2]
        file.create_dataset("empty", (N, HEIGHT, WIDTH), np.uint8)
        chunks = {"chunks": (1000, 1000, 1000), "compression": "gzip"}  # that no memory holds
        file.create_dataset("wide", (4000, 1000, 1000), np.uint8, **chunks)
    reader = open_frames("stack.h5:/late", tmp_path, "left")
    lost = lost_of(reader, frames)
    assert list(lost) == [9, 10, 11, 27, 28, 29]
    assert all(re.search(f"frame {index}.*never written", text) for index, text in lost.items())
    refused = {"huge": "announces 1000000000000000 frames, but at most 2 ", "empty": "at most 0 were ever written"}
    refused["wide"] = r"one chunk .* holds more than 512 MB"
    for name, said in refused.items():
        assert_refused(tmp_path, f"stack.h5:/{name}", said)


def test_hdf5_frames_that_lie_in_other_files_are_those_or_refused(tmp_path):
    layout = h5py.VirtualLayout((4, 6, 8), np.uint8)
    frames = np.arange(4 * 6 * 8, dtype=np.uint8).reshape(4, 6, 8)
    for i, frame in enumerate(frames):
        with h5py.File(tmp_path / f"part{i}.hdf", "w") as file:
            file["frame"] = frame
        layout[i] = h5py.VirtualSource(f"part{i}.hdf", "frame", shape=(6, 8))
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        file.create_virtual_dataset("frames", layout)
    with h5py.File(tmp_path / "external.h5", "w") as file:
        place = [(str(tmp_path / "pixels.bin"), 16, h5py.h5f.UNLIMITED)]
        file.create_dataset("frames", frames.shape, np.uint8, external=place)[...] = frames
    assert lost_of(open_frames("virtual.h5", tmp_path, "left"), frames) == {}
    (tmp_path / "part2.hdf").unlink()
    assert_refused(tmp_path, "virtual.h5", r"takes frames from part2\.hdf, which is not there")
    assert_refused(tmp_path, "external.h5", r"its pixels lie in .*pixels\.bin\. Write them into")


@pytest.mark.parametrize("packed", [False, True])
def test_hdf5_pixels_that_do_not_fill_their_bytes_are_those_that_the_library_reads(tmp_path, packed):
    frames = np.random.default_rng(3).integers(0, 4096, (4, 9, 14)).astype(np.uint16)
    kind, options = h5py.h5t.STD_U16LE.copy(), h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    kind.set_precision(12)
    kind.set_offset(4)
    if packed:
        options.set_chunk((1, 9, 14))
        options.set_shuffle()
        options.set_deflate(4)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        stack = h5py.h5d.create(file.id, b"frames", kind, h5py.h5s.create_simple(frames.shape), options)
        stack.write(h5py.h5s.ALL, h5py.h5s.ALL, frames)
    reader = open_frames("a.h5", tmp_path, "left")
    assert lost_of(reader, frames) == {}


def bitmaps_in_avi(frames, palette, top_down):
    """An AVI file of frames (n, height, width) uint8 as uncompressed bitmaps, by Microsoft's description (1992)."""
    n, height, width = frames.shape
    rows = -(-width // 4) * 4
    padded = np.pad(frames, ((0, 0), (0, 0), (0, rows - width)))
    pictures = [picture.tobytes() for picture in (padded if top_down else padded[:, ::-1])]

    def chunk(kind, content):
        return kind + struct.pack("<I", len(content)) + content + bytes(len(content) % 2)

    def listed(kind, *content):
        return chunk(b"LIST", kind + b"".join(content))

    size = rows * height
    info = struct.pack("<IiiHHIIiiII", 40, width, -height if top_down else height, 1, 8, 0, size, 0, 0, 0, 0) + palette
    stream = b"vidsDIB " + struct.pack("<IHHIIIIIIIIhhhh", 0, 0, 0, 0, 1, 25, 0, n, size, 0, 0, 0, 0, width, height)
    head = struct.pack("<IIIIIIIIIIIIII", 40000, 0, 0, 0, n, 0, 1, size, width, height, 0, 0, 0, 0)
    streams = listed(b"strl", chunk(b"strh", stream), chunk(b"strf", info))
    movie = listed(b"movi", *(chunk(b"00db", picture) for picture in pictures))
    return chunk(b"RIFF", b"AVI " + listed(b"hdrl", chunk(b"avih", head), streams) + movie)


@pytest.mark.parametrize("top_down", [False, True])
@pytest.mark.parametrize("width", [68, 69])
def test_bitmaps_in_avi_stand_upright_whatever_their_palette(tmp_path, width, top_down):
    frames = np.random.default_rng(5).integers(0, 256, (4, 11, width)).astype(np.uint8)
    level = np.arange(256, dtype=np.uint8)[:, None]
    grey = np.concatenate([level, level, level, 0 * level], axis=1)
    for palette, expected in ((grey, frames), (grey[::-1], ~frames), (grey[:0], frames)):
        (tmp_path / "a.avi").write_bytes(bitmaps_in_avi(frames, palette.tobytes(), top_down))
        reader = open_frames("a.avi", tmp_path, "left")
        assert lost_of(reader, expected) == {}
    colours = np.concatenate([level, 255 - level, level, 0 * level], axis=1)
    (tmp_path / "a.avi").write_bytes(bitmaps_in_avi(frames, colours.tobytes(), top_down))
    assert_refused(tmp_path, "a.avi", "a colour image")


def test_frames_that_a_recorder_dropped_are_named(tmp_path):
    pytest.importorskip("av")
    pictures = [picture_of(frame, "gray") for frame in frames_of(8)]
    for time, picture in zip([*range(12), *range(14, 32)], pictures, strict=True):
        picture.pts = time
    write_pictures(tmp_path / "left.mkv", pictures, "ffv1")
    (doubt,) = open_frames("left.mkv", tmp_path, "left").doubts
    assert "after frame 11: 2 frames" in doubt


@pytest.mark.parametrize("place", [0.02, 0.3, 0.5, 0.9])
def test_a_damaged_packet_costs_its_frames_up_to_the_next_key_frame_and_no_other(tmp_path, place):
    av = pytest.importorskip("av")
    frames = frames_of(8)
    write_video(tmp_path / "left.mkv", frames, "gray", "ffv1", g="5", level="3", slicecrc="1")
    with av.open(str(tmp_path / "left.mkv")) as container:
        packet = [packet for packet in container.demux(video=0) if packet.size][12]
    content = bytearray((tmp_path / "left.mkv").read_bytes())
    content[packet.pos + int(place * packet.size)] ^= 0x55
    (tmp_path / "left.mkv").write_bytes(content)
    reader = open_frames("left.mkv", tmp_path, "left")
    lost = lost_of(reader, frames)
    assert list(lost) == [12, 13, 14]
    assert all(f"left camera, frame {index}" in text for index, text in lost.items())


FRAMES = frames_of(8, 8, 6)
PICTURES = [kind for kind in IMAGES if kind.bits == 8]
SINGLE = [
    *(TIFFS[i] for i in (0, 2, 4, 5, 1)),
    Format("tif", 8, write_tiff, {"bigtiff": True}),
    Format("h5", 8, write_hdf5, {"attributes": {"frame_rate": 1000.0}}),
    Format("h5", 8, write_hdf5, {**EACH, "chunks": (2, *FRAMES.shape[1:])}),
    *(kind for kind in VIDEOS if kind.bits == 8 and kind.options["pixels"] == "gray"),
]


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
    SINGLE[-1].written(tmp_path, FRAMES)
    (tmp_path / "list.mkv").write_text("#EXTM3U\n#EXTINF:1,\nleft.mkv\n#EXT-X-ENDLIST\n")
    assert_refused(tmp_path, "list.mkv", "not a readable video")


@pytest.mark.parametrize("kind", [*PICTURES, *SINGLE], ids=str)
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

    gone = Mock(**{"readinto.side_effect": OSError(116, "Stale file handle")})
    monkeypatch.setattr(reader.files[0], "_stream", gone)
    (block,) = iter_pair_blocks(reader, reader, block=len(FRAMES))
    assert len(block.unreadable) == 2 * len(FRAMES)
    assert re.search(r"left\..*left camera, frame 0.*Stale file handle", block.unreadable[0, 0])
