"""Sensors and light at their worst, by the independent laboratory: no wrong pose without a flag, the rest untouched."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import disctrack
from calibration.cameras.camera import Camera, StereoRig
from disctrack.disc import MA_2014
from disctrack.frames import rotation_from_quaternion, vector_from_rotation
from disctrack.trajectory import FrameStatus, MarkerStatus
from tests.oracles import imperfect_laboratory as laboratory
from tests.oracles.imperfect_laboratory import Trouble
from tests.oracles.point_laboratory import poses_of

FRAMES = 64
DURING = range(8, 58)  # fifty frames
TROUBLES = {
    "nothing": {},
    "40 grey values between ink and paper": {"trouble": Trouble(contrast=40 / 165)},
    "a pixel and a half of defocus": {"blur": 1.5},
    "four pixels of defocus": {"blur": 4.0},  # of dots with half axes of 9 to 14 px: their edges run into each other
    "hot and dead pixels": {"trouble": Trouble(stuck_pixels=250)},
    "a hand over half of the disc": {"trouble": Trouble(hand=DURING)},
    "a lamp at 100 Hz": {"trouble": Trouble(flicker=0.2)},
    "saturated glare on one dot": {"trouble": Trouble(glare=DURING)},
}


def rig_of(cameras):
    """The true cameras; their lenses have no field here."""
    (left, right) = (
        Camera(c.focal, c.focal, *c.middle, (c.k1, c.k2, 0.0, 0.0, 0.0), (c.size, c.size)) for c in cameras
    )
    (R, t), (R_right, t_right) = ((c.R, -c.R @ c.place) for c in cameras)
    pair = R_right @ R.T
    return StereoRig(left, right, pair, t_right - pair @ t, R, t, world_is_table=True)


@cache
def filmed(name, frames=FRAMES):
    """Trajectory with the true rig, and the errors of its poses in units of their own sigma, NaN without a pose."""
    plan = laboratory.Plan(5, frames, imperfections=replace(laboratory.IDEAL, exposure=2e-4), **TROUBLES[name])
    rng = np.random.default_rng([plan.seed, 3])
    cameras = [laboratory.Camera(rng, plan, a, np.array([0.032, 0.02, 0.004])) for a in plan.azimuths]
    spline, times = laboratory.motion(plan), np.arange(frames) / plan.frame_rate
    images = []
    for i, time in enumerate(times):
        poses = laboratory.poses_during(spline, time, plan.imperfections.exposure)
        images.append([laboratory.disc_image(camera, plan, poses, laboratory.DOTS, rng, i) for camera in cameras])
    disc = replace(MA_2014, radius_tolerance=0.0, thickness_tolerance=0.0)
    found = disctrack.measure_pairs(np.array(images), rig_of(cameras), disc, plan.frame_rate)
    trajectory = found.trajectory
    R, t = poses_of(spline(times))
    turn = vector_from_rotation(rotation_from_quaternion(trajectory.quaternion) @ np.swapaxes(R, 1, 2))
    error = np.concatenate([trajectory.q[:, :3] - t, turn], axis=1)
    whole = trajectory.pose_covariance + trajectory.systematic_covariance
    return found, error, error / np.sqrt(np.diagonal(whole, axis1=1, axis2=2))


@pytest.mark.slow
@pytest.mark.parametrize("name", TROUBLES)
def test_no_pose_is_wrong_without_a_flag(name):
    found, _, sigmas = filmed(name)
    trajectory = found.trajectory
    posed = trajectory.measured
    unflagged = trajectory.frame_status == FrameStatus.MEASURED
    assert np.all(np.abs(sigmas[posed & unflagged]) < 5), (name, np.nanmax(np.abs(sigmas), axis=0))
    assert np.all(np.abs(sigmas[posed]) < 8)  # those with a flag, too, have a sigma that is worth something
    untouched = np.ones(FRAMES, bool)
    if "hand" in name or "glare" in name:
        untouched[DURING.start : DURING.stop] = False
    assert np.all(unflagged[untouched])


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in TROUBLES if "hand" in name or "glare" in name])
def test_the_rest_of_the_recording_is_as_without_the_trouble(name):
    (_, plain, _), (_, error, _) = filmed("nothing"), filmed(name)
    rest = np.ones(FRAMES, bool)
    rest[DURING.start : DURING.stop] = False
    noise = np.std(plain, axis=0)
    assert np.all(np.std(error[rest], axis=0) < 1.8 * noise)  # 14 frames: sigma within 20 %
    assert np.all(np.abs(np.mean(error[rest], axis=0)) < 5 * noise / np.sqrt(rest.sum()))


@pytest.mark.statistical
def test_four_pixels_of_defocus_cost_noise_and_nothing_else():
    found, error, sigmas = filmed("four pixels of defocus", 6)
    assert np.all(found.trajectory.frame_status == FrameStatus.MEASURED)
    assert np.all(found.trajectory.marker_status == MarkerStatus.MEASURED)
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 2e-6  # m; 0.4e-6 in focus
    # 36 numbers, those of a frame by 6 degrees of freedom each
    assert 0.3 < np.mean(sigmas**2) < 2.0
