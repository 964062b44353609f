"""The way in for frames in memory and for a live loop, and how results show themselves."""

from dataclasses import replace

import numpy as np
import pytest

import disctrack
from disctrack.errors import ArgumentError, TrackingError
from disctrack.findings import DoubtWarning, Kind, in_doubt
from disctrack.trajectory import FrameStatus
from tests.pipeline.conftest import images_of


@pytest.fixture(scope="module")
def taken(short_recording, rig_file):
    """Recording, rig, its images (n, 2, h, w), and the measurement by way of the files."""
    declared = disctrack.read_recording(short_recording)
    rig = disctrack.read_rig(rig_file)
    return declared, rig, images_of(declared), disctrack.measure(declared, rig, disctrack.open_pairs(declared))


def test_arrays_give_to_the_last_bit_what_files_give(taken):
    declared, rig, images, by_files = taken
    for given in (images, (images[:, 0], images[:, 1])):
        found = disctrack.measure_pairs(given, rig, declared.disc, declared.frame_rate)
        for name in ("q", "pose_covariance", "markers_px", "time", "frame_status"):
            assert np.array_equal(getattr(found.trajectory, name), getattr(by_files.trajectory, name)), name
    assert found.details["noise"] == by_files.details["noise"]


def test_what_puts_a_result_in_doubt_is_told_of_arrays_too(taken):
    declared, rig, images, by_files = taken
    assert not in_doubt(by_files.trajectory.findings)
    centres = declared.disc.marker_centres_body + np.array([[3e-4, 0, 0], *np.zeros((declared.disc.n_markers - 1, 3))])
    wrong = replace(declared.disc, marker_centres_body=centres)
    with pytest.warns(DoubtWarning, match="dots lie off the places declared") as told:
        found = disctrack.measure_pairs(images, rig, wrong, declared.frame_rate)
    assert told[0].filename == __file__, "it points at the line that measures"
    assert [f.kind for f in found.trajectory.findings if f.doubtful] == [Kind.DOTS_MISPLACED]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("images", lambda i: i[:, 0], "expected"),
        ("images", lambda i: (i[:, 0], i[:-1, 1]), "expected"),
        ("images", lambda i: i[:0], "no image"),
        ("images", lambda i: i[..., :-8], "calibrated at"),
        ("images", lambda i: np.zeros_like(i), "found in none"),
        ("images", np.full((1, 2, 8, 8), np.nan), "not every grey value is a number"),
        ("images", np.full((1, 2, 8, 8), -1.0), "grey values -1 to -1"),
        ("images", np.zeros((1, 2, 8, 8), complex), "type complex128"),
        ("timestamps", lambda i: np.zeros(len(i)), "timestamps"),
        ("frame_rate", 1e12, "a number from 0.001 to 1e\\+08, in Hz"),
        ("frame_rate", True, "frame_rate is True"),
        ("frame_rate", float("nan"), "frame_rate is nan"),
        ("gravity", -9.81, "gravity is -9.81; expected a number from 0.001 to 100, in m.s"),
    ],
)
def test_what_cannot_be_measured_is_refused_with_what_is_wanted(taken, name, value, words):
    declared, rig, images, _ = taken
    value = value(images) if callable(value) else value
    given = {"images": images, "rig": rig, "disc": declared.disc, "frame_rate": 1000.0, name: value}
    with pytest.raises((ArgumentError, TrackingError), match=words):
        disctrack.measure_pairs(**given)


def test_files_and_results_stand_for_what_they_hold(taken, short_recording, rig_file, tmp_path):
    declared, rig, images, by_files = taken
    expected = disctrack.measure_pairs(images[:4], rig, declared.disc, declared.frame_rate).trajectory.q
    found = disctrack.measure_pairs(images[:4], rig_file, declared, declared.frame_rate)
    assert np.array_equal(found.trajectory.q, expected)
    assert len(disctrack.open_pairs(short_recording)) == len(images)
    file = tmp_path / "trajectory.h5"
    disctrack.write_trajectory(file, by_files.trajectory, disctrack.Provenance("r", {}, {}))
    assert len(disctrack.differentiate(file)) == len(disctrack.differentiate(by_files)) == len(images)


def test_images_of_any_real_type_are_measured(taken):
    """Fractions of one: a grey value is a 257th part of a step of 16 bits; what is rounded is a thousandth of it."""
    declared, rig, images, _ = taken
    expected = disctrack.measure_pairs(images[:4], rig, declared.disc, declared.frame_rate).trajectory
    for same in (images[:4].astype(int), images[:4].astype(np.float32), images[:4] / 255.0):
        found = disctrack.measure_pairs(same, rig, declared.disc, declared.frame_rate).trajectory
        assert np.abs((found.q - expected.q) / expected.coordinate_sigma).max() < 0.1
    with pytest.raises(ArgumentError, match="both of one type"):
        disctrack.Tracker(rig, declared.disc).next(images[0, 0], images[0, 1].astype(np.uint16))


def test_the_live_loop_gives_the_poses_of_the_recording(taken):
    _declared, rig, images, by_files = taken
    tracker = disctrack.Tracker(rig, by_files.trajectory.disc)
    poses = [tracker.next(*pair) for pair in images]
    assert all(pose.status == FrameStatus.MEASURED for pose in poses)
    q, expected = np.array([pose.q for pose in poses]), by_files.trajectory.q
    miss = (q - expected) / by_files.trajectory.coordinate_sigma
    # noise and blur come from one pair instead of twelve: weights differ by a tenth, poses by far less than their sigma
    assert np.sqrt(np.mean(miss**2)) < 0.3
    sigma = np.array([pose.sigma for pose in poses])
    # the recording's sigma also counts the scatter that only a sequence tells
    assert np.median(sigma / by_files.trajectory.coordinate_sigma) == pytest.approx(1.0, abs=0.3)
    assert not np.array_equal(poses[3].markers_px, poses[4].markers_px)


def test_the_live_loop_loses_a_hidden_disc_and_finds_it_again_and_one_covered_camera_is_said(taken):
    _declared, rig, images, by_files = taken
    whole, dark = by_files.trajectory, np.zeros_like(images[0])
    tracker = disctrack.Tracker(rig, whole.disc)
    statuses = [tracker.next(*(dark if 8 <= i < 11 else images[i])).status for i in range(20)]
    assert [status.has_pose for status in statuses] == [not 8 <= i < 11 for i in range(20)]
    again = tracker.next(*images[20])
    assert again.q[:3] == pytest.approx(whole.q[20, :3], abs=5 * whole.coordinate_sigma.max())
    turn = (again.q[3:] - whole.q[20, 3:]) / (2 * np.pi)
    assert turn == pytest.approx(np.rint(turn), abs=1e-3)  # turns while it was hidden are not known
    covered = tracker.next(images[21, 0], dark[1])
    assert covered.status == FrameStatus.ONE_CAMERA
    assert covered.sigma[:3].max() > 3 * whole.coordinate_sigma[21, :3].max()
    with pytest.raises(TrackingError, match="calibrated at"):
        tracker.next(images[0, 0, :-8], images[0, 1, :-8])


def test_results_show_a_few_facts_and_not_their_arrays(taken):
    declared, rig, images, by_files = taken
    tracker = disctrack.Tracker(rig, declared.disc)
    motion = disctrack.differentiate(by_files.trajectory)
    model = disctrack.Model(declared.disc)
    rolled = disctrack.simulate(model, disctrack.steady_precession(0.1, declared.disc), duration=0.01)
    results = (by_files, by_files.trajectory, rig, tracker.next(*images[0]), tracker)
    provenance = disctrack.trajectory_provenance(declared, rig, disctrack.open_pairs(declared), None)
    for thing in (*results, provenance, declared, declared.disc, declared.views, motion, rolled, model):
        assert len(repr(thing)) < 400, type(thing)
        assert "array(" not in repr(thing)
    assert f"position {len(motion)} x 3" in repr(motion)
    shown = by_files.trajectory._repr_html_()
    assert shown.startswith("<table>")
    assert f"{len(images)} at 1000 Hz" in shown


def test_xarray_holds_time_units_and_both_sigmas(taken):
    xarray = pytest.importorskip("xarray")
    *_, by_files = taken
    dataset = by_files.trajectory.to_xarray()
    assert isinstance(dataset, xarray.Dataset)
    assert np.array_equal(dataset.time, by_files.trajectory.time)
    assert np.array_equal(dataset.theta.sel(time=dataset.time[3]), by_files.trajectory.q[3, 4])
    assert dataset.x.attrs["units"] == "m"
    assert dataset.attrs["air_density_kg_m3"] == by_files.trajectory.air_density
    assert np.array_equal(dataset.x_sigma_calibration, by_files.trajectory.calibration_sigma[:, 0])
    assert dataset.marker_centre_px.sel(camera="right").shape == (len(dataset.time), 6, 2)
