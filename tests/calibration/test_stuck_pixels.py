"""Pixels that do not see are found in a moving scene, and in views of a board, and replaced; a sharp scene has none."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from calibration import Board, CornerView, calibrate_stereo, find_corners
from calibration.kit.stuck_pixels import repair, repaired_views, stuck_pixels


def scene(rng, frames=6, size=120):
    """Dark dots with sharp edges, and squares, that move by two pixels a frame over a texture that rests."""
    y, x = np.mgrid[:size, :size]
    still = 90 + 10 * np.sin(0.9 * x) * np.sin(0.7 * y)
    images = []
    for i in range(frames):
        image = still.copy()
        for u, v in ((30, 40), (80, 70)):
            image[np.hypot(x - u - 2 * i, y - v) < 12] = 25
        image[95:, :] = np.where((x + 2 * i)[95:] // 9 % 2, 20, 200)
        images.append(image + rng.normal(0, 1.5, image.shape))
    return np.clip(np.rint(images), 0, 255).astype(np.uint8)


def test_a_scene_without_faults_has_no_stuck_pixels(rng):
    assert stuck_pixels(scene(rng)) is None
    assert stuck_pixels(scene(rng)[:2]) is None  # two images tell nothing


def test_hot_and_dead_pixels_are_found_and_replaced(rng):
    clean = scene(rng)
    where = rng.permutation(clean[0].size)[:40]
    for images in (clean, clean.astype(np.uint16) * 64):
        seen = images.copy()
        seen.reshape(len(seen), -1)[:, where[::2]], seen.reshape(len(seen), -1)[:, where[1::2]] = images.max(), 0
        found = stuck_pixels(seen)
        assert set(np.flatnonzero(found)) <= set(where)
        assert found.sum() >= 26  # a dead one in the dark, or a hot one on white, is hard to tell, and harmless
        mended = seen.copy()
        for image in mended:
            repair(image, found)
        assert_array_equal(mended[:, ~found], seen[:, ~found])
        scale = images.max() / 255
        off = np.abs(mended[:, found].astype(float) - images[:, found]) / scale
        assert np.median(off) < 5  # the texture
        assert np.percentile(off, 90) < 60  # on the edge of a square the neighbours disagree


def test_neighbouring_stuck_pixels_do_not_stand_in_for_each_other(rng):
    images = scene(rng)
    mask = np.zeros(images[0].shape, bool)
    mask[10:12, 10:12] = mask[0, 0] = True
    images[:, mask] = 255
    repair(images[0], mask)
    assert np.all(images[0][mask] < 120)


@pytest.mark.statistical
def test_pixels_that_do_not_see_are_named_in_views_and_cost_no_corner(sample_clip, rng):
    views, spoilt = {}, {}
    for side in ("left", "right"):
        files = sorted((sample_clip / "calibration" / side).glob("*.png"))
        views[side] = [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]
        assert stuck_pixels(views[side], of_board=True) is None
        where, spoilt[side] = rng.permutation(views[side][0].size)[:50], [view.copy() for view in views[side]]
        for view in spoilt[side]:
            view.flat[where[::2]], view.flat[where[1::2]] = 255, 0
    found = calibrate_stereo(spoilt["left"], spoilt["right"], Board((9, 6), 6e-3))
    for name, side, corners in zip(("left", "right"), views, found.corner_views, strict=True):
        told = [text for text in found.warnings if text.startswith(f"{name} camera: ") and "one value" in text]
        # of those over which the board or its shadow never went nothing is known, and they lie under no corner
        assert len(told) == 1
        assert 20 <= int(told[0].split()[2]) <= 50
        off = []
        for view, seen in zip(views[side], corners, strict=True):
            clean = find_corners(view, (9, 6))
            assert isinstance(clean, CornerView)
            assert isinstance(seen, CornerView)
            assert seen.accepted.sum() >= clean.accepted.sum()
            both = seen.accepted & clean.accepted
            off.append((seen.points - clean.points)[both])
        assert np.sqrt(np.mean(np.concatenate(off) ** 2)) < 1e-3


@pytest.mark.statistical
def test_pixels_that_do_not_see_are_replaced_in_colour_views_and_in_arrays(sample_clip, rng):
    notes = {}
    for side in ("left", "right"):
        files = sorted((sample_clip / "calibration" / side).glob("*.png"))
        grey = [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]
        seen = [np.stack([view, view, view // 2], axis=-1) for view in grey]
        clean, note = repaired_views(seen, side)
        assert note == ""
        assert all(one is other for one, other in zip(clean, seen, strict=True))  # nothing is copied for nothing
        where = rng.permutation(grey[0].size)[:50]
        for view in seen:
            view.reshape(-1, 3)[where[::2], 1], view.reshape(-1, 3)[where[1::2], 1] = 255, 0  # of one channel
        before = [view.copy() for view in seen]
        mended, notes[side] = repaired_views(seen, side)
        assert_array_equal(np.stack(seen), np.stack(before))
        for view, was, true in zip(mended, seen, grey, strict=True):
            assert_array_equal(view[..., ::2], was[..., ::2])
            changed = np.flatnonzero(view[..., 1] != was[..., 1])
            assert set(changed) <= set(where)
            assert np.median(np.abs(view[..., 1].astype(int) - true).flat[changed]) < 10
    assert all(20 <= int(note.split()[2]) <= 50 for note in notes.values())
