"""The trajectory file: equal when read back, open to other programs, whole or not there, honest about its origin."""

import dataclasses
import errno
import os

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from calibration.cameras.camera import N_RIG, Allowance
from calibration.cameras.splines import LensField
from disctrack import FrameStatus, Provenance, Trajectory, read_group, read_trajectory, write_group, write_trajectory
from disctrack.errors import OutputError, TrajectoryFileError
from disctrack.files.labelled_arrays import Variable
from disctrack.findings import DoubtWarning, Finding, Kind, Remedy, Severity, Subject
from disctrack.frames import euler_from_rotation, rotation_from_euler, rotation_from_vector
from disctrack.numbers import Measured
from disctrack.trajectory.file import kept_or_made, read_findings, read_provenance, write_groups
from tests.equality import assert_equal
from tests.oracles.measured_disc import measured

PROVENANCE = Provenance("clip", {"images": "ab" * 32}, {"refine": True})


def make_trajectory(rng: np.random.Generator, n: int = 30) -> Trajectory:
    """A disc that rolls; two frames without an answer, and something else than nothing in every field."""
    made, lost, part = measured(n=n), [3, n - 1], rng.normal(0, 1e-3, N_RIG)
    for values in (made.q, made.quaternion, made.pose_covariance, made.markers_px):
        values[lost] = np.nan
    made.frame_status[lost] = FrameStatus.UNREADABLE, FrameStatus.MARKERS_NOT_FOUND
    field = LensField(rng.normal(0, 0.02, (2, 2, 5, 6)), 128.0)
    allowances = Allowance("the board's size", part, True), Allowance("its thickness", 2 * part)
    status = rng.integers(0, 8, made.marker_status.shape, dtype=np.uint8)
    rig = dataclasses.replace(made.rig, lens_field=field, allowances=allowances)
    more = {"systematic_covariance": np.full((n, 6, 6), 0.25), "air_density": 0.3, "table_moved": (1e-4, 0.0, 2e-3)}
    return dataclasses.replace(made, marker_status=status, rig=rig, **more)


@pytest.fixture
def trajectory(rng):
    return make_trajectory(rng)


@pytest.fixture
def file(tmp_path, trajectory):
    path = tmp_path / "trajectory.h5"
    write_trajectory(path, trajectory, PROVENANCE)
    return path


def test_reading_back_gives_an_equal_trajectory(file, trajectory):
    assert_equal(read_trajectory(file), trajectory)


def test_an_empty_trajectory_is_kept_as_one(tmp_path, rng):
    full = make_trajectory(rng)
    empty = dataclasses.replace(
        full, **{f.name: v[:0] for f in dataclasses.fields(full) if isinstance(v := getattr(full, f.name), np.ndarray)}
    )
    write_trajectory(tmp_path / "empty.h5", empty, PROVENANCE)
    assert_equal(read_trajectory(tmp_path / "empty.h5"), empty)


def test_h5py_finds_units_axes_and_whole_chunks(file):
    with h5py.File(file) as h5:
        assert h5.attrs["complete"] == 1
        for name in ("x", "psi", "x_sigma", "phi_sigma_calibration", "pose_covariance", "status", "markers/centre_px"):
            dataset = h5[name]
            assert dataset.attrs["units"]
            assert dataset.attrs["long_name"]
            assert dataset.dims[0][0].name == "/time"
            assert dataset.shuffle
            assert dataset.fletcher32
            assert dataset.compression == "gzip"
        assert h5["x"].attrs["units"] == "m"
        assert h5["theta"].attrs["units"] == "rad"
        kinds = set()
        h5.visititems(lambda _, item: kinds.add(item.dtype.kind) if isinstance(item, h5py.Dataset) else None)
        assert kinds <= set("iufO")  # O: text
        meanings = dict(
            zip(h5["status"].attrs["flag_values"], h5["status"].attrs["flag_meanings"].split(), strict=True)
        )
        assert meanings[h5["status"][3]] == "unreadable"


@pytest.fixture(params=["h5netcdf", "netCDF4"])
def engine(request):
    """What xarray may read the file by."""
    pytest.importorskip("xarray")
    return pytest.importorskip(request.param).__name__.lower()


@pytest.mark.statistical
def test_xarray_opens_root_and_groups_with_their_axes(file, trajectory, engine):
    import xarray

    with xarray.open_dataset(file, engine=engine) as data:
        assert data["x"].dims == ("time",)
        assert data["x"].attrs["units"] == "m"
        assert data["pose_covariance"].dims == ("time", "pose_component", "pose_component_2")
        assert list(data["camera"].values) == ["left", "right"]
        assert_array_equal(data["time"].values, trajectory.time)
        assert_array_equal(data["theta"].values, trajectory.q[:, 4])
        assert float(data["reprojection_rms_px"].sel(camera="right")[2]) == trajectory.reprojection_rms_px[2, 1]
    with xarray.open_dataset(file, engine=engine, group="markers") as data:
        assert data["centre_px"].dims == ("time", "camera", "marker", "axis")
        assert_array_equal(data["centre_px"].values, trajectory.markers_px)
    with xarray.open_dataset(file, engine=engine, group="calibration") as data:
        assert_array_equal(data["covariance"].values, trajectory.rig.covariance)


REMEDY = Remedy("square_mm", "8.00", "8.1")
MORE = Subject("track", frames=((3, 7),)), {"scale": Measured(0.9877, 1e-4)}, (REMEDY,), (Kind.RADIUS,)
SEEN = Finding(Kind.SQUARE, Severity.DOUBT, "on another scale", *MORE)


def test_findings_come_back_and_doubts_are_python_warnings(tmp_path, trajectory):
    noticed = dataclasses.replace(trajectory, findings=(SEEN, Finding(Kind.EXPOSURE, Severity.NOTE, "by the smear")))
    write_trajectory(tmp_path / "t.h5", noticed, PROVENANCE)
    with pytest.warns(DoubtWarning, match="8.00 would fit") as told:
        again = read_trajectory(tmp_path / "t.h5")
    assert again.findings == noticed.findings == read_findings(tmp_path / "t.h5")
    assert len(told) == 1
    assert told[0].filename == __file__
    write_trajectory(tmp_path / "clean.h5", trajectory, PROVENANCE)
    assert read_trajectory(tmp_path / "clean.h5").findings == ()


@pytest.mark.statistical
def test_what_was_found_and_chosen_are_plain_attributes_that_a_later_stage_keeps(tmp_path, trajectory, engine):
    import xarray

    path = tmp_path / "t.h5"
    details = {
        "words": ["one", "two"], "notes": [], "blur_px": (0.7, np.inf), "first_pass": {"moves": True, "start": 3},
        "noise": [{"read": 1.0}], "shared_sigma": [[1e-7, "the views"]], "none": None,
    }  # fmt: skip
    write_trajectory(path, dataclasses.replace(trajectory, findings=(SEEN,)), PROVENANCE, details=details)
    write_group(path, "later", {}, attributes={"found": {"km.k_m": {"value": 1.5}}})
    tree = xarray.open_datatree(path, engine=engine)
    found = tree["findings"].attrs
    assert set(found) == {"told", "words", "notes", "blur_px"}  # objects in lists, and nothing, stand in the JSON alone
    assert found["words"] == "one\ntwo"
    assert found["told"] == f"doubt: {SEEN.sentence}"
    assert_array_equal(found["blur_px"], (0.7, np.inf))
    assert dict(tree["findings/first_pass"].attrs) == {"moves": 1, "start": 3}
    assert tree["made_from/inputs_sha256"].attrs == PROVENANCE.inputs
    assert tree["later/found/km.k_m"].attrs["value"] == 1.5
    tree.close()
    assert read_provenance(path) == PROVENANCE


@pytest.mark.parametrize("i", [5, 28])  # precession 9 and 48 deg: every component of the axis counts
def test_sigmas_of_angles_agree_with_perturbed_poses(trajectory, rng, i):
    count = 20000
    small = trajectory.pose_covariance[i] / np.abs(trajectory.pose_covariance[i]).max() * 1e-8
    draws = rng.multivariate_normal(np.zeros(6), small, count)
    R = rotation_from_euler(*trajectory.q[i, 3:])
    turned = euler_from_rotation(rotation_from_vector(draws[:, 3:]) @ R)
    spread = np.std(np.unwrap(turned, axis=0), axis=0)
    scaled = dataclasses.replace(trajectory, pose_covariance=np.broadcast_to(small, trajectory.pose_covariance.shape))
    # relative scatter of a standard deviation of 20000 draws is 0.5 %: four of them
    assert_allclose(scaled.coordinate_sigma[i, 3:], spread, rtol=0.02)


def series(trajectory, n, axis="window"):
    speed = Variable(np.arange(len(trajectory), dtype=float), ("time",), "m/s", "speed")
    return {"speed": speed, "fit": Variable(np.arange(float(n)), (axis,), "1", "fitted in each window")}


def test_replacing_groups_again_and_again_leaves_the_rest_as_it_is_and_the_file_as_small(file, trajectory):
    sizes = []
    for n in (5, 5, 7, 5):  # an axis that only these groups use may change its length
        axis = {"window": Variable(np.arange(float(n)), ("window",), "s", "window")}
        with pytest.raises(TrajectoryFileError, match=r"no group 'energy'.*markers"):
            read_group(file, "energy")
        groups = {name: (series(trajectory, n), {"n": n}) for name in ("motion", "scaling")}
        write_groups(file, groups, axis)
        sizes.append(file.stat().st_size)
        arrays, attributes = read_group(file, "motion")
        assert_array_equal(arrays["fit"], np.arange(float(n)))
        assert attributes["n"] == n
    assert sizes[1] == sizes[3] <= sizes[0]
    write_groups(file, {"other": ({"fit": series(trajectory, 5)["fit"]}, {})})  # the axis is shared from here on
    before = file.read_bytes()
    with pytest.raises(ValueError, match="no axis nowhere"):
        write_groups(file, {f"by {place}": (series(trajectory, 5, place), {}) for place in ("window", "nowhere")})
    axis = {"window": Variable(np.arange(6.0), ("window",), "s", "window")}
    with pytest.raises(ValueError, match="window of 5"):
        write_groups(file, {name: (series(trajectory, 6), {}) for name in ("motion", "scaling")}, axis)
    assert file.read_bytes() == before  # all of them or none
    assert_equal(read_trajectory(file), trajectory)
    assert read_provenance(file) == PROVENANCE
    with h5py.File(file) as h5:
        assert h5["motion/fit"].dims[0][0].name == "/window" == h5["other/fit"].dims[0][0].name
        assert h5["markers/centre_px"].dims[1][0].name == "/camera"


def test_an_existing_file_is_kept_unless_told_otherwise(file, trajectory):
    before = file.read_bytes()
    with pytest.raises(OutputError, match="--overwrite"):
        write_trajectory(file, trajectory, PROVENANCE)
    assert file.read_bytes() == before
    write_trajectory(file, trajectory, dataclasses.replace(PROVENANCE, recording="other"), overwrite=True)
    assert read_provenance(file).recording == "other"


@pytest.mark.parametrize(
    "change", [{"inputs": {"images": "cd" * 32}}, {"settings": {"refine": False}}, {"version": "0.0.0"}]
)
def test_a_result_is_reused_only_for_the_same_inputs_settings_and_version(file, trajectory, change):
    other = dataclasses.replace(PROVENANCE, **change)
    made = trajectory, {"made": "now"}
    assert kept_or_made(file, PROVENANCE, lambda: made)[1:] == ({}, False)
    before = file.read_bytes()
    with pytest.raises(OutputError, match=r"not the complete result .*\(a number\)"):
        kept_or_made(file, other, lambda: made, other=lambda there: "a number")
    assert file.read_bytes() == before
    assert kept_or_made(file, other, lambda: made)[1:] == ({"made": "now"}, True)
    assert read_provenance(file) == other
    assert kept_or_made(file, other, lambda: made, overwrite=True)[2]


def test_an_incomplete_file_or_another_programs_is_no_result(file, trajectory):
    with h5py.File(file, "r+") as h5:
        h5.attrs["complete"] = 0
    with pytest.raises(OutputError, match="It is kept"):
        kept_or_made(file, PROVENANCE, lambda: (trajectory, {}))
    with pytest.raises(TrajectoryFileError, match="not complete"):
        read_trajectory(file)
    with h5py.File(file, "w") as h5:
        h5["x"] = np.arange(3.0)
    with pytest.raises(TrajectoryFileError, match="not a trajectory"):
        read_trajectory(file)
    with pytest.raises(TrajectoryFileError, match="no such trajectory file"):
        read_trajectory(file.with_name("nowhere.h5"))


def test_a_disk_that_refuses_leaves_no_file_and_the_old_result(file, trajectory, monkeypatch):
    before = file.read_bytes()

    def refuse(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OutputError, match=r"cannot be written.*-o"):
        write_trajectory(file, trajectory, PROVENANCE, overwrite=True)
    assert os.listdir(file.parent) == [file.name]
    assert file.read_bytes() == before


@pytest.fixture(scope="session")
def whole_content(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "trajectory.h5"
    write_trajectory(path, make_trajectory(np.random.default_rng(1)), PROVENANCE)
    return path.read_bytes()


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(
        st.binary(max_size=600),
        st.binary(max_size=600).map(b"\x89HDF\r\n\x1a\n".__add__),
        st.floats(0, 0.999),
        st.integers(0, 10**9),
    )
)
def test_any_bytes_and_a_file_cut_or_changed_anywhere_are_refused_with_a_message(tmp_path, whole_content, content):
    """A share of a whole file that is left, or the place of a byte in it that is another."""
    path, changed = tmp_path / "any.h5", bytearray(whole_content)
    if isinstance(content, int):
        changed[content % (len(changed) - 100)] ^= 0x10
        content = bytes(changed)
    path.write_bytes(whole_content[: int(content * len(whole_content))] if isinstance(content, float) else content)
    with pytest.raises(TrajectoryFileError):
        read_trajectory(path)


@pytest.mark.parametrize(
    ("name", "shape", "said"),
    [
        ("quaternion", (30, 3), "quaternion has shape"),
        ("x", (10**12,), "more than the file can hold"),
        *((name, None, "cannot be read") for name in ("x", "time", "markers/status", "calibration/covariance", "disc")),
    ],
)
def test_a_part_that_is_missing_or_of_another_size_is_refused(file, name, shape, said):
    with h5py.File(file, "r+") as h5:
        del h5[name]
        if shape is not None:
            h5.create_dataset(name, shape, float, chunks=(10, *shape[1:]))
    with pytest.raises(TrajectoryFileError, match=said):
        read_trajectory(file)
