"""Grey values of any depth, and pixels that do not see: found, replaced, and without a part in the corners."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration import Board, calibrate_stereo, find_corners
from calibration.kit.grey_levels import full_scale, level_step, mosaic_gains, saturation_level
from calibration.kit.stuck_pixels import repair, repaired_views, stuck_pixels
from tests.calibration.test_chessboard import located


@pytest.mark.parametrize(("bits", "step"), [(8, 1), (8, 16), (8, 257), (10, 64), (12, 1), (12, 16), (16, 1)])
def test_step_and_full_scale_of_a_camera_are_found_from_its_grey_values(rng, bits, step):
    light = rng.uniform(0.02, 0.7, (64, 64))  # of full scale
    image = (step * np.rint(light * (2**bits - 1))).astype(np.uint16)
    assert level_step(image) == step
    assert full_scale(image) == step * (2**bits - 1)
    assert level_step(image.astype(np.uint8)) == 1


def test_images_of_few_values_have_no_step():
    assert level_step(np.full((8, 8), 4000, np.uint16)) == 1
    assert level_step(np.where(np.eye(8) > 0, 160, 4000).astype(np.uint16)) == 1


@pytest.mark.parametrize(("dtype", "level"), [(np.uint8, 255), (np.uint16, 4095), (np.uint16, 3700)])
def test_saturation_shows_where_pixels_are_clipped_and_only_there(rng, dtype, level):
    light = rng.normal(0.9 * level, 0.03 * level, (200, 200))
    light[:, :60] *= 0.2
    assert saturation_level(np.rint(light * 0.8).astype(dtype)) is None
    evenly = (level // 2 + rng.integers(0, 50, light.shape)).astype(dtype)  # hundreds of pixels at the largest value,
    assert saturation_level(evenly) is None  # and as many at every other
    clipped = np.minimum(np.rint(light * 1.1), level).astype(dtype)
    assert saturation_level(clipped) == level


@pytest.mark.parametrize("scale", [3, 16, 257])
def test_corners_do_not_depend_on_the_unit_of_grey(sample_clip, scale):
    image = cv2.imread(str(sample_clip / "calibration" / "left" / "03.png"), cv2.IMREAD_UNCHANGED)
    plain, scaled = find_corners(image, (9, 6)), find_corners(image.astype(np.uint16) * np.uint16(scale), (9, 6))
    assert_array_equal(scaled.points, plain.points)
    assert_array_equal(scaled.covariance, plain.covariance)


@pytest.mark.parametrize("gains", [[[0.75, 1.0], [1.0, 0.55]], [[1.02, 0.99], [0.99, 1.0]], [[1.0, 1.0], [1.0, 0.97]]])
def test_a_colour_filter_shows_in_every_image_of_a_scene_and_in_no_other(rng, gains):
    y, x = np.mgrid[:121, :161]
    light = 150 * (1 - x / 330) * (1 - y / 400) * np.where(np.hypot(x - 70, y - 60) < 15, 0.2, 1.0)  # falls off by half
    # columns of a sensor without a filter differ by 0.3 %
    plain = light * np.array([1.0, 1.003])[x % 2] + rng.normal(0, 1.0, (4, *light.shape))
    assert mosaic_gains(np.rint(plain).astype(np.uint8)) is None
    filtered = np.rint(plain * np.array(gains)[y % 2, x % 2]).astype(np.uint8)
    found = mosaic_gains(filtered)
    assert_allclose(found, np.array(gains) / np.mean(gains), atol=0.004)  # the columns, and rounding
    assert mosaic_gains(np.concatenate([filtered[:3], np.rint(plain[:1]).astype(np.uint8)])) is None


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


@pytest.fixture
def views(sample_clip):
    """Images of the board by camera."""
    files = {side: sorted((sample_clip / "calibration" / side).glob("*.png")) for side in ("left", "right")}
    return {side: [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in some] for side, some in files.items()}


@pytest.mark.statistical
def test_pixels_that_do_not_see_are_named_in_views_and_cost_no_corner(views, rng):
    spoilt = {}
    for side, clean in views.items():
        assert stuck_pixels(clean, of_board=True) is None
        where, spoilt[side] = rng.permutation(clean[0].size)[:50], [view.copy() for view in clean]
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
            clean = located(view)
            assert seen.accepted.sum() >= clean.accepted.sum()
            both = seen.accepted & clean.accepted
            off.append((seen.points - clean.points)[both])
        assert np.sqrt(np.mean(np.concatenate(off) ** 2)) < 1e-3


@pytest.mark.statistical
def test_pixels_that_do_not_see_are_replaced_in_colour_views_and_in_arrays(views, rng):
    notes = {}
    for side, grey in views.items():
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
