"""Pictures show what the trajectory holds: lines where the numbers are, outlines where the disc is, gaps as gaps."""

import dataclasses

import cv2
import numpy as np
import pytest
from PIL import Image

from calibration.cameras.camera import Camera, StereoRig, rotation_from_vector
from disctrack.disc import MA_2014
from disctrack.errors import OutputError
from disctrack.frames import COORDINATES, quaternion_from_rotation, rotation_from_euler
from disctrack.report.figures import DPI, save_figure
from disctrack.track import pictures as plots
from disctrack.track import video_overlay as overlay
from disctrack.trajectory import FrameStatus, Trajectory

SIZE = (160, 120)


def rig() -> StereoRig:
    """Two cameras 0.5 m above the table that look down on the origin."""
    camera = Camera(400.0, 400.0, 80.0, 60.0, (0.0,) * 5, SIZE)
    down = np.diag([1.0, -1.0, -1.0])  # camera axes x right, y down, z along the view, seen from above
    turn = rotation_from_vector(np.array([0.0, 0.3, 0.0]))
    return StereoRig(
        camera,
        camera,
        turn,
        np.array([0, 0, 0.5]) - turn @ np.array([0, 0, 0.5]),
        down,
        np.array([0, 0, 0.5]),
        np.eye(30) * 1e-12,
        True,
    )


@pytest.fixture
def trajectory() -> Trajectory:
    """A disc that turns; frame 4 lost."""
    n, m = 12, MA_2014.n_markers
    t = np.arange(n) / 1000
    q = np.column_stack([0 * t, 0 * t, 0.01 + 0 * t, 100 * t, 0.2 + 0 * t, -90 * t])
    R = rotation_from_euler(*q[:, 3:].T)
    two = rig()
    pixels = np.stack([two.project(MA_2014.marker_centres_body @ R[i].T + q[i, :3]) for i in range(n)])
    status = np.zeros(n, np.uint8)
    status[4] = FrameStatus.MARKERS_NOT_FOUND
    q[4] = np.nan
    pixels[4] = np.nan
    return Trajectory(
        time=t,
        frame=np.arange(n),
        q=q,
        pose_covariance=np.broadcast_to(np.eye(6) * 1e-12, (n, 6, 6)).copy(),
        calibration_sensitivity=np.ones((n, 6, 30)),
        systematic_covariance=np.zeros((n, 6, 6)),
        quaternion=quaternion_from_rotation(R),
        frame_status=status,
        reprojection_rms_px=np.full((n, 2), 0.01),
        reduced_chi_square=np.ones(n),
        markers_px=pixels,
        markers_covariance_px2=np.broadcast_to(np.eye(2) * 1e-4, (n, 2, m, 2, 2)).copy(),
        markers_residual_px=np.full((n, 2, m, 2), 0.01),
        marker_status=np.zeros((n, 2, m), np.uint8),
        disc=MA_2014,
        rig=two,
        frame_rate=1000.0,
        gravity=9.81,
    )


@pytest.mark.statistical
@pytest.mark.parametrize("name", sorted(plots.FIGURES))
def test_every_figure_is_drawn_and_not_blank(trajectory, tmp_path, name):
    path = save_figure(plots.FIGURES[name](trajectory), tmp_path / f"{name}.png")
    assert cv2.imread(str(path)).std() > 5
    assert [file.name for file in tmp_path.iterdir()] == [f"{name}.png"]


@pytest.mark.statistical
def test_a_png_file_shows_what_matplotlib_writes_at_the_same_size_on_paper(trajectory, tmp_path):
    figure = plots.coordinates_figure(trajectory)
    figure.savefig(tmp_path / "expected.png", dpi=DPI)
    path = save_figure(figure, tmp_path / "ours.png")
    ours, expected = (Image.open(file) for file in (path, tmp_path / "expected.png"))
    np.testing.assert_array_equal(np.asarray(ours), np.asarray(expected)[..., :3])
    assert ours.info["dpi"] == pytest.approx(expected.info["dpi"])


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
    picture = overlay.draw_pair(np.zeros((2, SIZE[1], SIZE[0]), np.uint8), trajectory, row)[:, : SIZE[0]]
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
    # a line one pixel wide with soft edges: 1.5 px of 1.25 mm
    assert np.abs(radius - MA_2014.radius).max() < 1.5 * 0.5 / 400


def test_the_drawing_moves_with_the_pose(trajectory):
    """Negative control: another pose gives another picture."""
    black = np.zeros((2, SIZE[1], SIZE[0]), np.uint8)
    shifted = dataclasses.replace(trajectory, q=trajectory.q + np.array([0.005, 0, 0, 0, 0, 0]))
    assert (overlay.draw_pair(black, trajectory, 3) != overlay.draw_pair(black, shifted, 3)).any()


def test_a_lost_frame_shows_the_reason_and_no_disc(trajectory):
    picture = overlay.draw_pair(np.zeros((2, SIZE[1], SIZE[0]), np.uint8), trajectory, 4)
    assert not picture[30 : SIZE[1]].any()
    assert picture[SIZE[1] :].any()


@pytest.mark.parametrize("encoder", ["with PyAV", "OpenCV alone"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_video_has_every_frame(trajectory, tmp_path, monkeypatch, rng, encoder, dtype):
    if encoder == "OpenCV alone":
        monkeypatch.setitem(__import__("sys").modules, "av", None)
    else:
        pytest.importorskip("av")
    pairs = ((row, rng.integers(0, 200, (2, SIZE[1], SIZE[0])).astype(dtype)) for row in range(12))
    done = []
    overlay.write_overlay(tmp_path / "overlay.mp4", pairs, trajectory, done.append)
    video = cv2.VideoCapture(str(tmp_path / "overlay.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 12
    good, picture = video.read()
    video.release()
    assert good
    assert picture.shape[1:] == (2 * SIZE[0], 3)
    assert picture.shape[0] > SIZE[1]  # the caption stands below the images
    assert sum(done) == 12
    assert [file.name for file in tmp_path.iterdir()] == ["overlay.mp4"]


def test_a_video_without_a_frame_is_refused(trajectory, tmp_path):
    with pytest.raises(OutputError, match="no frame to draw"):
        overlay.write_overlay(tmp_path / "overlay.mp4", iter(()), trajectory)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("frames", "shown"), [(10, 10), (1500, 1500), (1501, 751), (100_000, 1493)])
def test_a_long_recording_is_shown_in_a_minute(frames, shown):
    assert len(overlay.shown_rows(0, frames)) == shown
