"""Published measurements, as data: the exponents of Ma et al. (2014) with what can be said of them."""

from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array

EXPONENTS = ("n_energy", "n_theta", "n_psidot")
PREDICTED = (2 / 3, 2 / 3, -1 / 3)  # a rolling moment proportional to psidot^2, thin disc, slow precession


def published_table(surface: str) -> tuple[NDArray, NDArray]:
    """Trials of table 2 (steel) or 3 (glass), and the printed average, which is not theirs for n_energy on steel.

    Records with case, trial, t_f [s] and EXPONENTS; the average has no trial and no t_f
    """
    with files(__package__).joinpath("ma2014_exponents.csv").open(encoding="utf-8") as file:
        rows = np.genfromtxt(file, delimiter=",", names=True, dtype=None, encoding="utf-8", skip_header=2)
    mine = rows[rows["surface"] == surface]
    return mine[mine["case"] != "average"], mine[mine["case"] == "average"][0]


def exponents_of(trials: NDArray) -> Array:
    """(n, 3) in the order of EXPONENTS."""
    return np.stack([trials[name] for name in EXPONENTS], axis=-1)
