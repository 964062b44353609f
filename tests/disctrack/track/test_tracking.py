"""From images to the trajectory: a rendered rolling disc, interruptions, faults, long recordings."""

import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from calibration.kit.stuck_pixels import stuck_pixels
from disctrack import FrameStatus, MarkerStatus, frames
from disctrack.errors import RecordingError, TrackingError
from disctrack.findings import Kind
from disctrack.recording.readers.blocks import PairBlock
from disctrack.track.dots.template import dot_centres
from disctrack.track.follow.following import SAMPLE
from disctrack.track.follow.tracking import Taken, _as_one_sensor, stretch_edges, track
from disctrack.track.measurement import refuse_unreadable
from disctrack.track.pose import DotsInFrames
from disctrack.track.refine.assembly import fit_all
from disctrack.validate.rendered import compare
from tests.oracles.point_laboratory import tables_of
from tests.rendering import expected_disc, rolling_disc

N = 60


def blocks_of(images, readable=None, size=16):
    gone = np.argwhere(~readable) if readable is not None else ()

    def read(start, stop):
        for a in range(start, stop, size):
            b = min(a + size, stop)
            yield PairBlock(np.arange(a, b), images[a:b], {(i, camera): "" for i, camera in gone if a <= i < b})

    return read


def tracked(images, pairs, *, readable=None, size=16, disc=None, **options):
    """The images of the scene of these pairs tracked."""
    read = blocks_of(images, readable, size)
    return track(read, Taken(range(len(images)), 1000.0), pairs.rig, disc or pairs.disc, **options)


@pytest.fixture(scope="module")
def rolling(rendered_pairs):
    """Images of a disc that rolls with a moderate nutation, and its poses."""
    return rolling_disc(rendered_pairs.rig, rendered_pairs.disc, rendered_pairs.scene, 10, N)


def test_a_rolling_disc_is_measured_to_the_predicted_sigma(rolling, rendered_pairs):
    images, q = rolling
    result = tracked(images, rendered_pairs)
    trajectory = result.trajectory
    assert (trajectory.frame_status == FrameStatus.MEASURED).all()
    assert (trajectory.marker_status == MarkerStatus.MEASURED).all()
    error = compare(trajectory, q).error
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(trajectory.pose_covariance), error)
    # 360 degrees of freedom scatter by 0.075; the templates' own error adds (0.3e-3 / 4e-3)^2
    assert 0.75 < squared.mean() / 6 < 1.3
    # mean over 60 frames: sigma / 8, plus the template's 3e-4 px or 0.03 um
    assert np.abs(error[:, :3].mean(axis=0)).max() < 0.25e-6
    assert np.abs(error[:, 3:].mean(axis=0)).max() < np.radians(0.5e-3)
    assert result.details["variance_factor"] < 1.15
    assert result.details["acquisitions"] == 1
    assert not np.any(result.details["marker_shift_um"])  # good dots are left where they are declared
    # angles are continuous, and the quaternion tells the same rotation
    assert np.abs(np.diff(trajectory.q[:, 3:], axis=0)).max() < 0.3
    R = frames.rotation_from_quaternion(trajectory.quaternion)
    assert np.allclose(R, frames.rotation_from_euler(*trajectory.q[:, 3:].T), atol=1e-9)


def test_the_number_of_workers_changes_no_bit_of_the_result(rolling, rendered_pairs, monkeypatch):
    images, _ = rolling
    whole = tracked(images, rendered_pairs)
    monkeypatch.setattr("disctrack.track.follow.tracking.SHORTEST_SPLIT", 20)
    monkeypatch.setattr("disctrack.track.side_by_side.AT_ONCE", 16)
    one, two = (tracked(images, rendered_pairs, size=15, workers=workers) for workers in (1, 2))
    assert one.details["acquisitions"] == 2
    assert one.details == two.details
    for name in ("q", "pose_covariance", "calibration_sensitivity", "markers_px", "marker_status", "quaternion"):
        assert np.array_equal(getattr(one.trajectory, name), getattr(two.trajectory, name), equal_nan=True), name
    sigma = np.sqrt(np.diagonal(one.trajectory.pose_covariance, axis1=1, axis2=2))
    change = np.abs(compare(one.trajectory, whole.trajectory.q).error) / sigma
    # a template keeps its attitude until the pose has turned by a tolerance, which moves a dot by up to 1e-3 px of a
    # scatter of 4e-3 px; when that happens hangs on the last digit of a pose, and for some frames after a start
    assert change.max() < 0.5
    assert change.any()  # what a start in the middle does is seen
    # before that start the templates are the same: what all frames share brings the later changes back, averaged
    before, after = (np.median(half.max(axis=1)) for half in (change[: N // 2], change[N // 2 :]))
    assert before < after / np.sqrt(N // 2)


@pytest.mark.statistical
def test_stretches_without_a_disc_change_nothing_whoever_gets_there_first(rolling, rendered_pairs, monkeypatch):
    monkeypatch.setattr("disctrack.track.follow.tracking.SHORTEST_SPLIT", 4)
    images = rolling[0].copy()
    images[:20] = 85  # no disc in the first of four stretches of 15 pairs, nor at the start of the second
    runs = [tracked(images, rendered_pairs, size=15, workers=workers) for workers in (1, 3, 4)]
    for run in runs[1:]:
        assert run.details == runs[0].details
        assert np.array_equal(run.trajectory.q, runs[0].trajectory.q, equal_nan=True)
    assert (runs[0].trajectory.frame_status[:20] == FrameStatus.MARKERS_NOT_FOUND).all()
    assert (runs[0].trajectory.frame_status[20:] == FrameStatus.MEASURED).all()


def test_a_stretch_that_begins_on_another_branch_of_phi_is_followed_again(rolling, rendered_pairs, monkeypatch):
    """Without the dot that breaks the symmetry, the search takes the layout as it comes; the motion tells better."""
    from disctrack.track.follow import following, tracking

    images, _ = rolling
    monkeypatch.setattr("disctrack.track.follow.tracking.SHORTEST_SPLIT", 20)
    found, third = following.acquire, np.array([[-0.5, -np.sqrt(0.75), 0], [np.sqrt(0.75), -0.5, 0], [0, 0, 1.0]])
    starts = {images[k, 0].tobytes() for k in (30, 31)}

    def mistaken(pair, rig, disc):
        (R, t), *result = found(pair, rig, disc)
        return (R @ third if pair[0].tobytes() in starts else R, t), *result

    declared = rendered_pairs.disc.marker_centres_body
    radius = np.linalg.norm(declared, axis=1)
    even = np.isclose(radius, np.median(radius), rtol=0.02)  # the dots of the regular pattern
    disc = replace(rendered_pairs.disc, marker_centres_body=declared[even])
    monkeypatch.setattr(following, "acquire", mistaken)
    monkeypatch.setattr(tracking, "symmetry_order", lambda disc: 1)
    torn = tracked(images, rendered_pairs, disc=disc, workers=2)
    turn = np.abs(np.diff(torn.trajectory.q[:, 5]))
    assert turn.max() < 0.5 < 2 * np.pi / 3
    assert len(torn.trajectory) == N


def test_misprinted_dots_are_found_and_used(rolling, rendered_pairs):
    images, _ = rolling
    declared = rendered_pairs.disc.marker_centres_body.copy()
    declared[2, 0] += 60e-6  # the declaration is wrong by what a printer does
    wrong = replace(rendered_pairs.disc, marker_centres_body=declared)
    found = tracked(images, rendered_pairs, disc=wrong)
    shift = 1e-6 * np.array(found.details["marker_shift_um"])
    relative = shift[2] - np.delete(shift, 2, axis=0).mean(axis=0)
    # the mean displacement and turn of the pattern are gauge: the other five move to balance
    assert -75e-6 < relative[0] < -45e-6
    assert found.details["variance_factor"] < 1.2


@pytest.mark.parametrize("keep", [[0, 3], [0, 3, 6]])
def test_dots_that_carry_no_pose_are_refused(rendered_pairs, keep):
    centres = np.concatenate([rendered_pairs.disc.marker_centres_body, [[0.0, 0.0, 0.003]]])
    poor = replace(rendered_pairs.disc, marker_centres_body=centres[keep])
    with pytest.raises(TrackingError, match="at least three dots that are not on one line"):
        tracked(np.zeros((2, 2, 512, 512), np.uint8), rendered_pairs, disc=poor)


def test_a_sensor_without_noise_is_not_refused_for_the_templates_own_misfit(rendered_pairs):
    q = rendered_pairs.q[[4, 5, 6]]
    exact = expected_disc(q, rendered_pairs.rig, rendered_pairs.disc, rendered_pairs.scene)
    images = np.round(16 * exact).astype(np.uint16)
    apart = np.array([[True, True], [False, False]] * 2 + [[True, True]])  # three poses that are not of one motion
    result = tracked(images[[0, 0, 1, 1, 2]], rendered_pairs, readable=apart)
    assert (result.trajectory.marker_status[::2] == MarkerStatus.MEASURED).all()
    assert np.abs(result.trajectory.q[::2, :3] - q[:, :3]).max() < 0.3e-6


def test_what_hardly_moves_for_a_millisecond_is_no_stuck_pixel(rng):
    """A speck of one pixel, 0.02 px a frame: it stands in the first images, and passes over the recording."""
    n, size, y, x = 200, 40, 20, 8
    images = np.full((n, 2, size, size), 200.0)
    images[np.arange(n), :, y, x + np.arange(n) // 50] = 25
    images = np.clip(np.rint(images + rng.normal(0, 1.5, images.shape)), 0, 254).astype(np.uint8)
    assert stuck_pixels(images[:SAMPLE, 0])[y, x]  # the trap
    assert _as_one_sensor(blocks_of(images), range(n))[1] == []
    images[:, 1, 5, 5] = 255
    read, told = _as_one_sensor(blocks_of(images), range(n))
    assert [(f.kind, f.subject.camera) for f in told] == [(Kind.SENSOR, "right")]
    assert told[0].text == "right camera: 1 pixels show one value whatever passes; their neighbours stand in"
    assert all((block.images[:, 1, 5, 5] < 210).all() for block in read(0, n))


@pytest.mark.statistical
def test_behind_a_colour_filter_the_disc_is_measured_as_without(rolling, rendered_pairs):
    images, q = rolling
    filtered = images.astype(float)
    filtered[..., ::2, ::2] *= 0.75
    filtered[..., 1::2, 1::2] *= 0.55
    filtered = np.rint(filtered).astype(np.uint8)

    result = tracked(filtered, rendered_pairs)
    assert sum("a colour filter lies on the sensor" in f.text for f in result.trajectory.findings) == 2
    plain = tracked(images, rendered_pairs)
    assert not any("colour filter" in f.text for f in plain.trajectory.findings)
    rms = [np.sqrt(np.mean(compare(t.trajectory, q).error ** 2, axis=0)) for t in (plain, result)]
    # rounding to grey values that are 0.55 and 0.75 as large adds 1/12 of their square to the noise
    assert (rms[1] < 1.6 * rms[0]).all()


def test_edges_that_compression_spoils_cost_accuracy_and_no_camera(rolling, rendered_pairs):
    """An encoder begins well and then saves bits: what its edges leave is usual, though flat parts are quiet."""
    images, q = rolling

    def compressed(image, quality):
        return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE)

    lossy = np.array([[compressed(image, 95 if i < 3 else 10) for image in pair] for i, pair in enumerate(images)])
    trajectory = tracked(lossy, rendered_pairs).trajectory
    assert (trajectory.frame_status == FrameStatus.MEASURED).mean() > 0.95
    error = compare(trajectory, q).error
    # grey values are off by 4 of 165 at edges, noise 1: 4 times 3 um
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 12e-6
    stated = np.einsum("nii->ni", trajectory.pose_covariance)
    assert 0.3 < np.nanmean(error**2 / stated) < 3.0


def test_most_images_unreadable_is_the_cause_that_is_told_and_a_few_are_not():
    lost = {(n, n % 2): f"left/{n}.png: cannot be read: No such device." for n in range(150, 0, -1)}
    known = SimpleNamespace(folder=Path("rec")), lost, 200, TrackingError("found in none")
    refuse_unreadable(known[0], dict([*lost.items()][50:]), *known[2:])
    said = r"rec: the files cannot be read: 150 of 200 images, the first: left/1\.png"
    with pytest.raises(RecordingError, match=said):
        refuse_unreadable(*known)


@pytest.mark.parametrize(
    ("n", "stretches"), [(1, 1), (999, 1), (1000, 2), (3999, 2), (4000, 4), (16000, 8), (10**6, 32)]
)
def test_stretches_follow_from_the_length_alone_and_cover_it(rendered_pairs, n, stretches):
    edges = stretch_edges(range(70, 70 + n), rendered_pairs.disc)
    assert len(edges) == stretches + 1
    assert (edges[0], edges[-1]) == (70, 70 + n)
    assert np.ptp(np.diff(edges)) <= 1


def test_dots_that_leave_phi_open_are_followed_in_one_stretch(rendered_pairs):
    four = replace(rendered_pairs.disc, marker_centres_body=rendered_pairs.disc.marker_centres_body[[0, 1, 3, 4]])
    assert len(stretch_edges(range(5000), four)) == 2


def test_what_the_fit_of_all_poses_needs_beside_its_result_does_not_grow_with_their_number(rendered_pairs):
    rig, disc = rendered_pairs.rig, rendered_pairs.disc
    R, t = frames.rotation_from_euler(*rendered_pairs.q[:, 3:].T), rendered_pairs.q[:, :3]
    beside = []
    for n in (1536, 4608):
        k = np.arange(n) % len(R)
        tables = tables_of(rendered_pairs.true_pixels[k], R[k], t[k], 0.01)
        _, *centres = dot_centres(tables.results, tables.status)
        tracemalloc.start()
        fits = fit_all(DotsInFrames(rig, disc, *centres, tables.R, tables.t))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert fits.converged.all()
        beside.append(peak - sum(value.nbytes for value in vars(fits).values()))
    # three times the frames; before they were fitted in parts it was three times the memory
    assert beside[1] < 1.2 * beside[0]
