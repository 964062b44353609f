"""Images in memory: what the cameras of a rig see of discs and boards, with the look and the noise of a scene.

Of a scene its disc, rig, motion and faults (but for occluders and the place of the paper) are not used here.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from calibration import StereoRig
from disctrack import Disc, Model, simulate, steady_precession
from disctrack.synthetic.description import Scene
from disctrack.synthetic.images import expected_board_image, expected_disc_image, stages
from disctrack.synthetic.optics import digitise

SMALL_SCENE = """
[cameras]
image_size = [128, 128]
n_frames = 4
[rig]
mm_per_px = 1.0
[board]
n_views = 2
max_tilt_deg = 20
[motion]
kind = "{kind}"
"""


def expected_disc(
    q: ArrayLike, rig: StereoRig, disc: Disc, scene: Scene | None = None, *, qdot=None, visible=None
) -> np.ndarray:
    """Noise-free grey values (n, 2 cameras, height, width) before quantisation; arguments as for `render_disc`."""
    scene, q = scene or Scene(), np.atleast_2d(np.asarray(q, float))
    rates = np.zeros_like(q) if qdot is None else np.broadcast_to(np.asarray(qdot, float), q.shape)
    seen = np.broadcast_to(True if visible is None else np.asarray(visible, bool), (len(q), 2, disc.n_markers))
    exposure = 0.0 if qdot is None else scene.cameras.exposure_s

    def picture(i, c, stage):
        pose = partial(lambda at, rate, dt: at + dt[:, None] * rate, q[i], rates[i])
        drawn = replace(disc, marker_centres_body=disc.marker_centres_body[seen[i, c]])
        return expected_disc_image(pose, exposure, i, stage, scene, drawn)

    return np.array([[picture(i, c, stage) for c, stage in enumerate(stages(rig, scene))] for i in range(len(q))])


def render_disc(
    q: ArrayLike, rig: StereoRig, disc: Disc, scene: Scene | None = None, rng=None, *, qdot=None, visible=None
) -> np.ndarray:
    """Images (n, 2 cameras, height, width) of the disc at the poses q: uint8, or uint16 for more than 8 bits.

    q       : (n, 6) at mid exposure, SI and radians (frames.py); (6,) counts as n = 1
    rig     : the true cameras; disc: the true disc, its marker centres those that are printed
    rng     : noise; None: no noise, only quantisation
    qdot    : (n, 6) rates; the pose moves with them for the exposure time. None: at rest
    visible : (n, 2, m) or what broadcasts to it; False: that dot is missing on the paper
    """
    scene = scene or Scene()
    return _digitised(expected_disc(q, rig, disc, scene, qdot=qdot, visible=visible), scene, rng)


def render_board(
    R_world_board: ArrayLike, t_world_board: ArrayLike, rig: StereoRig, scene: Scene | None = None, rng=None
) -> np.ndarray:
    """Images (n, 2 cameras, height, width) of the chessboard of `scene.board` in n poses, as `render_disc`.

    R_world_board (n, 3, 3), t_world_board (n, 3) [m]: the board's origin is the lower left inner corner seen with the
    side of dark corner squares on the left, its axes run along the long side, the short side and out of the print.
    """
    scene = scene or Scene()
    R, t = np.reshape(R_world_board, (-1, 3, 3)), np.reshape(t_world_board, (-1, 3))
    places = zip(R, t, strict=True)
    expected = [[expected_board_image(*place, stage, scene) for stage in stages(rig, scene)] for place in places]
    return _digitised(expected, scene, rng)


def _digitised(expected, scene, rng):
    """Each image with noise of its own."""
    noise = iter([None] * (2 * len(expected)) if rng is None else rng.spawn(2 * len(expected)))
    depth = scene.cameras.bit_depth
    return np.array([[digitise(grey, scene.sensor, depth, next(noise)) for grey in pair] for pair in expected])


def rolling_poses(disc: Disc, theta_deg: float, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses q (n, 6) of a disc that rolls from this nutation on, in the middle of the field, and their rates."""
    motion = simulate(Model(disc, 9.81), steady_precession(np.radians(theta_deg), disc, 9.81), times=times)
    return motion.q + np.pad([0.032, 0.02] - motion.q[:, :2].mean(axis=0), (0, 4)), motion.qdot


def rolling_disc(rig: StereoRig, disc: Disc, scene: Scene, theta_deg: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Images of it, 1000 pairs/s, and its poses."""
    q, qdot = rolling_poses(disc, theta_deg, np.arange(n) / 1000)
    return render_disc(q, rig, disc, scene, np.random.default_rng(3), qdot=qdot), q
