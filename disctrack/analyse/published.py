"""Published measurements, as data: the exponents of Ma et al. (2014) with what can be said of them."""

import csv
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from scipy.special import stdtr

from calibration.kit.arrays import Array

EXPONENTS = ("n_energy", "n_theta", "n_psidot")
PREDICTED = (2 / 3, 2 / 3, -1 / 3)  # a rolling moment proportional to psidot^2, thin disc, slow precession
SURFACES = ("steel", "glass")


@dataclass(frozen=True)
class PublishedTable:
    """Exponents of all trials on one surface."""

    cases: tuple[str, ...]
    trials: tuple[int, ...]
    exponents: Array  # (n_trials, 3) in the order of EXPONENTS
    t_f: Array  # (n_trials,) [s]
    printed_average: Array  # (3,)

    @property
    def average(self) -> Array:
        """(3,) recomputed mean; differs from `printed_average` for n_energy on steel."""
        return self.exponents.mean(axis=0)


def published_table(surface: str) -> PublishedTable:
    """Table 2 (steel) or 3 (glass)."""
    text = files(__package__).joinpath("ma2014_exponents.csv").read_text(encoding="utf-8")
    rows = [row for row in csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))]
    mine = [row for row in rows if row["surface"] == surface]
    trials = [row for row in mine if row["case"] != "average"]
    (average,) = (row for row in mine if row["case"] == "average")
    return PublishedTable(
        cases=tuple(row["case"] for row in trials),
        trials=tuple(int(row["trial"]) for row in trials),
        exponents=np.array([[float(row[name]) for name in EXPONENTS] for row in trials]),
        t_f=np.array([float(row["t_f"]) for row in trials]),
        printed_average=np.array([float(average[name]) for name in EXPONENTS]),
    )


def agreement(table: PublishedTable) -> tuple[Array, Array]:
    """Student's t (3,) of the mean of each exponent against 2/3, 2/3, -1/3, and its two-sided p value (3,)."""
    n = len(table.exponents)
    t = (table.average - PREDICTED) / (table.exponents.std(axis=0, ddof=1) / np.sqrt(n))
    return t, 2 * stdtr(n - 1, -np.abs(t))
