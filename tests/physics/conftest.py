"""True motions of a rolling disc, and trajectories as a tracker gives them.

The motions are the simulation's, which test_rolling_equations holds against world vectors; the analysis of trajectories
shares nothing with it.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calibration.cameras.camera import N_RIG, Camera, StereoRig
from disctrack import FrameStatus, Trajectory, frames
from disctrack.analyse.derivatives import MotionState
from disctrack.disc import MA_2014
from disctrack.rolling import Model, Motion, simulate, steady_precession
from disctrack.track.pose import DotsInFrames, PoseFits
from disctrack.track.refine.assembly import Taken, trajectory_of


@dataclass(frozen=True)
class TrueMotion(MotionState):
    """Motion known to round-off, at n instants; world axes, SI."""

    time: np.ndarray
    euler: np.ndarray
    rates: np.ndarray  # psidot, thetadot, phidot, omega_3

    def __getitem__(self, part: slice) -> "TrueMotion":
        return TrueMotion(*(getattr(self, name)[part] for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.time)


@lru_cache(maxsize=16)
def true_motion(theta_deg, duration, k_m=0.381e-7, nutation=0.05, spin=0.0) -> TrueMotion:
    """Rolling from theta to 0.5 deg; `nutation` is the first thetadot over psidot theta, `spin` added to omega_3."""
    theta = np.radians(theta_deg)
    steady = steady_precession(theta, MA_2014).moved(psi=0.3, phi=0.1, x=0.05, y=0.04)
    start = steady.moved(thetadot=nutation * steady.psidot * theta, omega3=steady.omega3 + spin)
    model = Model(MA_2014).with_values({"km.k_m": k_m})
    return of_simulation(simulate(model, start, duration, theta_end=np.radians(0.5)))


def of_simulation(made: Motion) -> TrueMotion:
    return TrueMotion(
        time=made.time,
        position=made.q[:, :3],
        R_world_body=frames.rotation_from_euler(*made.q[:, 3:].T),
        velocity=made.qdot[:, :3],
        omega_world=made.omega_world,
        acceleration=made.acceleration_world,
        alpha_world=made.angular_acceleration_world,
        euler=made.q[:, 3:],
        rates=np.column_stack([made.qdot[:, 3:], made.state[:, 7]]),
    )


# Scatter of one pose: 0.4, 0.4, 0.5 um and 1 mdeg about each axis, with the correlation between a shift across the
# view and a turn about the axis normal to it that a tracker of dots has.
POSE_SIGMA = np.array([0.4e-6, 0.4e-6, 0.5e-6, *np.full(3, np.radians(1e-3))])


def pose_covariance() -> np.ndarray:
    correlation = np.eye(6)
    correlation[0, 4] = correlation[4, 0] = 0.5
    correlation[1, 3] = correlation[3, 1] = -0.4
    return correlation * np.outer(POSE_SIGMA, POSE_SIGMA)


def as_tracked(truth: TrueMotion, rng, missing=(), noise=1.0, sensitivity=None, rig_covariance=None) -> Trajectory:
    """Trajectory of a true motion: poses with noise and the covariance of that noise."""
    n = len(truth)
    P = noise**2 * pose_covariance()
    error = rng.multivariate_normal(np.zeros(6), P, n, method="cholesky") if noise else np.zeros((n, 6))
    R = frames.rotation_from_vector(error[:, 3:]) @ truth.R_world_body
    position = truth.position + error[:, :3]
    status = np.full(n, FrameStatus.MEASURED, np.uint8)
    missing = list(missing)
    R[missing], position[missing], status[missing] = np.nan, np.nan, FrameStatus.MARKERS_NOT_FOUND
    camera = Camera(1000.0, 1000.0, 255.5, 255.5, (0.0, 0.0, 0.0, 0.0, 0.0), (512, 512))
    covariance = np.zeros((N_RIG, N_RIG)) if rig_covariance is None else rig_covariance
    rig = StereoRig(camera, camera, np.eye(3), np.array([-0.2, 0, 0]), covariance=covariance, world_is_table=True)
    dots, good = np.full((n, 2, 6, 2), np.nan), np.zeros((n, 2, 6), np.uint8)  # no dot was looked at
    stated = np.broadcast_to(P if noise else pose_covariance(), (n, 6, 6)).copy()
    by_rig = np.zeros((n, 6, N_RIG)) if sensitivity is None else sensitivity
    fits = PoseFits(R, position, stated, by_rig, dots, good == 0, np.ones(n), np.ones(n, int), np.ones(n, bool))
    seen = DotsInFrames(rig, MA_2014, dots, dots[..., None, :].repeat(2, axis=-2), R, position)
    taken = Taken(range(n), 1000.0, 9.81, truth.time)
    return trajectory_of(seen, fits, np.zeros((n, 6, 6)), status, good, taken)
