"""Pictures show what the trajectory holds: lines where the numbers are, outlines where the disc is, gaps as gaps."""

import dataclasses

import cv2
import numpy as np
import pytest

from disctrack.disc import MA_2014
from disctrack.errors import OutputError
from disctrack.frames import COORDINATES, rotation_from_euler
from disctrack.report.figures import save_figure
from disctrack.track import pictures as plots
from disctrack.track import video_overlay as overlay
from disctrack.trajectory import FrameStatus, Trajectory
from tests.oracles.measured_disc import measured


@pytest.fixture
def trajectory() -> Trajectory:
    """A disc that rolls; frame 4 lost."""
    found = measured(n=12)
    found.q[4], found.markers_px[4] = np.nan, np.nan
    found.frame_status[4] = FrameStatus.MARKERS_NOT_FOUND
    return found


def black(trajectory):
    width, height = trajectory.rig.left.image_size
    return np.zeros((2, height, width), np.uint8)


@pytest.mark.parametrize("name", sorted(plots.FIGURES))
def test_a_trajectory_without_any_answer_can_be_drawn(trajectory, tmp_path, name):
    nothing = {
        f.name: np.full_like(value, np.nan)
        for f in dataclasses.fields(trajectory)
        if isinstance(value := getattr(trajectory, f.name), np.ndarray) and value.dtype.kind == "f" and f.name != "time"
    }
    lost = dataclasses.replace(trajectory, **nothing, frame_status=np.full(12, FrameStatus.NOT_CONVERGED, np.uint8))
    drawn = plots.FIGURES[name](lost)
    picture = cv2.imread(str(save_figure(drawn, tmp_path / f"{name}.png")))
    assert picture.std() > 1  # axes and their names are there all the same


def test_the_coordinates_are_drawn_in_millimetres_and_degrees(trajectory):
    figure = plots.coordinates_figure(trajectory)
    drawn = {axes.get_ylabel(): axes.lines[0].get_ydata() for axes in figure.axes if "σ" not in axes.get_ylabel()}
    assert len(drawn) == len(COORDINATES)
    np.testing.assert_allclose(drawn["z (mm)"], 1e3 * trajectory.q[:, 2])
    np.testing.assert_allclose(drawn["precession ψ (deg)"], np.degrees(trajectory.q[:, 3]))


def test_the_outline_lies_on_the_rim_of_the_disc(trajectory):
    """The drawn pixels of the upper rim project back onto radius r at height h of the body."""
    row = 3
    images = black(trajectory)
    picture = overlay.draw_pair(images, trajectory, row)[: images.shape[1], : images.shape[2]]
    green = (picture[..., 1].astype(int) - picture[..., 0] > 100) & (picture[..., 2] < 120)
    y, x = np.nonzero(green)
    assert len(x) > 100
    # intersect each pixel's ray with the plane of the upper face
    camera, (R_cw, t_cw) = trajectory.rig.left, trajectory.rig.camera_poses()[0]
    R = rotation_from_euler(*trajectory.q[row, 3:])
    rays = np.column_stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))]) @ R_cw
    eye = -R_cw.T @ t_cw
    normal, point = R[:, 2], trajectory.q[row, :3] + MA_2014.half_thickness * R[:, 2]
    hits = eye + rays * (((point - eye) @ normal) / (rays @ normal))[:, None]
    radius = np.linalg.norm(hits - point, axis=1)
    # a line one pixel wide with soft edges: 1.5 px, on a face that is seen obliquely
    pixel = np.linalg.norm(eye - point) / camera.fx / np.cos(np.radians(60))
    assert np.abs(radius - MA_2014.radius).max() < 1.5 * pixel


def test_a_lost_frame_shows_the_reason_and_no_disc(trajectory):
    height = trajectory.rig.left.image_size[1]
    picture = overlay.draw_pair(black(trajectory), trajectory, 4)
    assert not picture[30:height].any()
    assert picture[height:].any()


@pytest.mark.parametrize("encoder", ["with PyAV", "OpenCV alone"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_video_has_every_frame(trajectory, tmp_path, monkeypatch, rng, encoder, dtype):
    if encoder == "OpenCV alone":
        monkeypatch.setitem(__import__("sys").modules, "av", None)
    else:
        pytest.importorskip("av")
    shape = black(trajectory).shape
    pairs = ((row, rng.integers(0, 200, shape).astype(dtype)) for row in range(12))
    done = []
    overlay.write_overlay(tmp_path / "overlay.mp4", pairs, trajectory, done.append)
    video = cv2.VideoCapture(str(tmp_path / "overlay.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 12
    good, picture = video.read()
    video.release()
    assert good
    assert picture.shape[1:] == (2 * shape[2], 3)
    assert picture.shape[0] > shape[1]  # the caption stands below the images
    assert sum(done) == 12
    assert [file.name for file in tmp_path.iterdir()] == ["overlay.mp4"]


def test_a_video_without_a_frame_is_refused(trajectory, tmp_path):
    with pytest.raises(OutputError, match="no frame to draw"):
        overlay.write_overlay(tmp_path / "overlay.mp4", iter(()), trajectory)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("frames", "shown"), [(10, 10), (1500, 1500), (1501, 751), (100_000, 1493)])
def test_a_long_recording_is_shown_in_a_minute(frames, shown):
    assert len(overlay.shown_rows(0, frames)) == shown
