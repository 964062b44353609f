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

    surface: str
    cases: tuple[str, ...]
    trials: tuple[int, ...]
    exponents: Array  # (n_trials, 3) in the order of EXPONENTS
    t_f: Array  # (n_trials,) [s]
    printed_average: Array  # (3,)

    @property
    def average(self) -> Array:
        """(3,) recomputed mean; differs from `printed_average` for n_energy on steel."""
        return self.exponents.mean(axis=0)


@dataclass(frozen=True)
class Agreement:
    """How the trials on a surface agree with one predicted exponent: Student's t of their mean."""

    exponent: str
    mean: float
    sigma: float  # of the mean
    predicted: float
    t: float
    p_value: float  # two-sided

    @property
    def sentence(self) -> str:
        """The comparison in words."""
        verdict = "disagrees with" if self.p_value < 0.05 else "agrees with"
        return (
            f"{self.exponent} = {self.mean:.4f} +- {self.sigma:.4f} {verdict} {self.predicted:.4f} "
            f"(t = {self.t:.1f}, p = {self.p_value:.2g})"
        )


def published_table(surface: str) -> PublishedTable:
    """Table 2 (steel) or 3 (glass)."""
    text = files(__package__).joinpath("ma2014_exponents.csv").read_text(encoding="utf-8")
    rows = [row for row in csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))]
    mine = [row for row in rows if row["surface"] == surface]
    trials = [row for row in mine if row["case"] != "average"]
    (average,) = (row for row in mine if row["case"] == "average")
    return PublishedTable(
        surface=surface,
        cases=tuple(row["case"] for row in trials),
        trials=tuple(int(row["trial"]) for row in trials),
        exponents=np.array([[float(row[name]) for name in EXPONENTS] for row in trials]),
        t_f=np.array([float(row["t_f"]) for row in trials]),
        printed_average=np.array([float(average[name]) for name in EXPONENTS]),
    )


def agreement(table: PublishedTable) -> tuple[Agreement, ...]:
    """The mean of each exponent against 2/3, 2/3, -1/3, with the scatter of the trials for error."""
    n = len(table.exponents)
    mean, sigma = table.average, table.exponents.std(axis=0, ddof=1) / np.sqrt(n)
    result = []
    for name, value, s, predicted in zip(EXPONENTS, mean, sigma, PREDICTED, strict=True):
        t = (value - predicted) / s
        p = 2 * float(stdtr(n - 1, -abs(t)))
        result.append(Agreement(name, float(value), float(s), predicted, float(t), p))
    return tuple(result)
