"""Frames of more than 8 bits are used as they are: units of grey change nothing, finer rounding does."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from disctrack import measure_pairs
from disctrack.commands.sample import SCENE
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import load_scene
from disctrack.synthetic.motion import motion_of
from disctrack.track.video_overlay import draw_pair
from tests.rendering import render_disc

N = 24


@pytest.fixture(scope="module")
def dim():
    """12-bit images (N, 2, h, w) at 8 % of the light, their rig, disc and true centres (N, 3) [m].

    The sample clip's scene, with a sensor whose noise is far below a grey value of 8 bits.
    """
    scene = load_scene(SCENE)
    surfaces = ("paper", "dot", "rim", "side", "underside")
    dark = {name: 0.08 * getattr(scene.appearance, name) for name in surfaces}
    scene = scene.changed(appearance=dark, cameras={"n_frames": N, "bit_depth": 12}, sensor={"read_noise_dn": 0.05})
    q = motion_of(scene)[0](np.arange(N) / 1000.0)
    rig, disc = rig_of(scene), scene.declared_disc
    return render_disc(q, rig, disc, scene, np.random.default_rng(5)), rig, disc, q[:, :3]


@pytest.fixture(scope="module")
def plain(dim):
    return measure_pairs(*dim[:3], 1000.0)


@pytest.mark.parametrize("scale", [16, 13])
def test_poses_do_not_depend_on_the_unit_of_grey(dim, plain, scale):
    images, rig, disc, _ = dim
    scaled = measure_pairs(images * np.uint16(scale), rig, disc, 1000.0)
    # metres and radians; the same sums in other units, so round-off only
    assert_allclose(scaled.trajectory.q, plain.trajectory.q, rtol=0, atol=1e-9)
    assert_allclose(scaled.trajectory.pose_covariance, plain.trajectory.pose_covariance, rtol=1e-6)
    assert scaled.details["noise"][0]["step"] == scale


def test_twelve_bits_scatter_less_than_the_same_frames_rounded_to_eight(dim, plain):
    images, rig, disc, centres = dim
    eight = np.rint(images * (255 / 4095)).astype(np.uint8)
    assert 10 < eight.max() < 20  # the premise: rounding to whole grey values of 8 bits is felt
    followed = (plain, measure_pairs(eight, rig, disc, 1000.0))
    errors = [np.std(tracking.trajectory.q[:, :3] - centres, axis=0) for tracking in followed]
    # measured 0.5 on 60 frames; the ratio of two standard deviations of 24 scatters by 0.2 of itself, the mean by 0.12
    assert np.mean(errors[0] / errors[1]) < 0.75


def test_the_overlay_shows_deep_frames_as_bright_as_those_of_eight_bits(dim, plain, rng):
    images, trajectory = dim[0], plain.trajectory
    bright = np.clip(12 * images[2].astype(int) + rng.integers(0, 12, images[2].shape), 0, 4095).astype(np.uint16)
    shown = [draw_pair(pair, trajectory, 2) for pair in (bright, np.rint(bright * (255 / 4095)).astype(np.uint8))]
    assert np.abs(shown[0].astype(int) - shown[1]).max() <= 1  # one is rounded, the other cut
