"""A diagnosis of any system, not of the disc alone, in the words and keys of diagnosis.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from calibration.arrays import Array, Mask
from disctrack.diagnosis.engine.fit import Fit
from disctrack.diagnosis.engine.held_out import HeldOut
from disctrack.diagnosis.engine.search import Diagnosis
from disctrack.diagnosis.engine.system import System
from disctrack.diagnosis.pages.output import effect_json, tried_json


def fit_errors(fit: Fit, held: HeldOut | None, noise: float = 1.0) -> dict[str, Any]:
    """Keys `before` and `after` as far as every system has them; the system adds errors in its own units.

    noise : variance of the noise over that stated; the chi-squares are in units of it
    """
    ratio = None if held is None or not np.isfinite(held.chi_square) else held.ratio_to_floor / np.sqrt(noise)
    free = {q.name: q for q in fit.quantities if not q.name.startswith("state.")}
    return {
        "reduced_chi_square": fit.reduced_chi_square / noise,
        "held_out": {"ratio_to_noise_floor": ratio},
        "parameters": {
            name: {"value": fit.values[name], "sigma": fit.sigma(name), "unit": q.unit} for name, q in free.items()
        },
    }


def document(
    diagnosis: Diagnosis, model: str, sentence: str, before: Mapping[str, Any], after: Mapping[str, Any]
) -> dict[str, Any]:
    """All of a diagnosis in JSON's types; the keys are those that `disctrack diagnose` writes."""
    return {
        "verdict": diagnosis.verdict,
        "sentence": sentence,
        "reason": diagnosis.reason,
        "model": model,
        "effects": [effect_json(f, diagnosis.after) for f in diagnosis.found],
        "before": dict(before),
        "after": dict(after),
        "noise_variance_over_stated": diagnosis.noise,
        "tried": [tried_json(t) for t in diagnosis.tried],
        "settings": vars(diagnosis.settings),
    }


def memory(system: System, fit: Fit, lags: int = 5) -> Array:
    """Autocorrelation (lags, w) of the whitened residual at lags of 1, 2, ... samples, over samples without a gap.

    Without a gap: where rows have as many data as the fullest ones.
    """
    residual, full = _full_rows(system, fit)
    power = np.mean(residual[full] ** 2, axis=0)
    found = []
    for lag in range(1, lags + 1):
        gapless = sliding_window_view(full, lag + 1).all(axis=1)
        found.append(np.mean((residual[lag:] * residual[:-lag])[gapless], axis=0) / np.where(power > 0, power, 1.0))
    return np.array(found)


def portmanteau(system: System, fit: Fit, lags: int = 5) -> Array:
    """Box and Pierce's statistic (w,) over all stretches without a gap: chi-square of `lags` degrees without memory."""
    _, full = _full_rows(system, fit)
    pairs = np.array([sliding_window_view(full, lag + 1).all(axis=1).sum() for lag in range(1, lags + 1)])
    return np.asarray(pairs @ memory(system, fit, lags) ** 2, float)


def _full_rows(system: System, fit: Fit) -> tuple[Array, Mask]:
    residual, _ = system.linearise(fit.values, [])
    return residual, np.asarray(system.weights == system.weights.max(), bool)
