"""Faults planted into recordings: none ends with a pose that is wrong by more than its sigma says and not flagged."""

import json
import re
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import pdist

from calibration.rig_file import read_rig
from disctrack import Disc, FrameStatus, frames, measure_pairs, open_frames, read_recording
from disctrack.disc import disc_from_mm
from disctrack.errors import TrackingError
from disctrack.findings import Kind, in_doubt, leading
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import Scene
from disctrack.track.judge.disc_not_seen import arrangement_found, moved_camera, unlike_declared
from disctrack.track.refine.assembly import TrackingSettings
from disctrack.track.refine.scatter import MIN_FRAMES
from disctrack.validate.rendered import compare
from tests.disctrack.recording.readers.written import write_video
from tests.oracles.planted_faults import FAULTS, glare
from tests.pipeline.conftest import images_of
from tests.rendering import rolling_disc

N = 48
MOST_SIGMAS = 5.0  # of six components of some fifty poses chance alone reaches 4.1


def measure(images, rig, disc, rate=1000.0):
    # on the board's table, whatever frames are left: the disc's own moves all poses by its share of the shared sigma
    return measure_pairs(images, rig, disc, rate, settings=TrackingSettings(table="board"))


class Laboratory:
    """Images of a recording without faults, and the poses in it."""

    def __init__(self, images, rig, disc, truth=None):
        self.images, self.rig, self.disc = images, rig, disc
        self.untouched = measure(images, rig, disc)
        trajectory = self.untouched.trajectory
        self.places = np.nanmean(trajectory.markers_px, axis=2)
        self.truth = truth

    def silently_wrong(self, fault, seed):
        """Frames with a pose, whatever their status, that is farther than MOST_SIGMAS from the truth.

        A doubt about the whole run excuses none. Where a truth is known, by the whole of the sigma; and by the noise of
        the frame alone from what is found without the fault, where as many frames are left as tell the dots' places.
        What all frames are shifted by alike (sizes are estimated from the frames left) is judged by the whole sigma.
        """
        rng = np.random.default_rng(seed)
        planted = self.images.copy()
        kept = fault(planted, self.places, rng)
        rows = np.arange(len(planted)) if kept is None else kept
        found = measure(planted[rows], self.rig, self.disc).trajectory
        wrong = np.zeros(len(found), bool)
        if self.truth is not None:
            wrong |= beyond(found, self.truth[rows], found.pose_covariance + found.calibration_covariance)
        if found.measured.sum() >= MIN_FRAMES:
            wrong |= beyond(found, self.untouched.trajectory.q[rows], found.pose_covariance, shared=True)
        return np.flatnonzero(wrong).tolist()


def beyond(found, q, covariance, shared=False):
    """(n,) True for poses that are farther than MOST_SIGMAS from q in a component; `shared`: but for what all share."""
    away = compare(found, q).error
    if shared:
        away -= np.nanmedian(away, axis=0)
    with np.errstate(invalid="ignore"):
        return (np.abs(away) > MOST_SIGMAS * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))).any(axis=1)


@pytest.fixture(scope="module")
def clip(sample_clip, rig_file):
    """The first frames of the sample."""
    recording = read_recording(sample_clip)
    return Laboratory(images_of(recording, N), read_rig(rig_file), recording.disc)


def test_a_recording_without_faults_has_no_flag(clip):
    assert (clip.untouched.trajectory.frame_status == FrameStatus.MEASURED).all()
    assert not in_doubt(clip.untouched.trajectory.findings)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_no_fault_passes_in_silence(clip, fault):
    assert clip.silently_wrong(fault, 7) == []


def test_a_repeated_image_is_found_by_its_pixels_and_its_frame_measured_by_the_other_camera(clip):
    images = clip.images.copy()
    images[20, 0] = images[19, 0]
    found = measure(images, clip.rig, clip.disc)
    assert found.trajectory.frame_status[20] == FrameStatus.ONE_CAMERA
    assert np.all(np.delete(found.trajectory.frame_status, 20) == FrameStatus.MEASURED)
    assert "left camera: 1 repeat of earlier images (frame 20)" in doubts_of(found)[0]
    images[20] = images[19]
    assert measure(images, clip.rig, clip.disc).trajectory.frame_status[20] == FrameStatus.REPEATED


def test_images_of_both_cameras_mirrored_since_the_calibration_are_named(clip):
    images = np.ascontiguousarray(clip.images[0, ..., ::-1])
    assert "both cameras are mirrored left to right" in next(arrangement_found(images, clip.rig, clip.disc)).text


def test_y_of_the_dots_counted_down_is_named(clip):
    """A layout that looks another in a mirror, drawn as circles."""
    there = disc_from_mm(37.5, 6.0, 200.0, [[26.0, 0.0], [13.0, 22.5], [-13.0, 22.5], [-26.0, 3.0], [5.0, -21.0]], 7.0)
    images = np.full((2, *clip.images.shape[2:]), 200, np.uint8)
    centres = clip.rig.project(there.marker_centres_body + np.array([0.025, 0.015, 0.003]))
    for image, (x, y) in ((images[c], dot) for c in (0, 1) for dot in centres[c]):
        cv2.circle(image, (round(x), round(y)), 8, 40, -1)
    declared = replace(there, marker_centres_body=there.marker_centres_body * [1, -1, 1])
    (finding,) = arrangement_found(images, clip.rig, declared)
    assert (finding.kind, finding.remedies[0].action) == (Kind.DOTS_MISPLACED, "y with the other sign")


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("scale", "said"),
    [
        (1000.0, "are mm and m mixed up?"),
        (0.1, "square_mm, times 10; or every length of [disc] and [markers], times 0.1"),
        (1.25, "[disc] and [markers], times 1.25"),
    ],
)
def test_a_board_in_another_unit_is_named_with_the_factor(clip, scale, said):
    rig = replace(clip.rig, t_right_left=scale * clip.rig.t_right_left, t_left_world=scale * clip.rig.t_left_world)
    with pytest.raises(TrackingError, match=re.escape(said)):
        measure(clip.images[:4], rig, clip.disc)


def doubts_of(tracking):
    return [finding.sentence for finding in tracking.trajectory.findings if finding.doubtful]


def with_dots(disc, shift_mm):
    """The disc as a user declares it who errs by shift_mm (m, 2) in the dots' places."""
    centres = disc.marker_centres_body.copy()
    centres[:, :2] += 1e-3 * shift_mm
    return replace(disc, marker_centres_body=centres)


def test_dots_declared_by_a_ruler_are_located_as_those_declared_right(clip):
    """What the template is made for must not pull: the images are the same, and so is their noise."""
    off = 0.1 * np.random.default_rng(3).normal(size=(clip.disc.n_markers, 2))
    found = measure(clip.images, clip.rig, with_dots(clip.disc, off)).trajectory
    pulled = found.markers_px - clip.untouched.trajectory.markers_px
    assert np.sqrt(np.nanmean(pulled**2)) < 5e-5  # 2.3e-3 by templates at the declared places; noise is 2e-3


@pytest.mark.statistical
def test_dots_declared_too_far_off_to_be_followed_are_told(clip):
    """Places by a ruler: no dot fits the template, and the error says what to declare."""
    off = 0.5 * np.random.default_rng(3).normal(size=(clip.disc.n_markers, 2))
    with pytest.raises(TrackingError, match=r"centres_mm: \[\[") as told:
        measure(clip.images[:4], clip.rig, with_dots(clip.disc, off))
    centres = np.array(json.loads(re.search(r"centres_mm: (\[\[.*?\]\])", str(told.value))[1]))
    found, expected = (pdist(places) for places in (centres, 1e3 * clip.disc.marker_centres_body[:, :2]))
    np.testing.assert_allclose(found, expected, atol=0.25)  # blobs err by up to 0.5 px, 0.2 mm


@pytest.mark.statistical
@pytest.mark.parametrize("turn_deg", [0.05, 0.1])
def test_a_camera_turned_a_little_is_one_fault_and_not_a_trembling_table_too(clip, turn_deg):
    """Poses do scatter there, as now this, now that dot is struck: named once, by its cause."""
    turn = frames.rotation_from_vector(np.radians(turn_deg) * np.array([0.6, 0.8, 0.0]))
    rig = replace(clip.rig, R_right_left=turn @ clip.rig.R_right_left, t_right_left=turn @ clip.rig.t_right_left)
    causes = {f.kind for f in leading(measure(clip.images, rig, clip.disc).trajectory.findings)}
    assert causes & {Kind.DOTS_MISFIT, Kind.CAMERA_MOVED}
    assert Kind.POSES_SCATTER not in causes


@pytest.mark.statistical
def test_blobs_at_random_are_no_disc_of_any_kind(clip, rng):
    """Neither a camera that moved nor other dots are read into pictures of something else."""
    for _ in range(15):
        pairs = np.full((12, 2, 272, 272), 190, np.uint8)
        for image in pairs.reshape(-1, 272, 272):
            for _ in range(rng.integers(0, 12)):
                place, size = ([int(v) for v in rng.integers(low, high, 2)] for low, high in ((0, 272), (2, 30)))
                angle, ink = float(rng.uniform(0, 180)), int(rng.integers(0, 120))
                cv2.ellipse(image, place, size, angle, 0, 360, ink, -1, cv2.LINE_AA)
        assert not list(moved_camera(pairs, clip.rig, clip.disc))
        assert not unlike_declared(pairs[0], clip.rig, clip.disc)


def test_no_scale_is_told_where_no_dots_are(clip):
    """The disc as declared, and images that show none: no unit is blamed."""
    noise = np.random.default_rng(1).normal(120, 30, clip.images[:2].shape).clip(0, 255).astype(np.uint8)
    with pytest.raises(TrackingError) as told:
        measure(noise, clip.rig, clip.disc)
    assert not told.value.findings


def test_a_hand_before_one_camera_is_no_sign_of_images_left_out(clip):
    images = clip.images.copy()
    images[20:, 1] = 90
    assert Kind.DROPPED_FRAMES not in {f.kind for f in measure(images, clip.rig, clip.disc).trajectory.findings}


def test_a_camera_that_stays_ahead_is_told_once(clip):
    """Although two images between show nothing; the other camera measures the frames."""
    images = clip.images.copy()
    images[9:-2, 1] = images[11:, 1]
    images[25:27, 0] = 0
    found = measure(images[:-2], clip.rig, clip.disc)
    (told,) = [doubt for doubt in doubts_of(found) if "ahead of" in doubt]
    assert "left out 2 images at frame 9." in told
    assert (found.trajectory.frame_status[9:25] == FrameStatus.ONE_CAMERA).all()


def test_a_frame_rate_at_which_no_motion_joins_the_frames_is_a_doubt_that_names_it(clip):
    """The frames are refused, one by one and rightly; a recording that loses most of them is no success."""
    found = measure(clip.images, clip.rig, clip.disc, rate=1e8)
    assert found.trajectory.measured.sum() < N / 2
    assert in_doubt(found.trajectory.findings)
    (first, *_) = leading(found.trajectory.findings)
    assert first.kind == Kind.CLOCK_JUMP
    assert "the frame rate is far too high" in first.text


def test_glare_on_some_dots_takes_their_weight_and_the_covariance_follows(clip):
    """It reaches all dots of the left image, and shifts one by ten sigmas whose own template hardly shows it."""
    assert clip.silently_wrong(glare, 8) == []
    images = clip.images.copy()
    glare(images, clip.places, np.random.default_rng(8))
    found, before = measure(images, clip.rig, clip.disc).trajectory, clip.untouched.trajectory
    assert (images[30, 0] != clip.images[30, 0]).any()
    assert found.frame_status[30] == FrameStatus.MEASURED
    grown = (found.markers_covariance_px2 / before.markers_covariance_px2)[30, :, :, 0, 0]
    assert (grown[0] > 50).all()
    assert (grown[1] < 2).all()


def test_after_a_hand_the_disc_is_found_at_once(clip):
    images, rng = clip.images.copy(), np.random.default_rng(5)
    y, x = np.mgrid[: images.shape[2], : images.shape[3]]
    for i in range(12, 20):
        for camera in (0, 1):
            u, v = clip.places[i, camera]
            hand = (x - u) * np.cos(3.1) + (y - v) * np.sin(3.1) > -15  # over more than half of the dots
            images[i, camera][hand] = rng.integers(80, 120, hand.sum())
    status = measure(images, clip.rig, clip.disc).trajectory.frame_status
    assert (status[20:] == FrameStatus.MEASURED).all()


@pytest.mark.statistical
@pytest.mark.parametrize("kind", ["nothing", "another layout"])
def test_a_recording_without_the_disc_ends_soon_and_says_so(clip, kind):
    n, disc = 300, clip.disc
    images = np.resize(clip.images, (n, *clip.images.shape[1:]))
    if kind == "nothing":
        rng = np.random.default_rng(1)
        images = (90 + 30 * rng.random((n, 2, 1, 1)) + 20 * rng.random(images.shape)).astype(np.uint8)
    else:
        centres = disc.marker_centres_body * [[0.8, 0.8, 1], *[[0.6, 0.7, 1]] * 5]
        disc = Disc(disc.radius, disc.half_thickness, disc.mass, centres, disc.marker_diameter)
    began = time.process_time()
    with pytest.raises(TrackingError, match="found in none of the pairs 0-299"):
        measure(images, clip.rig, disc)
    # some 16 searches of 0.3 s; before, one or two in every frame took 90 s
    assert time.process_time() - began < 25


@pytest.mark.slow
def test_of_a_hundred_random_faults_none_passes_in_silence():
    """Rendered here, with the poses that were rendered as the truth, through the true rig."""
    scene = Scene()
    rig, disc = rig_of(scene), scene.declared_disc
    images, q = rolling_disc(rig, disc, scene, 8, N)
    lab = Laboratory(images, rig, disc, truth=q)
    silent = {}
    for seed in range(112):
        fault = FAULTS[seed % len(FAULTS)]
        if wrong := lab.silently_wrong(fault, [14, seed]):
            silent[f"{fault.__name__} {seed}"] = wrong
    assert silent == {}


def test_frames_that_an_encoder_predicts_from_one_another_scatter_as_stated(clip, tmp_path):
    """H.264 moves blocks of an image together: dots err alike, poses farther than the dots' misfit tells."""
    lossy = []
    for side, camera in enumerate(frames.CAMERAS):
        write_video(tmp_path / f"{camera}.mp4", clip.images[:, side], "gray", "libx264", crf="23")
        reader = open_frames(f"{camera}.mp4", tmp_path, camera)
        lossy.append([reader.read(i) for i in range(N)])
    found = measure(np.stack(lossy, axis=1), clip.rig, clip.disc)
    error = compare(found.trajectory, clip.untouched.trajectory.q).error
    stated = found.trajectory.pose_covariance + found.trajectory.calibration_covariance
    ratio = np.nanmean(error**2 / np.einsum("nii->ni", stated), axis=0)
    assert (ratio < 2.5).all()  # errors of neighbouring frames are alike: 48 are some 16
    assert any("the frames were compressed as video" in f.text for f in found.trajectory.findings)
    assert max(clip.untouched.details["pose_variance_factor"]) < 1.5
    assert not any("compressed as video" in f.text for f in clip.untouched.trajectory.findings)


def test_no_camera_is_said_to_have_moved_where_none_did(clip):
    assert not list(moved_camera(clip.images[::4], clip.rig, clip.disc))
