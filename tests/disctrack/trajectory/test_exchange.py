"""Trajectories and rigs in the formats of other programs, read back by those programs' own libraries or by OpenCV."""

import ast
import contextlib
import csv
import re
import tomllib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.io import loadmat

import disctrack
from calibration import StereoRig, triangulate
from calibration.cameras.camera import N_RIG, project
from calibration.cameras.splines import LensField
from calibration.rig_file import read_rig, write_rig
from disctrack import Provenance, Trajectory, write_trajectory
from disctrack.errors import OutputError, RigFileError
from disctrack.frames import COORDINATES, rotation_from_euler
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import Scene
from disctrack.trajectory.exchange import formats, motion, rigs
from tests.disctrack.trajectory.test_file import make_trajectory


@pytest.fixture
def rig(rng) -> StereoRig:
    half = rng.normal(0, 1e-3, (N_RIG, N_RIG))
    return replace(rig_of(Scene()), covariance=half @ half.T)


@pytest.fixture
def trajectory(rig, rng) -> Trajectory:
    """A disc that turns, with two frames without an answer, as the cameras see it."""
    made = make_trajectory(rng)
    R, centre = rotation_from_euler(*made.q[:, 3:].T), made.q[:, None, :3]
    pixels = rig.project(made.disc.marker_centres_body @ np.swapaxes(R, 1, 2) + centre)
    return replace(made, rig=rig, markers_px=pixels, systematic_covariance=np.zeros_like(made.pose_covariance))


@pytest.fixture
def world_points(rng):
    return rng.uniform(-0.03, 0.03, (20, 3)) + np.array([0.0, 0.0, 0.02])


def by_opencv(K, D, r, t, points):
    r, t, K, D = (np.array(part, float) for part in (r, t, K, D))
    return cv2.projectPoints(points, r, t, K, D)[0].reshape(-1, 2)


def cameras_of_caliscope(path):
    """K, distortion, rotation vector, translation of each camera."""
    tables = tomllib.loads(path.read_text())
    for c in tables.get("cameras", {k: v for k, v in tables.items() if k != "metadata"}).values():
        yield c["matrix"], c["distortions"], c["rotation"], c["translation"]


def cameras_of_mrcal(path):
    for side in ("left", "right"):
        model = ast.literal_eval(path.with_name(f"{path.stem}-{side}.cameramodel").read_text())
        fx, fy, cx, cy, *D = model["intrinsics"]
        yield [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], D, model["extrinsics"][:3], model["extrinsics"][3:]


def cameras_of_kalibr(path):
    yaml = pytest.importorskip("yaml")
    chain = yaml.safe_load(path.read_text())
    for name in ("cam0", "cam1"):
        fx, fy, cx, cy = chain[name]["intrinsics"]
        T = np.array(chain[name].get("T_cn_cnm1", np.eye(4)))
        K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        yield K, chain[name]["distortion_coeffs"], cv2.Rodrigues(T[:3, :3])[0], T[:3, 3]


def cameras_of_matlab(path):
    """As stereoParametersFromOpenCV takes them; the world beside them."""
    s = loadmat(path)
    assert s["imageSize"].tolist() == [[512, 512]]
    R, t = s["R_left_world"], s["t_left_world"].ravel()
    yield s["intrinsicMatrix1"], s["distortionCoefficients1"], cv2.Rodrigues(R)[0], t
    turn, shift = s["rotationOfCamera2"], s["translationOfCamera2"].ravel()
    yield s["intrinsicMatrix2"], s["distortionCoefficients2"], cv2.Rodrigues(turn @ R)[0], turn @ t + shift


def cameras_of_opencv(path):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    M1, D1, M2, D2, R, T, Rw, tw = (
        file.getNode(name).mat() for name in ("M1", "D1", "M2", "D2", "R", "T", "R_left_world", "t_left_world")
    )
    yield M1, D1, cv2.Rodrigues(Rw)[0], tw
    yield M2, D2, cv2.Rodrigues(R @ Rw)[0], R @ tw + T


@pytest.mark.parametrize(
    ("name", "cameras"),
    [
        ("rig.toml", cameras_of_caliscope),
        ("rig.pose2sim.toml", cameras_of_caliscope),
        ("rig.cameramodel", cameras_of_mrcal),
        ("rig-camchain.yaml", cameras_of_kalibr),
        ("rig.mat", cameras_of_matlab),
        ("rig.yml", cameras_of_opencv),
    ],
)
def test_a_rig_projects_as_ours_in_every_format_and_back(rig, world_points, tmp_path, name, cameras):
    without_k3 = name in ("rig.pose2sim.toml", "rig-camchain.yaml")
    if without_k3:  # formats that hold four terms
        rig = replace(rig, left=no_k3(rig.left), right=no_k3(rig.right))
    write_rig(tmp_path / "own.h5", rig)
    written, notes = disctrack.convert(tmp_path / "own.h5", tmp_path / name)
    assert "covariances" in notes[0]
    assert len(notes) == 1
    points = world_points if "camchain" not in name else world_points @ rig.R_left_world.T + rig.t_left_world
    for found, expected in zip(cameras(tmp_path / name), rig.project(world_points), strict=True):
        K, D, r, t = found
        assert by_opencv(K, D, r, t, points) == pytest.approx(expected, abs=1e-7)
    told = {} if "camchain" in name else {"world_is_table": True}
    disctrack.convert(written, tmp_path / "back.h5", **told)
    again = read_rig(tmp_path / "back.h5")
    assert again.project(points) == pytest.approx(rig.project(world_points), abs=1e-7)
    assert again.world_is_table == bool(told)
    assert not again.covariance.any()


def no_k3(camera):
    return replace(camera, distortion=(*camera.distortion[:4], 0.0))


def test_dlt_coefficients_describe_the_points_of_xypts(rig, trajectory, tmp_path):
    """Two files of DLTdv8 that belong together: its formula, by hand, gives the dots of every frame in metres."""
    write_rig(tmp_path / "own.h5", rig)
    (path,), notes = disctrack.convert(tmp_path / "own.h5", tmp_path / "clip_dltcoefs.csv")
    assert "lens" in notes[0]
    L = np.loadtxt(path, delimiter=",")
    motion.write_xypts(tmp_path / "clip_xypts.csv", trajectory)
    rows = list(csv.DictReader((tmp_path / "clip_xypts.csv").read_text().splitlines()))
    body = trajectory.disc.marker_centres_body[4]
    for i in np.flatnonzero(trajectory.measured)[::7]:
        A, b = [], []
        for c in (0, 1):
            for axis, name in enumerate("XY"):
                p, own, last = float(rows[i][f"pt5_cam{c + 1}_{name}"]), L[4 * axis : 4 * axis + 4, c], L[8:, c]
                A.append(own[:3] - p * last)
                b.append(p - own[3])
        R = rotation_from_euler(*trajectory.q[i, 3:])
        assert np.linalg.lstsq(np.array(A), b, rcond=None)[0] == pytest.approx(R @ body + trajectory.q[i, :3], abs=1e-8)
    told = {"image_size": (512, 512), "unit": 1.0, "world_is_table": True}
    disctrack.convert(path, tmp_path / "back.h5", **told)
    again = read_rig(tmp_path / "back.h5")
    assert again.left.parameters[:4] == pytest.approx(rig.left.parameters[:4], abs=1e-6)
    assert again.t_left_world == pytest.approx(rig.t_left_world, abs=1e-9)
    points = formats.read_foreign([tmp_path / "clip_xypts.csv"])
    assert points.shape == trajectory.markers_px.shape
    with pytest.raises(OutputError, match="points are read in Python"):
        disctrack.convert(tmp_path / "clip_xypts.csv", tmp_path / "clip.yml")


def with_field(rig, size=0.3):
    """A lens that moves points by up to `size` px, smoothly but by no polynomial of Brown's."""
    coefficients = np.random.default_rng(3).uniform(-size, size, (2, 2, 8, 8))
    return replace(rig, lens_field=LensField(coefficients, 512 / 5))


def test_what_a_lens_field_costs_in_another_format_is_said_and_true(rig, world_points, tmp_path):
    """Refitted coefficients are nearer to the images than those that leave the field out; triangulation uses it."""
    bent = with_field(rig)
    write_rig(tmp_path / "own.h5", bent)
    (path,), notes = disctrack.convert(tmp_path / "own.h5", tmp_path / "rig.yml")
    said = float(re.search(r"lens field fitted by .*: images differ by (\S+) px rms", notes[1])[1])
    shown = bent.lens_field.distorted(rig.project(world_points))
    assert triangulate(shown, bent) == pytest.approx(world_points, abs=1e-9)
    assert np.abs(triangulate(shown, rig) - world_points).max() > 1e-6
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.09, 0.09, 30)], [0.0]), -1).reshape(-1, 3)
    pixels = rig.project(grid)
    inside = ((pixels > 0) & (pixels < 511)).all(axis=(0, 2))
    shown = bent.lens_field.distorted(pixels)[:, inside]
    fitted = np.array([by_opencv(K, D, r, t, grid[inside]) for K, D, r, t in cameras_of_opencv(path)])
    refitted, left_out = (np.sqrt(np.mean((p - shown) ** 2)) for p in (fitted, pixels[:, inside]))
    assert refitted < 0.9 * left_out
    assert refitted == pytest.approx(said, rel=0.3)  # another sample of the image
    write_rig(tmp_path / "plain.h5", rig)
    assert len(disctrack.convert(tmp_path / "plain.h5", tmp_path / "plain.yml").notes) == 1


def test_our_lens_terms_are_those_of_mrcals_own_example(tmp_path):
    # mrcal's documentation of LENSMODEL_OPENCV5: this point is seen at (651.2740691, 555.2309482)
    text = """{ 'lensmodel': 'LENSMODEL_OPENCV5',
      'intrinsics': [1512., 1112, 500., 333., -0.012, 0.035, -0.001, 0.002, 0.019],
      'extrinsics': [0, 0, 0, %g, 0, 0], 'imagersize': [1000, 700] }"""
    (tmp_path / "l.cameramodel").write_text(text % 0.0)
    (tmp_path / "r.cameramodel").write_text(text % 0.1)
    rig = rigs.read_mrcal([tmp_path / "l.cameramodel", tmp_path / "r.cameramodel"])
    assert project(np.array([[1.0, 2.0, 10.0]]), rig.left)[0] == pytest.approx([651.2740691, 555.2309482], abs=1e-6)
    assert rig.baseline == pytest.approx(0.1)


def third_camera(text, rig):
    return text + text.replace("[cameras.0]", "[cameras.5]").partition("[cameras.1]")[0]


def entry(key, value):
    """Another value of one key of every camera's table."""
    return lambda text, rig: re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text)


def matrix(change):
    """Another matrix of the left camera, in a table of TOML or YAML."""

    def changed(text, rig):
        K = rig.left.camera_matrix
        if "%YAML" in text:
            numbers = ", ".join(map(repr, change(K).ravel().tolist()))
            return re.sub(r"(M1: !!opencv-matrix(?:\n .*){3}\n   data: \[)[^]]*", rf"\g<1>{numbers}", text)
        return text.replace(f"matrix = {K.tolist()}", f"matrix = {change(K).tolist()}")

    return changed


SKEWED = [
    (lambda K: K.T, "camera matrix is .*MATLAB"),
    (lambda K: K + np.eye(3, k=1) * [[1], [0], [0]], "without skew"),
    (lambda K: 2 * K, "expected fx, 0, cx; 0, fy, cy; 0, 0, 1"),
    (lambda K: -K, "is not a camera matrix"),
]


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("rig.cameramodel", lambda *_: "{'lensmodel': 'LENSMODEL_SPLINED_STEREOGRAPHIC'}", "SPLINED"),
        ("rig.cameramodel", lambda *_: "{'lensmodel': 'LENSMODEL_OPENCV5', 'intrinsics': [1, 2]}", "intrinsics"),
        ("rig.cameramodel", lambda *_: "import os", "not a .cameramodel"),
        ("rig.toml", lambda text, _: text.replace("fisheye = false", "fisheye = true", 1), "camera 0: a fisheye"),
        ("rig.toml", third_camera, "0, 1, 5; name two"),
        ("rig.toml", entry("distortions", '["a"]'), "camera 0.*'distortions' is missing, or not numbers"),
        ("rig.toml", entry("rotation", '"none"'), "camera 0.*'rotation' is missing, or not numbers"),
        ("rig.toml", entry("rotation", "[]"), "camera 0.*has no rotation"),
        ("rig.toml", entry("rotation", "[[1e300, 0, 0], [0, 1, 0], [0, 0, 1]]"), "camera 0.*is not a rotation"),
        ("rig.toml", entry("size", "[1e300, 200]"), "camera 0.*no image size"),
        ("rig.yml", lambda text, _: re.sub("unit: .*", 'unit: "foot"', text), "unit"),
        ("rig.yml", lambda text, _: text.replace("\nR:", "\nQ:"), "R missing"),
        ("rig.yml", lambda *_: "%YAML:1.0\n---\nM1: [1, 2", r"rig\.yml"),
        ("rig.mat", lambda *_: "no mat", r"rig\.mat: not a MAT file"),
        ("rig-camchain.yaml", lambda *_: "cam0: 2020-99-99", "camchain.yaml: not YAML: month must be in 1..12"),
        *(("rig.toml", matrix(change), f"camera 0.*{said}") for change, said in SKEWED),
        *(("rig.yml", matrix(change), f"M1.*{said}") for change, said in SKEWED),
    ],
)
def test_what_is_no_rig_of_browns_cameras_is_refused_by_name(rig, tmp_path, name, change, said):
    write_rig(tmp_path / "own.h5", rig)
    written, _ = disctrack.convert(tmp_path / "own.h5", tmp_path / name)
    text = written[0].read_text(errors="replace")
    assert change(text, rig) != text
    written[0].write_text(change(text, rig))
    with pytest.raises(RigFileError, match=said):
        formats.read_foreign(list(written))


def test_a_damaged_rig_is_told_as_a_damaged_file_and_not_as_another_kind(rig, tmp_path, cli):
    write_rig(tmp_path / "rig.h5", rig)
    content = bytearray((tmp_path / "rig.h5").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "rig.h5").write_bytes(content)
    assert "rig.h5: damaged" in cli("convert", tmp_path / "rig.h5", tmp_path / "rig.yml", code=1).err


def test_what_a_file_does_not_tell_may_be_told(rig, tmp_path):
    rigs.write_caliscope(tmp_path / "rig.toml", rig)
    text = (tmp_path / "rig.toml").read_text()
    (tmp_path / "rig.toml").write_text(third_camera(text, rig))
    assert rigs.read_caliscope(tmp_path / "rig.toml", cameras=("0", "1")).baseline == pytest.approx(rig.baseline)
    rigs.write_opencv(tmp_path / "rig.yml", rig)
    text = (tmp_path / "rig.yml").read_text()
    (tmp_path / "rig.yml").write_text(re.sub("unit: .*", 'unit: "foot"', text))
    assert rigs.read_opencv([tmp_path / "rig.yml"], unit=0.5).baseline == pytest.approx(0.5 * rig.baseline)
    for cut in range(0, len(text), 37):
        (tmp_path / "cut.yml").write_text(text[:cut])
        with contextlib.suppress(RigFileError):
            rigs.read_opencv([tmp_path / "cut.yml"])


def test_matlab_struct_has_every_number_with_both_sigmas(trajectory, tmp_path):
    path = tmp_path / "t.mat"
    motion.write_mat(path, trajectory)
    found = loadmat(path, simplify_cells=True)["disctrack"]
    assert np.array_equal(found["q"], trajectory.q, equal_nan=True)
    assert np.array_equal(found["q_sigma"], trajectory.coordinate_sigma, equal_nan=True)
    assert np.array_equal(found["q_sigma_calibration"], trajectory.calibration_sigma, equal_nan=True)
    assert list(found["q_names"]) == list(COORDINATES)
    assert found["units"]["pose_covariance"].startswith("m and rad")
    assert found["air_density_kg_m3"] == trajectory.air_density == 0.3
    assert np.array_equal(found["marker_centre_px"], trajectory.markers_px, equal_nan=True)


@pytest.mark.filterwarnings("ignore:No analog data")  # there is none
def test_c3d_is_read_by_another_library_with_gaps_as_gaps(trajectory, tmp_path):
    pytest.importorskip("ezc3d")
    c3d = pytest.importorskip("c3d")
    path = tmp_path / "t.c3d"
    motion.write_c3d(path, trajectory)
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


def test_table_has_both_sigmas_in_mm_and_deg_and_keeps_an_angle_after_a_thousand_turns(trajectory, tmp_path):
    """Ten seconds at 100 turns a second: 360 000 degrees, and still a thousandth of the smallest sigma."""
    turned = replace(trajectory, q=trajectory.q + 2 * np.pi * 1000 * np.array([0, 0, 0, 1, 0, -1]))
    motion.write_csv(tmp_path / "t.csv", turned)
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    for k, name in enumerate(COORDINATES):
        scale, unit = (1e3, "mm") if k < 3 else (np.degrees(1.0), "deg")
        assert float(rows[7][f"{name}_{unit}"]) == pytest.approx(scale * turned.q[7, k], abs=1e-7)
        for ending, values in (("sigma", turned.coordinate_sigma), ("sigma_calibration", turned.calibration_sigma)):
            assert float(rows[7][f"{name}_{ending}_{unit}"]) == pytest.approx(scale * values[7, k], rel=1e-6)
    assert (rows[3]["x_mm"], rows[3]["status"]) == ("", "unreadable")


def test_a_rigid_body_is_that_of_qualisys_own_export(trajectory, tmp_path):
    """Roll, pitch, yaw and the order of Rot[0...8] as in a line of a real file: M510A-IRR-EKFPID-020019_6D.tsv."""
    roll, pitch, yaw = np.radians([-0.65630, 0.09391, 0.05772])
    real = [1.0, 0.00099, -0.00165, -0.00101, 0.99993, -0.01145, 0.00164, 0.01145, 0.99993]

    def rot(roll, pitch, yaw):
        x, y, z = (cv2.Rodrigues(a * axis)[0] for a, axis in zip((roll, pitch, yaw), np.eye(3), strict=True))
        return (x @ y @ z).T.ravel()

    assert rot(roll, pitch, yaw) == pytest.approx(real, abs=2e-5)
    motion.write_qtm(tmp_path / "t_6D.tsv", trajectory)
    heads, rows = {}, []
    for line in (tmp_path / "t_6D.tsv").read_text().splitlines():
        key, *values = line.split("\t")
        if key.isdecimal():
            rows.append([float(v) for v in values])
        else:
            heads[key] = values
    rows = np.array(rows)
    assert heads["NO_OF_FRAMES"] == [str(len(trajectory))]
    assert heads["Frame"][:5] == ["Time", "DISC X", "Y", "Z", "Roll"]
    known = trajectory.measured
    assert rows[known, 1:4] == pytest.approx(1e3 * trajectory.q[known, :3], abs=1e-6)
    assert (rows[~known, 7] == -1).all()
    R = rotation_from_euler(*trajectory.q[known, 3:].T)
    for row, expected in zip(rows[known], R, strict=True):
        assert pytest.approx(expected, abs=1e-9) == row[8:].reshape(3, 3).T
        assert rot(*np.radians(row[4:7])) == pytest.approx(row[8:], abs=1e-8)


def test_points_of_motion_capture_stand_y_up_in_a_trc_file(trajectory, tmp_path):
    trc_reader = pytest.importorskip("trc")
    motion.write_trc(tmp_path / "t.trc", trajectory)
    data = trc_reader.TRCData()
    data.load(str(tmp_path / "t.trc"))
    assert data["Units"] == "m"
    assert data["DataRate"] == trajectory.frame_rate
    centre, known = np.array(data["CENTRE"]), trajectory.measured
    assert centre[known] == pytest.approx(trajectory.q[known][:, [1, 2, 0]], abs=1e-8)
    assert np.array(data["Time"]) == pytest.approx(trajectory.time)


def test_xmalab_has_the_images_points_and_matrices_by_columns(trajectory, tmp_path):
    bent = replace(trajectory, rig=with_field(trajectory.rig))
    motion.write_points(tmp_path / "clip_points.csv", bent)
    points = formats.read_foreign([tmp_path / "clip_points.csv"])
    assert bent.rig.lens_field.corrected(points) == pytest.approx(trajectory.markers_px, abs=1e-6, nan_ok=True)
    motion.write_transformations(tmp_path / "clip_transformation.csv", trajectory)
    head, *lines = (tmp_path / "clip_transformation.csv").read_text().splitlines()
    assert head.split(",")[12:15] == ["DISC_TX", "DISC_TY", "DISC_TZ"]
    T = np.array([[float(v) for v in line.split(",")] for line in lines]).reshape(-1, 4, 4).swapaxes(1, 2)
    known = trajectory.measured
    assert T[known, :3, :3] == pytest.approx(rotation_from_euler(*trajectory.q[known, 3:].T), abs=1e-9)
    assert T[known, :3, 3] == pytest.approx(1e3 * trajectory.q[known, :3], abs=1e-6)
    assert np.isnan(T[~known]).all()


def test_convert_goes_by_the_ending_and_replaces_nothing(rig, trajectory, tmp_path, cli):
    write_rig(tmp_path / "rig.h5", rig)

    def converted(*words, code=0):
        return cli("convert", *(tmp_path / w if "." in w else w for w in words), code=code).err

    converted("rig.h5", "rig.toml")
    converted("rig.h5", "rig.yml")
    for words, said in (
        (("rig.toml", "back.h5", "--unit-mm", "25"), "--unit-mm: says nothing about"),
        (("rig.yml", "back.h5", "--cameras", "0", "1"), "--cameras: says nothing about"),
        (("rig.h5", "new.toml", "--table"), "--table: says nothing about"),
        (("rig.h5", "rig.toml"), "exists"),
        (("rig.h5", "rig.docx"), ".cameramodel (mrcal)"),
        (("rig.h5", "any.txt", "--as", "kalib"), "Did you mean 'Kalibr'?"),
        (("rig.h5", "rig.c3d"), "no format of this name for a rig"),
        (("none.yml", "back.h5"), "none.yml"),
    ):
        assert said in converted(*words, code=1)
    converted("rig.h5", "any.txt", "--as", "Pose2Sim")
    text = (tmp_path / "rig.yml").read_text().replace("world_is_table: 1", "world_is_table: 0")
    (tmp_path / "silent.yml").write_text(text)
    for words in ([], ["--table"]):
        converted("silent.yml", "back.h5", "--overwrite", *words)
        assert read_rig(tmp_path / "back.h5").world_is_table == bool(words)
    (tmp_path / "bare.yml").write_text(text.replace("R_left_world", "Q").replace("t_left_world", "q"))
    assert "nothing says where the table is" in converted("bare.yml", "bare.h5", "--table", code=1)
    results = tmp_path / "clip" / "results"
    results.mkdir(parents=True)
    write_trajectory(results / "trajectory.h5", trajectory, Provenance("clip", {}, {}))
    for words in (("./clip", "clip.nc"), ("./clip", "clip.mat"), ("clip.nc", "c.yml")):
        converted(*words)
    assert np.array_equal(disctrack.read_trajectory(tmp_path / "clip.nc").q, trajectory.q, equal_nan=True)
    assert loadmat(tmp_path / "clip.mat", simplify_cells=True)["disctrack"]["q"].shape == (30, 6)
