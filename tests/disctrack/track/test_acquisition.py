"""Finding and numbering the dots without a prior."""

from dataclasses import replace

import numpy as np
import pytest

from disctrack import frames
from disctrack.disc import MA_2014, disc_from_mm, has_mirror_axis, symmetry_order
from disctrack.faults.dots import marker_pixels
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import Scene
from disctrack.track.dots.acquisition import acquire, acquire_from_blobs, dot_blobs


def assert_found(answer, R, t, shift, turn_deg):
    (R_found, t_found), _, reason = answer
    assert reason == ""
    assert np.linalg.norm(t_found - t) < shift
    assert np.degrees(np.linalg.norm(frames.vector_from_rotation(R_found @ R.T))) < turn_deg


def test_the_disc_is_found_in_whatever_attitude(rendered_pairs):
    p = rendered_pairs
    eyes = [-R.T @ t for R, t in p.rig.camera_poses()]
    for images, R, q in zip(p.images, p.R, p.q, strict=True):
        views = [np.degrees(np.arccos(R[:, 2] @ (eye - q[:3]) / np.linalg.norm(eye - q[:3]))) for eye in eyes]
        if max(views) > 70:  # one camera sees the face nearly edge-on, or from behind
            continue
        # centroids of thresholded blobs: 0.3 px of 12 dots, that is 0.05 mm and 0.2 deg
        assert_found(acquire(images, p.rig, p.disc), R, q[:3], 2e-4, 0.7)


def test_one_camera_is_enough(rendered_pairs):
    p = rendered_pairs
    black = np.zeros_like(p.images[0, 0])
    for i in (4, 9, 12):
        found = acquire((p.images[i, 0], black), p.rig, p.disc)
        assert_found(found, p.R[i], p.q[i, :3], 3e-3, 4.0)  # depth of one camera from centroids


def test_clutter_and_missing_dots_do_not_mislead(rng):
    rig, disc = rig_of(Scene()), MA_2014
    for trial in range(6):
        euler = rng.uniform([-3, 0.05, -3], [3, 0.5, 3])
        R, t = frames.rotation_from_euler(*euler), np.array([0.03, 0.02, 0.012])
        pixels = marker_pixels(R[None], t[None], rig, disc.marker_centres_body)[0][0]
        blobs = []
        for camera in (0, 1):
            seen = np.delete(pixels[camera], (trial + camera) % 6, axis=0)  # one dot missing in each, not the same
            clutter = rng.uniform(40, 470, (5, 2))
            blobs.append(rng.permutation(np.concatenate([seen + 0.2 * rng.normal(size=seen.shape), clutter])))
        assert_found(acquire_from_blobs(blobs, rig, disc), R, t, 3e-4, 1.0)


def test_an_empty_scene_is_said_to_be_empty(rendered_pairs):
    table = np.full((512, 512), 85, np.uint8)
    pose, explained, reason = acquire((table, table), rendered_pairs.rig, rendered_pairs.disc)
    assert (pose, explained) == (None, 0)
    assert "0 in the left and 0 in the right" in reason
    assert "[markers]" in reason


def test_blobs_are_found_on_both_polarities_and_under_a_light_gradient(rendered_pairs):
    image = rendered_pairs.images[6, 0]
    truth = rendered_pairs.true_pixels[6, 0]
    shaded = (image * np.linspace(0.35, 1.0, 512)).astype(np.uint8)
    for picture in (image, 220 - image, shaded):
        blobs = dot_blobs(picture, 28.0)[:, :2]
        gap = np.linalg.norm(truth[:, None] - blobs[None], axis=-1).min(axis=1)
        assert gap.max() < 1.0


@pytest.mark.parametrize(("n", "order"), [(1, 1), (2, 2), (3, 3), (6, 6)])
def test_symmetric_layouts_are_recognised(n, order):
    angle = 2 * np.pi * np.arange(n) / n
    disc = disc_from_mm(37.5, 6, 200, 20 * np.column_stack([np.cos(angle), np.sin(angle)]), 7)
    assert symmetry_order(disc) == order


def test_the_default_layout_has_no_symmetry():
    assert symmetry_order(MA_2014) == 1
    moved = MA_2014.marker_centres_body.copy()
    moved[5] *= (2, 2, 1)  # the sixth dot out to the others: a hexagon
    assert symmetry_order(replace(MA_2014, marker_centres_body=moved)) == 6


def test_layouts_that_look_the_same_in_a_mirror_are_recognised():
    rng = np.random.default_rng(2)
    for angle in rng.uniform(0, 2 * np.pi, 5):  # the default one has an axis, whichever way it is turned
        turned = MA_2014.marker_centres_body @ frames.rotation_from_vector(np.array([0, 0, angle])).T
        assert has_mirror_axis(replace(MA_2014, marker_centres_body=turned))
        turned[0, :2] *= 0.7
        assert not has_mirror_axis(replace(MA_2014, marker_centres_body=turned))
    assert not has_mirror_axis(disc_from_mm(37.5, 6, 200, rng.uniform(-25, 25, (6, 2)), 7))
