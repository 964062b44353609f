"""A diagnosis of any system, not of the disc alone, in the words and keys of diagnosis.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disctrack.diagnosis.fit import Fit
from disctrack.diagnosis.held_out import HeldOut
from disctrack.diagnosis.output import effect_json, tried_json
from disctrack.diagnosis.search import Diagnosis
from disctrack.diagnosis.system import System
from disctrack.diagnosis.whiteness import ljung_box

Array = NDArray[np.float64]


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
    """Autocorrelation (lags, w) of the whitened residual at lags of 1, 2, ... samples, over samples without a gap."""
    residual, _ = system.linearise(fit.values, [])
    present = system.weights > 0
    power = np.mean(residual[present] ** 2, axis=0)
    found = []
    for lag in range(1, lags + 1):
        gapless = np.lib.stride_tricks.sliding_window_view(present, lag + 1).all(axis=1)
        found.append(np.mean((residual[lag:] * residual[:-lag])[gapless], axis=0) / power)
    return np.array(found)


def stretches(present: NDArray[np.bool_]) -> list[slice]:
    """Runs of samples without a gap."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def ljung_box_of_stretches(system: System, fit: Fit, lags: int = 5) -> tuple[Array, int]:
    """Ljung and Box's statistic per channel, added over stretches without a gap; and its degrees of freedom."""
    residual, _ = system.linearise(fit.values, [])
    parts = [residual[s] for s in stretches(system.weights > 0) if s.stop - s.start > 4 * lags]
    return np.sum([ljung_box(part, lags) for part in parts], axis=0), lags * len(parts)
