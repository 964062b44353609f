"""Where numbers lie that have to be looked for: an angle on the rim, a frequency of the table.

At an effect's null they have no derivative, and the data are far from quadratic in them. So the effect's amounts are
fitted to first order at many angles round the rim, or at peaks in the spectrum of what is left of the positions, and
refits begin where they gain most.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import find_peaks

from calibration.kit.arrays import Array
from disctrack.discrepancy.score import cleared, span
from disctrack.discrepancy.system import Candidate, Values

if TYPE_CHECKING:
    from disctrack.diagnosis.disc_system import DiscSystem

ANGLES = 48  # round the rim: 7.5 deg apart, half the width of a flat
PEAKS = 6  # of the spectrum
PADDED = 8  # times the length of the recording, for peaks between its frequencies
REFITS = 2  # begin at so many of them
NEAR = 10.0  # [sigma of a number], rms between two motions: micrometres of the centimetres by which they move
SLOW = 3.0  # periods in the recording that a vibration has at least


def sought(system: DiscSystem, candidate: Candidate, values: Values, least: float = 0.0) -> list[tuple[float, ...]]:
    """Values of the candidate's shape to begin with, the best first; empty where none has to be looked for.

    least : gain to first order, below which none is worth a refit
    """
    if not candidate.sought:
        return []
    first, *rest = candidate.shape
    places = 2 * np.pi * np.arange(ANGLES) / ANGLES if first.unit == "rad" else _frequencies(system, values)
    residual, derivative = system.linearise(values, [q.name for q in system.base])
    priors = np.diag([1.0 / q.prior_sigma for q in system.base])
    basis = span(np.concatenate([derivative.reshape(-1, len(priors)), priors]))
    r, no_prior = residual.ravel(), np.zeros((len(priors), len(candidate.names)))
    by_amounts = system.columns_known.get((candidate.name, r.size))
    if by_amounts is None or len(by_amounts[1]) != len(places) or not _near(r, by_amounts[0]):
        null = {q.name: q.null for q in (*candidate.quantities, *rest)} | dict(values)
        by_amounts = r, [system.linearise({**null, first.name: float(x)}, candidate.names)[1] for x in places]
        if first.unit == "rad":  # the same places whatever is left
            system.columns_known[candidate.name, r.size] = by_amounts
    gains = []
    for derivatives in by_amounts[1]:
        columns = derivatives.reshape(len(r), -1)
        left = cleared(np.concatenate([columns, no_prior]), basis)[: len(r)]
        amounts, *_ = np.linalg.lstsq(left, r, rcond=1e-10)
        inside = all(q.lower <= q.null + a <= q.upper for q, a in zip(candidate.quantities, amounts, strict=True))
        gains.append(float(r @ r - np.sum((r - left @ amounts) ** 2)) if inside else 0.0)
    best = np.argsort(gains)[::-1][:REFITS]
    return [(float(places[i]), *(q.null for q in rest)) for i in best if gains[i] > least]


def _near(residual: Array, other: Array) -> bool:
    """Of motions so near to each other that a small effect does the same to both?"""
    return float(np.mean((residual - other) ** 2)) < NEAR**2


def _frequencies(system: DiscSystem, values: Values) -> Array:
    """Peaks [Hz] in the spectrum of measured less predicted positions, in units of their noise, and beside them."""
    difference, sigma = (x[:, :3] for x in system.pose_difference(values))
    left = np.nan_to_num(difference / sigma)
    n, rate = len(left), 1.0 / float(np.median(np.diff(system.time)))
    spectrum = np.abs(np.fft.rfft(left - left.mean(axis=0), PADDED * n, axis=0))
    power, frequency = np.sum(spectrum**2, axis=1), np.fft.rfftfreq(PADDED * n, 1 / rate)
    power[frequency < SLOW * rate / n] = 0.0
    peaks, _ = find_peaks(power)
    highest = frequency[peaks[np.argsort(power[peaks])[::-1][:PEAKS]]]
    # noise moves and splits peaks by as much
    return np.ravel(highest[:, None] + 0.5 * rate / n * np.array([0.0, -1.0, 1.0]))
