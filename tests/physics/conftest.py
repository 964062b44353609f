"""True motions of a rolling disc, integrated here from the reduced equations, and trajectories as a tracker gives them.

The equations are those of a disc that rolls without slip (three coupled second-order equations in theta, omega_2 and
omega_3, with the moment M_m = -k_m F_z psidot |psidot|), integrated by SciPy; nothing is shared with disctrack.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from calibration.cameras.camera import N_RIG, Camera, StereoRig
from disctrack.analyse.derivatives import MotionState
from disctrack.disc import MA_2014
from disctrack.frames import (
    continuous_quaternions,
    euler_from_rotation,
    nodal_axes_world,
    quaternion_from_rotation,
    rotation_from_euler,
    rotation_from_vector,
    unwrap_euler,
)
from disctrack.trajectory import FrameStatus, Trajectory

r, h, m = MA_2014.radius, MA_2014.half_thickness, MA_2014.mass
J1, J3 = m * (r * r / 4 + h * h / 3), m * r * r / 2
I1, I2, I3 = J1 + m * (r * r + h * h), J1 + m * h * h, J3 + m * r * r
g = 9.81


@dataclass(frozen=True)
class TrueMotion:
    """Motion known to round-off, at n instants; world axes, SI."""

    time: np.ndarray
    position: np.ndarray
    R: np.ndarray
    velocity: np.ndarray
    omega: np.ndarray
    acceleration: np.ndarray
    alpha: np.ndarray
    euler: np.ndarray
    rates: np.ndarray  # psidot, thetadot, phidot, omega_1, omega_2, omega_3, omega_z

    def __getitem__(self, part: slice) -> "TrueMotion":
        return TrueMotion(*(getattr(self, name)[part] for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.time)

    @property
    def state(self) -> MotionState:
        """What quantities are derived from."""
        return MotionState(self.position, self.R, self.velocity, self.omega, self.acceleration, self.alpha)


def reduced_rates(_t, s, k_m):
    psi, theta, _phi, thetadot, w2, w3, _x, _y = s
    S, C = np.sin(theta), np.cos(theta)
    psidot, L1, L2 = w2 / S, r * C - h * S, r * S + h * C
    thetaddot = (I2 * psidot**2 * S * C - (I3 * S + m * r * h * C) * psidot * w3 + m * r * h * (psidot * S) ** 2) / I1
    thetaddot -= m * g * L1 / I1
    M_m = -k_m * m * (g + L1 * thetaddot - L2 * thetadot**2) * psidot * abs(psidot)
    b2 = -J1 * thetadot * psidot * C + J3 * thetadot * w3 - m * h * psidot * thetadot * L2 + C * M_m
    b3 = m * r * psidot * thetadot * L2 - S * M_m
    det = I2 * I3 - (m * h * r) ** 2
    w2dot, w3dot = (I3 * b2 + m * h * r * b3) / det, (m * h * r * b2 + I2 * b3) / det
    u, w = h * w2 - r * w3, -L2 * thetadot
    x = u * np.cos(psi) - w * np.sin(psi)
    y = u * np.sin(psi) + w * np.cos(psi)
    return np.array([psidot, thetadot, w3 - psidot * C, thetaddot, w2dot, w3dot, x, y])


def steady_precession_rate(theta: float) -> float:
    """Rate at which a disc whose centre rests keeps its nutation: omega_3 = h psidot sin theta / r."""

    def torque(p):
        S = np.sin(theta)
        return reduced_rates(0, [0, theta, 0, 0, p * S, h * p * S / r, 0, 0], 0.0)[3]

    guess = np.sqrt(4 * g / r / np.sin(theta))
    return brentq(torque, guess / 2, guess * 2, xtol=1e-14)


@lru_cache(maxsize=16)
def integrate(theta_deg, duration, k_m=0.381e-7, nutation=0.05, stop_deg=0.5, rate=1000.0, spin=0.0) -> TrueMotion:
    """Rolling from theta; `nutation` is the first thetadot over psidot theta, `spin` added to omega_3 [rad/s]."""
    theta = np.radians(theta_deg)
    p = steady_precession_rate(theta)
    start = [0.3, theta, 0.1, nutation * p * theta, p * np.sin(theta), h * p * np.sin(theta) / r + spin, 0.05, 0.04]

    def lies(_t, s, *_):
        return s[1] - np.radians(stop_deg)

    lies.terminal = True
    run = solve_ivp(
        reduced_rates,
        (0, duration),
        start,
        "DOP853",
        rtol=1e-11,
        atol=1e-13,
        dense_output=True,
        args=(k_m,),
        events=lies,
    )
    time = np.arange(0, run.t[-1], 1 / rate)
    s = run.sol(time).T
    return motion_from_states(time, s, np.array([reduced_rates(0, column, k_m) for column in s]).T)


def motion_from_states(time, s, rates) -> TrueMotion:
    psi, theta, phi, thetadot, w2, w3, x, y = (column[:, None] for column in s.T)
    psidot, _, phidot, thetaddot, w2dot, w3dot, xdot, ydot = (column[:, None] for column in rates)
    S, C = np.sin(theta), np.cos(theta)
    L1, L2 = r * C - h * S, r * S + h * C
    u, w = h * w2 - r * w3, -L2 * thetadot
    udot, wdot = h * w2dot - r * w3dot, -L1 * thetadot**2 - L2 * thetaddot
    e1, e2, e3 = nodal_axes_world(psi[:, 0], theta[:, 0])
    k = np.array([0.0, 0.0, 1.0])
    omega = thetadot * e1 + w2 * e2 + w3 * e3
    turning = np.cross(thetadot * e1 + psidot * k, omega)
    zddot = L1 * thetaddot - L2 * thetadot**2
    return TrueMotion(
        time=time,
        position=np.column_stack([x, y, r * S + h * C]),
        R=rotation_from_euler(psi[:, 0], theta[:, 0], phi[:, 0]),
        velocity=np.column_stack([xdot, ydot, L1 * thetadot]),
        omega=omega,
        acceleration=(udot - psidot * w) * e1 + (wdot + psidot * u) * np.cross(k, e1) + zddot * k,
        alpha=thetaddot * e1 + w2dot * e2 + w3dot * e3 + turning,
        euler=np.column_stack([psi, theta, phi]),
        rates=np.column_stack([psidot, thetadot, phidot, thetadot, w2, w3, omega[:, 2]]),
    )


# Scatter of one pose: 0.4, 0.4, 0.5 um and 1 mdeg about each axis, with the correlation between a shift across the
# view and a turn about the axis normal to it that a tracker of dots has.
POSE_SIGMA = np.array([0.4e-6, 0.4e-6, 0.5e-6, *np.full(3, np.radians(1e-3))])


def pose_covariance() -> np.ndarray:
    correlation = np.eye(6)
    correlation[0, 4] = correlation[4, 0] = 0.5
    correlation[1, 3] = correlation[3, 1] = -0.4
    return correlation * np.outer(POSE_SIGMA, POSE_SIGMA)


def tracked(truth: TrueMotion, rng, missing=(), noise=1.0, sensitivity=None, rig_covariance=None) -> Trajectory:
    """Trajectory of a true motion: poses with noise and the covariance of that noise."""
    n = len(truth)
    P = noise**2 * pose_covariance()
    error = rng.multivariate_normal(np.zeros(6), P, n, method="cholesky") if noise else np.zeros((n, 6))
    R = rotation_from_vector(error[:, 3:]) @ truth.R
    position = truth.position + error[:, :3]
    status = np.full(n, FrameStatus.MEASURED, np.uint8)
    missing = list(missing)
    R[missing], position[missing], status[missing] = np.nan, np.nan, FrameStatus.MARKERS_NOT_FOUND
    camera = Camera(1000.0, 1000.0, 255.5, 255.5, (0.0, 0.0, 0.0, 0.0, 0.0), (512, 512))
    covariance = np.zeros((N_RIG, N_RIG)) if rig_covariance is None else rig_covariance
    rig = StereoRig(camera, camera, np.eye(3), np.array([-0.2, 0, 0]), covariance=covariance, world_is_table=True)
    return Trajectory(
        time=truth.time,
        frame=np.arange(n),
        q=np.column_stack([position, unwrap_euler(euler_from_rotation(R))]),
        pose_covariance=np.broadcast_to(P if noise else pose_covariance(), (n, 6, 6)).copy(),
        calibration_sensitivity=np.zeros((n, 6, N_RIG)) if sensitivity is None else sensitivity,
        systematic_covariance=np.zeros((n, 6, 6)),
        quaternion=continuous_quaternions(quaternion_from_rotation(R)),
        frame_status=status,
        reprojection_rms_px=np.full((n, 2), 0.02),
        reduced_chi_square=np.ones(n),
        markers_px=np.full((n, 2, 6, 2), np.nan),
        markers_covariance_px2=np.full((n, 2, 6, 2, 2), np.nan),
        markers_residual_px=np.full((n, 2, 6, 2), np.nan),
        marker_status=np.zeros((n, 2, 6), np.uint8),
        disc=MA_2014,
        rig=rig,
        frame_rate=1000.0,
        gravity=g,
    )


@pytest.fixture(scope="session")
def true_motion() -> Callable[..., TrueMotion]:
    return integrate


@pytest.fixture(scope="session")
def as_tracked() -> Callable[..., Trajectory]:
    return tracked
