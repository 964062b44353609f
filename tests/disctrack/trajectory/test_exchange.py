"""Trajectories and rigs in the formats of other programs, read back by those programs' own libraries or by OpenCV."""

import ast
import csv
import tomllib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.io import loadmat

from calibration.cameras.camera import N_RIG, StereoRig, project
from calibration.cameras.foreign_rigs import export_caliscope, export_mrcal, import_caliscope, import_mrcal
from calibration.cameras.opencv_yaml import export_opencv, import_opencv
from disctrack.cli import main
from disctrack.disc import MA_2014
from disctrack.errors import OutputError, RigFileError
from disctrack.frames import (
    COORDINATES,
    continuous_quaternions,
    quaternion_from_rotation,
    rotation_from_euler,
)
from disctrack.synthetic import rig_of
from disctrack.synthetic.description import Scene
from disctrack.trajectory import FrameStatus, Trajectory
from disctrack.trajectory.exchange.c3d import write_c3d
from disctrack.trajectory.exchange.matlab import write_mat
from disctrack.trajectory.file import write_csv


@pytest.fixture
def rig(rng) -> StereoRig:
    half = rng.normal(0, 1e-3, (N_RIG, N_RIG))
    return replace(rig_of(Scene()), covariance=half @ half.T)


@pytest.fixture
def trajectory(rig, rng) -> Trajectory:
    """A disc that turns, with two frames without an answer."""
    n, m = 30, MA_2014.n_markers
    t = np.arange(n) / 1000
    q = np.column_stack([1e-3 * np.sin(t), 2e-3 * t, 0.02 + 0 * t, 30 * t, 0.4 + 0 * t, -25 * t])
    lost = np.isin(np.arange(n), [3, n - 1])
    q[lost] = np.nan
    halves = rng.normal(0, 1e-6, (n, 6, 6))
    R = rotation_from_euler(*q[:, 3:].T)
    pixels = rig.project(MA_2014.marker_centres_body @ np.swapaxes(R, 1, 2) + q[:, None, :3])
    return Trajectory(
        time=t,
        frame=np.arange(n),
        q=q,
        pose_covariance=np.where(lost[:, None, None], np.nan, halves @ np.swapaxes(halves, 1, 2)),
        calibration_sensitivity=np.where(lost[:, None, None], np.nan, rng.normal(size=(n, 6, N_RIG))),
        systematic_covariance=np.zeros((n, 6, 6)),
        quaternion=continuous_quaternions(quaternion_from_rotation(R)),
        frame_status=np.where(lost, FrameStatus.UNREADABLE, FrameStatus.MEASURED).astype(np.uint8),
        reprojection_rms_px=rng.uniform(0, 0.05, (n, 2)),
        reduced_chi_square=rng.uniform(0.8, 1.2, n),
        markers_px=pixels,
        markers_covariance_px2=np.broadcast_to(1e-4 * np.eye(2), (n, 2, m, 2, 2)),
        markers_residual_px=np.zeros((n, 2, m, 2)),
        marker_status=np.zeros((n, 2, m), np.uint8),
        disc=MA_2014,
        rig=rig,
        frame_rate=1000.0,
        gravity=9.81,
        air_density=0.7,
    )


@pytest.fixture
def world_points(rng):
    return rng.uniform(-0.03, 0.03, (20, 3)) + np.array([0.0, 0.0, 0.02])


def by_opencv(K, D, r, t, points):
    r, t, K, D = (np.array(part, float) for part in (r, t, K, D))
    return cv2.projectPoints(points, r, t, K, D)[0].reshape(-1, 2)


def test_caliscope_toml_projects_as_the_rig_does(rig, world_points, tmp_path):
    path = tmp_path / "camera_array.toml"
    export_caliscope(path, rig)
    cameras = tomllib.loads(path.read_text())["cameras"]
    for number, expected in enumerate(rig.project(world_points)):
        c = cameras[str(number)]
        found = by_opencv(c["matrix"], c["distortions"], c["rotation"], c["translation"], world_points)
        assert found == pytest.approx(expected, abs=1e-7)
    again = import_caliscope(path, world_is_table=True)
    assert again.project(world_points) == pytest.approx(rig.project(world_points), abs=1e-9)
    assert again.world_is_table
    assert not again.covariance.any()


def test_mrcal_models_project_as_the_rig_does(rig, world_points, tmp_path):
    paths = (tmp_path / "a.cameramodel", tmp_path / "b.cameramodel")
    export_mrcal(paths, rig)
    for path, expected in zip(paths, rig.project(world_points), strict=True):
        model = ast.literal_eval(path.read_text())
        fx, fy, cx, cy, *D = model["intrinsics"]
        K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        rt = model["extrinsics"]
        assert by_opencv(K, D, rt[:3], rt[3:], world_points) == pytest.approx(expected, abs=1e-7)
    again = import_mrcal(*paths)
    assert again.project(world_points) == pytest.approx(rig.project(world_points), abs=1e-9)


def test_our_lens_terms_are_those_of_mrcals_own_example(tmp_path):
    # mrcal's documentation of LENSMODEL_OPENCV5: this point is seen at (651.2740691, 555.2309482)
    text = """{ 'lensmodel': 'LENSMODEL_OPENCV5',
      'intrinsics': [1512., 1112, 500., 333., -0.012, 0.035, -0.001, 0.002, 0.019],
      'extrinsics': [0, 0, 0, %g, 0, 0], 'imagersize': [1000, 700] }"""
    (tmp_path / "l.cameramodel").write_text(text % 0.0)
    (tmp_path / "r.cameramodel").write_text(text % 0.1)
    rig = import_mrcal(tmp_path / "l.cameramodel", tmp_path / "r.cameramodel")
    assert project(np.array([[1.0, 2.0, 10.0]]), rig.left)[0] == pytest.approx([651.2740691, 555.2309482], abs=1e-6)
    assert rig.baseline == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{'lensmodel': 'LENSMODEL_SPLINED_STEREOGRAPHIC'}", "SPLINED"),
        ("{'lensmodel': 'LENSMODEL_OPENCV5', 'intrinsics': [1, 2]}", "intrinsics"),
        ("import os", "not a .cameramodel"),
    ],
)
def test_models_that_are_not_browns_are_refused_by_name(text, words, tmp_path):
    file = tmp_path / "x.cameramodel"
    file.write_text(text)
    with pytest.raises(RigFileError, match=words):
        import_mrcal(file, file)


def test_a_fisheye_and_a_third_camera_are_refused_by_name(rig, tmp_path):
    path = tmp_path / "camera_array.toml"
    export_caliscope(path, rig)
    text = path.read_text()
    path.write_text(text.replace("fisheye = false", "fisheye = true", 1))
    with pytest.raises(RigFileError, match="camera 0: a fisheye"):
        import_caliscope(path)
    path.write_text(text + text.replace("[cameras.0]", "[cameras.5]").partition("[cameras.1]")[0])
    with pytest.raises(RigFileError, match="0, 1, 5; name two"):
        import_caliscope(path)
    assert import_caliscope(path, ("0", "1")).baseline == pytest.approx(rig.baseline)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda K: K.T, "camera matrix is .*MATLAB"),
        (lambda K: K + np.eye(3, k=1) * [[1], [0], [0]], "without skew"),
        (lambda K: 2 * K, "expected fx, 0, cx; 0, fy, cy; 0, 0, 1"),
        (lambda K: -K, "is not a camera matrix"),
    ],
)
def test_what_is_not_a_camera_matrix_is_refused(rig, tmp_path, change, words):
    export_opencv(tmp_path / "rig.yml", rig)
    export_caliscope(tmp_path / "rig.toml", rig)
    K, source = rig.left.camera_matrix, cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    target = cv2.FileStorage(str(tmp_path / "other.yml"), cv2.FILE_STORAGE_WRITE)
    target.write("M1", change(K))
    for name in ("D1", "M2", "D2", "R", "T", "image_size1", "image_size2"):
        target.write(name, source.getNode(name).mat())
    target.release()
    with pytest.raises(RigFileError, match=f"M1.*{words}"):
        import_opencv(tmp_path / "other.yml", unit=1.0)
    text = (tmp_path / "rig.toml").read_text()
    (tmp_path / "other.toml").write_text(text.replace(f"matrix = {K.tolist()}", f"matrix = {change(K).tolist()}"))
    with pytest.raises(RigFileError, match=f"camera 0.*{words}"):
        import_caliscope(tmp_path / "other.toml")


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("distortions", '["a"]', "'distortions' is missing, or not numbers"),
        ("rotation", '"none"', "'rotation' is missing, or not numbers"),
        ("rotation", "[]", "has no rotation"),
        ("rotation", "[[1e300, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]", "is not a rotation"),
        ("size", "[1e300, 200]", "no image size"),
    ],
)
def test_what_a_camera_table_cannot_hold_is_named(rig, tmp_path, key, value, words):
    path = tmp_path / "camera_array.toml"
    export_caliscope(path, rig)
    lines = [f"{key} = {value}" if line.startswith(f"{key} =") else line for line in path.read_text().splitlines()]
    path.write_text("\n".join(lines))
    with pytest.raises(RigFileError, match=f"camera 0.*{words}"):
        import_caliscope(path)


def test_matlab_struct_has_every_number_with_both_sigmas(trajectory, tmp_path):
    path = write_mat(tmp_path / "t.mat", trajectory)
    found = loadmat(path, simplify_cells=True)["disctrack"]
    assert np.array_equal(found["q"], trajectory.q, equal_nan=True)
    assert np.array_equal(found["q_sigma"], trajectory.coordinate_sigma, equal_nan=True)
    assert np.array_equal(found["q_sigma_calibration"], trajectory.calibration_sigma, equal_nan=True)
    assert list(found["q_names"]) == list(COORDINATES)
    assert found["units"]["pose_covariance"].startswith("m and rad")
    assert found["air_density_kg_m3"] == trajectory.air_density == 0.7
    assert np.array_equal(found["marker_centre_px"], trajectory.markers_px, equal_nan=True)
    with pytest.raises(OutputError, match="exists"):
        write_mat(path, trajectory)


@pytest.mark.filterwarnings("ignore:No analog data")  # there is none
def test_c3d_is_read_by_another_library_with_gaps_as_gaps(trajectory, tmp_path):
    pytest.importorskip("ezc3d")
    c3d = pytest.importorskip("c3d")
    path = write_c3d(tmp_path / "t.c3d", trajectory)
    with path.open("rb") as stream:
        reader = c3d.Reader(stream)
        labels = [label.strip() for label in reader.point_labels]
        frames = np.array([points.copy() for _, points, _ in reader.read_frames()])  # (n, k, 5)
        assert reader.point_rate == pytest.approx(trajectory.frame_rate)
    known = trajectory.measured
    centre = frames[:, labels.index("CENTRE"), :3]
    assert centre[known] == pytest.approx(1e3 * trajectory.q[known, :3], abs=1e-3)
    assert (frames[~known, :, 3] < 0).all()
    assert (frames[known, :, 3] >= 0).all()
    # the body axes rebuild the rotation
    tips = [frames[known, labels.index(f"AXIS_{k}"), :3] - centre[known] for k in (1, 2, 3)]
    R = np.stack(tips, axis=-1) / (1e3 * trajectory.disc.radius)
    assert np.swapaxes(R, 1, 2) @ R == pytest.approx(np.broadcast_to(np.eye(3), R.shape), abs=1e-4)
    theta = np.arccos(np.clip(R[:, 2, 2], -1, 1))
    assert theta == pytest.approx(trajectory.q[known, 4], abs=1e-4)


def test_table_has_both_sigmas_in_mm_and_deg(trajectory, tmp_path):
    write_csv(tmp_path / "t.csv", trajectory)
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    row = int(np.flatnonzero(trajectory.measured)[0])
    for i, (name, scale) in enumerate(zip(("x", "theta"), (1e3, np.degrees(1.0)), strict=True)):
        k, unit = COORDINATES.index(name), ("mm", "deg")[i]
        for ending, values in (
            ("sigma", trajectory.coordinate_sigma),
            ("sigma_calibration", trajectory.calibration_sigma),
        ):
            assert float(rows[row][f"{name}_{ending}_{unit}"]) == pytest.approx(scale * values[row, k], rel=1e-6)


def test_convert_goes_by_the_suffix_and_replaces_nothing(rig, tmp_path, capsys):
    from calibration.rig_file import read_rig, write_rig

    write_rig(tmp_path / "rig.h5", rig)
    for name in ("rig.toml", "rig.yml", "rig.cameramodel"):
        assert main(["convert", str(tmp_path / "rig.h5"), str(tmp_path / name)]) == 0
    sides = [str(tmp_path / f"rig-{side}.cameramodel") for side in ("left", "right")]
    for source in (["rig.toml"], ["rig.yml"], sides):
        assert (
            main(["convert", *(str(tmp_path / s) for s in source), str(tmp_path / "back.h5"), "--overwrite", "--table"])
            == 0
        )
        assert read_rig(tmp_path / "back.h5").baseline == pytest.approx(rig.baseline)
    for words in (["rig.toml", "back.h5", "--unit-mm", "25"], ["rig.yml", "back.h5", "--cameras", "0", "1"],
                  ["rig.h5", "new.toml", "--table"]):  # fmt: skip
        assert main(["convert", *(str(tmp_path / w) if "." in w else w for w in words), "--overwrite"]) == 1
        assert f"{words[2]}: says nothing about" in capsys.readouterr().err
    text = (tmp_path / "rig.yml").read_text().replace("world_is_table: 1", "world_is_table: 0")
    (tmp_path / "silent.yml").write_text(text)
    for words in ([], ["--table"]):
        said = ["convert", str(tmp_path / "silent.yml"), str(tmp_path / "back.h5"), "--overwrite", *words]
        assert main(said) == 0
        assert read_rig(tmp_path / "back.h5").world_is_table == bool(words)
    (tmp_path / "bare.yml").write_text(text.replace("R_left_world", "Q").replace("t_left_world", "q"))
    assert main(["convert", str(tmp_path / "bare.yml"), str(tmp_path / "bare.h5"), "--table"]) == 1
    assert "nothing says where the table is" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "rig.h5"), str(tmp_path / "rig.toml")]) == 1
    assert main(["convert", str(tmp_path / "rig.h5"), str(tmp_path / "rig.docx")]) == 1
    assert ".cameramodel" in capsys.readouterr().err
