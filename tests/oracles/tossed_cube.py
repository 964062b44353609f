"""A tossed cube by integrating Newton's and Euler's equations with quaternions: shares no line with the product."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

SIDE = 2 * 0.0524
RATE = 148.0


def _quaternion_rate(q, omega_body):
    w, v = q[..., :1], q[..., 1:]
    along = -np.sum(v * omega_body, axis=-1, keepdims=True)
    return 0.5 * np.concatenate([along, w * omega_body + np.cross(v, omega_body)], axis=-1)


def toss(rng, n, gravity=9.81, centre_of_mass=(0, 0, 0), inertia=(1, 1, 1), scale=0.0, lean=0.0, noise=2e-5):
    """State (n * 40, 13) and offset of n tosses: 24 samples of flight at most, then 16 at rest, in half widths.

    lean : [rad] of gravity, in the measured axes, to the left of every flight
    noise : [m] of a position; of an attitude, that over the half width
    """
    t = np.arange(24) / RATE
    J = np.asarray(inertia, float)
    offset_of_mass = np.asarray(centre_of_mass, float)
    heading = rng.uniform(0, 2 * np.pi, n)
    along = np.stack([np.cos(heading), np.sin(heading), np.zeros(n)], axis=-1)
    across = np.stack([-along[:, 1], along[:, 0], np.zeros(n)], axis=-1)
    down = gravity * (np.array([0.0, 0.0, -1.0]) + lean * across)
    x = -0.25 * along + np.array([0.0, 0.0, 0.17])
    v = rng.uniform(0.9, 1.3, (n, 1)) * along + np.array([0.0, 0.0, -0.1])
    q = rng.standard_normal((n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    omega = 3.0 * rng.standard_normal((n, 3))

    def rates(_, state):
        q, omega = np.split(state.reshape(n, 7), [4], axis=1)
        return np.concatenate([_quaternion_rate(q, omega), np.cross(J * omega, omega) / J], axis=1).ravel()

    start = np.concatenate([q, omega], axis=1).ravel()
    turned = solve_ivp(rates, (0, t[-1]), start, t_eval=t, rtol=1e-9, atol=1e-11).y.T.reshape(24, n, 7)[..., :4]
    turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
    fallen = x + v * t[:, None, None] + down * t[:, None, None] ** 2 / 2
    at = Rotation.from_quat(turned.reshape(-1, 4), scalar_first=True).apply(offset_of_mass)
    flown = fallen - at.reshape(24, n, 3)
    still_x = np.repeat((flown[-1] * [1, 1, 0] + [0, 0, SIDE / 2])[None], 16, axis=0)
    yaw = rng.uniform(0, 2 * np.pi, n)
    # the table is level, so that in axes which lean, resting cubes lean and stand on a slope
    still_x[..., 2] += lean * np.sum(still_x * across, axis=-1)
    level = Rotation.from_rotvec(lean * along) * Rotation.from_rotvec(np.outer(2 * yaw, [0, 0, 1]))
    position = np.concatenate([flown, still_x]).swapaxes(0, 1)
    attitude = np.concatenate([turned, np.tile(level.as_quat(scalar_first=True), (16, 1, 1))]).swapaxes(0, 1)
    # one resting pose per toss is off by more than the noise of a sample, as tags are
    off = np.concatenate([np.zeros((n, 24, 3)), np.repeat(2e-4 * rng.standard_normal((n, 1, 3)), 16, axis=1)], axis=1)
    position = (1 + scale) * position + off + noise * rng.standard_normal(position.shape)
    turn = noise / (SIDE / 2) * rng.standard_normal(position.shape)
    turn[:, 24:] += 2e-3 * rng.standard_normal((n, 1, 3))
    attitude = attitude + _quaternion_rate(attitude, turn)
    attitude /= np.linalg.norm(attitude, axis=-1, keepdims=True)
    state = np.concatenate([position / (SIDE / 2), attitude, np.zeros((n, 40, 6))], axis=-1)
    return state.reshape(-1, 13), 40 * np.arange(n + 1)
