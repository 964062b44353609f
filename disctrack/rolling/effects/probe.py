"""A tool, not a law of nature: an unknown moment and force during a short time, for reading residuals."""

import numpy as np

from disctrack.rolling.effects.base import EffectParameter, effect
from disctrack.rolling.records import Record


@effect(
    "moment (M_n, M_m, M_z) and force (X_n, X_m, X_z) times exp(-(t - t_0)^2 / (2 width^2))",
    "tool: a residual motion, resolved into probes at successive t_0, is the moment that a model lacks",
    *(EffectParameter(f"M_{a}", "N m", 1e-5, f"moment along {a}") for a in ("n", "m", "z")),
    *(EffectParameter(f"X_{a}", "N", 1e-3, f"force on the centre along {a}") for a in ("n", "m", "z")),
    EffectParameter("t_0", "s", 0.1, "middle of the probe", is_shape=True),
    EffectParameter("width", "s", 0.01, "standard deviation of its course", lower=1e-3, is_shape=True),
    passive=False,
    candidate=False,
)
def wrench_probe(p: Record, s: Record, w: Record) -> None:
    """Contact moment and force with a Gaussian course in time; its sensitivities are the motion's impulse response."""
    u = (s.time - p.t_0) / p.width
    course = np.exp(-0.5 * u * u)
    w.M_n += p.M_n * course
    w.M_m += p.M_m * course
    w.M_z += p.M_z * course
    w.X_n += p.X_n * course
    w.X_m += p.X_m * course
    w.X_z += p.X_z * course
