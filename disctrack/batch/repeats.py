"""Recordings that repeat one experiment: mean and spread of what was fitted to each.

As tables 2 and 3 of Ma et al. (2014), with what the paper leaves open: how much of the spread is the measurement's.
"""

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter

import numpy as np
from scipy.special import gammaincc

from disctrack.batch.columns import FITTED, Fitted, Row
from disctrack.recording.declaration import Recording

# What is known of one number of one group, and what it means.
REPEATS: dict[str, str] = {
    "repeats": "what the recordings have in common: case, surface and disc as declared",
    "quantity": "a column of the recordings",
    "n": "recordings that determine it; those of the same images count once",
    "mean": "all alike",
    "standard_deviation": "over the recordings, n - 1 in the denominator",
    "weighted_mean": "weights 1 / sigma^2",
    "weighted_mean_sigma": "from the stated sigmas",
    "reduced_chi_square": "squared spread over stated variance, n - 1 degrees of freedom; far above 1, they disagree",
    "p_value": "probability of a larger one if all measured the same number, each within its sigma",
}


def group_of(recording: Recording) -> str:
    """Case and surface, as far as they are declared, and the disc: recordings alike in these repeat one experiment."""
    declared, disc = recording.declared, recording.disc
    sizes = f"disc of {1e3 * disc.radius:g} x {2e3 * disc.half_thickness:g} mm, {1e3 * disc.mass:g} g"
    labels = (declared.get("case"), declared.get("surface"), declared.get("disc", {}).get("name"), sizes)
    return ", ".join(str(label) for label in labels if label)


def repeats_of(rows: Sequence[Row]) -> list[Row]:
    """Rows of REPEATS, one for each number that two or more recordings of a group determine."""
    different = {row["input_sha256"]: row for row in reversed(rows) if row["repeats"]}  # the first of each
    group_in = itemgetter("repeats")
    grouped = groupby(sorted(different.values(), key=group_in), key=group_in)
    found = []
    for group, alike in grouped:
        members = list(alike)
        found += [_spread(group, fitted, members) for fitted in FITTED if fitted.repeated]
    return [row for row in found if row["n"] > 1]


def _spread(group: str, fitted: Fitted, rows: Sequence[Row]) -> Row:
    known = [row for row in rows if row[fitted.column] is not None and row[fitted.sigma]]
    value, sigma = (np.array([row[name] for row in known], float) for name in (fitted.column, fitted.sigma))
    n = len(known)
    spread: Row = dict.fromkeys(REPEATS) | {"repeats": group, "quantity": fitted.column, "n": n}
    if n < 2:
        return spread
    weight = sigma**-2
    mean = np.sum(weight * value) / weight.sum()
    chi_square = np.sum(weight * (value - mean) ** 2)
    return spread | {
        "mean": float(value.mean()),
        "standard_deviation": float(value.std(ddof=1)),
        "weighted_mean": float(mean),
        "weighted_mean_sigma": float(weight.sum() ** -0.5),
        "reduced_chi_square": float(chi_square / (n - 1)),
        "p_value": float(gammaincc((n - 1) / 2, chi_square / 2)),
    }
