"""Why the motion is differentiated as it is: the candidates on the same true motion with the same noise.

Each differentiates the three coordinates of the centre of a disc that rolls from 8 degrees to rest (1400 frames at
1000 frames/s, 0.4 um). Error of the velocity and of the acceleration, and squared error over predicted variance:

    central differences, no smoothing (as in the paper)     0.318 mm/s (1.1)    1.08 m/s2   (1.1)
    local polynomials, best by cross-validation             0.074 mm/s (1.1)    0.028 m/s2  (1.2)
    Gaussian process in windows: the product                0.025 mm/s (1.0)    0.0076 m/s2 (1.0)

The first two have one window for slow and fast motion.
`pytest -m slow -s` on this file prints the figures again; the claim that is tested is their order.
"""

import numpy as np
import pytest
from scipy.signal import savgol_filter

from disctrack.analyse.derivatives import differentiate

INTERVAL = 1e-3


def central_differences(x, _sigma):
    v = np.gradient(x, INTERVAL, axis=0)
    a = np.zeros_like(x)
    a[1:-1] = (x[2:] - 2 * x[1:-1] + x[:-2]) / INTERVAL**2
    ones = np.ones_like(x)
    return v, a, ones * _sigma**2 / 2 / INTERVAL**2, ones * 6 * _sigma**2 / INTERVAL**4


def local_polynomials(x, sigma):
    """Savitzky-Golay with the window and degree of the smallest generalised cross-validation score."""
    best = None
    for degree in (3, 5, 7):
        for window in range(degree + 4, 80, 4):
            weight = savgol_filter(np.eye(window)[window // 2], window, degree)[window // 2]
            score = np.mean((x - savgol_filter(x, window, degree, axis=0)) ** 2) / (1 - weight) ** 2
            if best is None or score < best[0]:
                best = score, window, degree
    _, window, degree = best
    result = []
    for order in (1, 2):
        result.append(savgol_filter(x, window, degree, deriv=order, delta=INTERVAL, axis=0))
    impulse = np.zeros(4 * window)
    impulse[2 * window] = 1
    for order in (1, 2):
        response = savgol_filter(impulse, window, degree, deriv=order, delta=INTERVAL)
        result.append(np.full_like(x, sigma**2 * np.sum(response**2)))
    return tuple(result)


@pytest.mark.slow
def test_product_beats_the_other_candidates(true_motion, as_tracked, rng):
    truth = true_motion(theta_deg=9, duration=3.0)[-1400:]
    trajectory = as_tracked(truth, rng)
    motion = differentiate(trajectory)
    candidates = {f.__name__: f(trajectory.q[:, :3], 0.43e-6) for f in (central_differences, local_polynomials)}
    variance = np.diagonal(motion.covariance, axis1=1, axis2=2)
    candidates["product"] = (motion.velocity, motion.acceleration, variance[:, 6:9], variance[:, 12:15])
    inner = slice(20, -20)
    figures = {}
    for name, (v, a, v_variance, a_variance) in candidates.items():
        row = []
        for found, true, predicted in ((v, truth.velocity, v_variance), (a, truth.acceleration, a_variance)):
            error = (found - true)[inner]
            row += [np.sqrt(np.mean(error**2)), np.mean(error**2 / predicted[inner])]
        figures[name] = row
        print(f"{name:22s} v {1e3 * row[0]:.4f} mm/s ({row[1]:.2f})  a {row[2]:.4f} m/s2 ({row[3]:.2f})")
    best = figures.pop("product")
    for name, row in figures.items():
        assert best[0] < 0.8 * row[0], name
        assert best[2] < 0.5 * row[2], name
    assert 0.7 < best[1] < 1.35
    assert 0.7 < best[3] < 1.35
