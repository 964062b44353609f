"""Rig files: nothing is lost on the way, and nothing that is not a rig gets in."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from calibration import BoardNotFound, RigFileError, calibrate_from_corners
from calibration.cameras.camera import N_RIG, Allowance, rotation_from_vector
from calibration.cameras.splines import LensField
from calibration.rig_file import read_rig, read_rig_file, record_of, write_rig
from tests.calibration.test_stereo import corner_views
from tests.equality import assert_equal
from tests.oracles.drawn_boards import make_scene


@pytest.fixture
def rig(rng):
    A = rng.normal(size=(N_RIG, N_RIG)) * 10.0 ** rng.uniform(-6, 0, N_RIG)[:, None]
    R, t = rotation_from_vector(np.array([2.0, 0.5, -0.3])), np.array([-0.02, 0.03, 0.49])
    allowances = Allowance("the board's size", A[0], True), Allowance("its thickness", A[1])
    field = LensField(rng.normal(size=(2, 2, 8, 8)), 102.4)
    known = {"covariance": A @ A.T, "world_is_table": True, "allowances": allowances, "lens_field": field}
    return replace(make_scene().model.rig, R_left_world=R, t_left_world=t, **known)


@pytest.fixture(scope="module")
def calibrated():
    """From views one of which is lost to the left camera, and one shows the board elsewhere to the right one."""
    scene = make_scene(n_views=8)
    sides = corner_views(scene, np.random.default_rng(6))
    sides[0][2] = BoardNotFound("glare")
    sides[1][5] = replace(sides[1][5], points=sides[1][5].points + np.array([40.0, 0.0]))
    names = [(f"l{v}.png", f"rechts ü{v}.png") for v in range(8)]
    return calibrate_from_corners(*sides, scene.board, None, 1, 3e-3, names)


@pytest.fixture
def content(calibrated, rig):
    return replace(calibrated, rig=rig, doubts=("are the images negative?",))


def test_what_is_read_back_is_what_was_written_also_before_doubts_were_kept(content, tmp_path):
    write_rig(tmp_path / "rig.h5", content)
    rig, record = read_rig_file(tmp_path / "rig.h5")
    assert_equal(rig, content.rig)
    kept = record_of(content)
    for name in record:
        assert_equal(np.asarray(record[name]), np.asarray(kept[name]), name)
    assert record["R_left_board"].shape == (9, 3, 3)
    assert (record["apart"], record["table_view"], record["doubts"]) == ([5], 1, ["are the images negative?"])
    assert [p.name for p in tmp_path.iterdir()] == ["rig.h5"]  # no temporary file stays
    changed = replace(content.rig, covariance=content.rig.covariance * (1 + 1e-15))
    with pytest.raises(AssertionError):
        assert_equal(rig, changed)
    with h5py.File(tmp_path / "rig.h5", "r+") as file:
        del file["calibration"].attrs["doubts"]
    rig, record = read_rig_file(tmp_path / "rig.h5")
    assert_equal(rig, content.rig)
    assert record["doubts"] == []


def test_every_dataset_says_what_it_is(content, tmp_path):
    write_rig(tmp_path / "rig.h5", content)
    found = []
    with h5py.File(tmp_path / "rig.h5") as file:
        file.visititems(lambda name, item: found.append((name, item)) if isinstance(item, h5py.Dataset) else None)
        assert len(found) > 20
        for name, item in found:
            assert item.attrs["description"], name


def test_missing_foreign_and_unfinished_files_are_told_apart(rig, tmp_path):
    (tmp_path / "text.h5").write_text("left camera: fine")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1.0
    write_rig(tmp_path / "rig.h5", rig)
    with h5py.File(tmp_path / "rig.h5", "a") as file:
        del file.attrs["complete"]
    reasons = {"none": "no such rig file", "text": "cannot be read as a rig file", "other": "not a rig"}
    for name, said in (reasons | {"rig": "not written to its end"}).items():
        with pytest.raises(RigFileError, match=said):
            read_rig(tmp_path / f"{name}.h5")
    with pytest.raises(RigFileError, match="nowhere"):
        write_rig(tmp_path / "nowhere" / "rig.h5", rig)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("R_right_left", np.ones((3, 3))),
        ("R_left_world", np.eye(4)),
        ("t_right_left", np.array([0, np.nan, 0])),
        ("covariance", -np.eye(N_RIG)),
        ("left_intrinsics", np.array([-1.0, 1, 1, 1, 0, 0, 0, 0, 0])),
        ("left_image_size", np.array([0, 0])),
        ("t_left_world", np.array([b"a", b"b", b"c"])),
    ],
)
def test_impossible_values_are_refused(rig, tmp_path, name, value):
    path = tmp_path / "rig.h5"
    write_rig(path, rig)
    with h5py.File(path, "a") as file:
        del file["rig"][name]
        file["rig"][name] = value
    with pytest.raises(RigFileError, match=r"rig\.h5"):
        read_rig(path)


def test_damaged_files_are_refused_and_never_crash(content, tmp_path, rng):
    write_rig(tmp_path / "rig.h5", content)
    whole = np.fromfile(tmp_path / "rig.h5", dtype=np.uint8)
    path = tmp_path / "bad.h5"
    for trial in range(200):
        data = whole.copy()
        if trial % 2:
            data = data[: rng.integers(0, len(data) - 100)]
        else:
            data[rng.integers(0, len(data) - 100, rng.integers(1, 40))] ^= np.uint8(rng.integers(1, 256))
        data.tofile(path)
        with pytest.raises(RigFileError, match=None if trial % 2 else "not those that were written"):
            read_rig_file(path)
