"""What may be read as a file, and where nothing may be written."""

import contextlib
import os
import socket
import sys

import numpy as np
import pytest

from disctrack import open_frames, read_recording
from disctrack.errors import OutputError, RecordingError
from disctrack.files.whole import inputs_kept, keep, open_regular, read_regular, refuse_input
from disctrack.recording.readers.raw import RawFile
from tests.disctrack.recording.readers.written import write_sequence

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pipes and devices lie elsewhere there")


def pipe(path):
    os.mkfifo(path)


def endless(path):
    path.symlink_to("/dev/zero")


def listening(path):
    with socket.socket(socket.AF_UNIX) as opened:
        here = os.getcwd()
        os.chdir(path.parent)  # the name of a socket is short
        opened.bind(path.name)
        os.chdir(here)


ODD = pytest.mark.parametrize(
    ("made", "kind"), [(pipe, "a named pipe"), (endless, "a device"), (listening, "a socket"), (os.mkdir, "a folder")]
)


@ODD
@pytest.mark.parametrize("name", ["0.png", "a.tif", "a.h5", "a.mkv", "a.cine", "a.cihx"])
def test_what_is_no_regular_file_is_refused_at_once_by_name(tmp_path, made, kind, name):
    """At once: reading a pipe that nobody writes to would never end."""
    made(tmp_path / name)
    with pytest.raises(RecordingError, match=rf"{name}.*cannot be read: it is {kind}, not a regular file"):
        open_frames(name, tmp_path, "left")


@ODD
def test_a_declaration_is_a_regular_file(tmp_path, made, kind):
    made(tmp_path / "recording.toml")
    with pytest.raises(RecordingError, match=f"it is {kind}"):
        read_recording(tmp_path)


def test_a_frame_that_became_a_pipe_is_a_lost_frame(tmp_path):
    frame = np.full((8, 9), 7, np.uint8)
    write_sequence(tmp_path, [frame] * 3, names="012")
    reader = open_frames("*.png", tmp_path, "left")
    (tmp_path / "1.png").unlink()
    pipe(tmp_path / "1.png")
    with pytest.raises(RecordingError, match=r"frame 1.*a named pipe"):
        reader.read(1)
    assert np.array_equal(reader.read(2), frame)
    with pytest.raises(RecordingError, match="a named pipe"):
        RawFile(tmp_path / "1.png")


def test_a_file_is_read_up_to_its_bound(tmp_path):
    (tmp_path / "a").write_bytes(bytes(1000))
    assert read_regular(tmp_path / "a", 1000) == bytes(1000)
    with pytest.raises(OSError, match="more than"):
        read_regular(tmp_path / "a", 999)
    os.truncate(tmp_path / "a", 1 << 40)  # a hole: nothing of it is read
    with pytest.raises(OSError, match="more than"):
        read_regular(tmp_path / "a", 999)
    os.close(open_regular(tmp_path / "a"))


@pytest.mark.parametrize(
    ("frames", "place", "refused"),
    [
        *(("left/*.png", f"{place}/trajectory.h5", "lies among the frames") for place in ("left", "right", "views")),
        *(("left/*.png", f"{place}/trajectory.h5", "") for place in (".", "results", "left/results", "..")),
        ("a/b/c/d/left/*.png", "a/b/c/d/left/trajectory.h5", "lies among the frames"),  # however far below
        ("left_*.png", "trajectory.h5", ""),  # frames in the recording's own folder
        ("left_*.png", "left_1.png", "no output replaces an input"),
        ("left_1.png:/left", "left_1.png", "no output replaces an input"),  # a data set of a file
        ("left/*.png", "flat/trajectory.h5", "lies among the frames"),
    ],
)
def test_a_result_among_frames_or_views_is_refused_and_one_beside_or_below_them_is_not(
    tmp_path, frames, place, refused
):
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "left_1.png").touch()
    (tmp_path / "rec" / "recording.toml").write_text(
        f'[cameras]\nleft = "{frames}"\nright = "right/*.png"\nright_flat = "flat/*.png"\n'
        '[calibration]\nleft = "views/left_*.png"\nrig = "../r.h5"\n'
    )
    with pytest.raises(OutputError, match=refused) if refused else contextlib.nullcontext():
        refuse_input(tmp_path / "rec" / place)


def test_a_file_that_has_the_inode_of_an_input_written_anew_is_no_input(tmp_path):
    """Groups are added to a trajectory by a whole new file; the disk may give the old one's inode to a page."""
    trajectory, page, link = (tmp_path / name for name in ("trajectory.h5", "report.html", "link.h5"))
    trajectory.write_text("as tracked")
    link.symlink_to(trajectory)
    with inputs_kept():
        keep(trajectory)
        with pytest.raises(OutputError, match="is read by this command"):
            refuse_input(link)
        trajectory.rename(page)  # as a page that was given it
        trajectory.write_text("with more groups")
        refuse_input(page)
