"""What the comparison needs of one analysed trajectory file, and why a file cannot be compared."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array, Mask
from disctrack.disc import Disc
from disctrack.errors import AnalysisError, TrajectoryFileError
from disctrack.trajectory.file import read_group, read_provenance, read_setup

NUTATION_PER_PRECESSION = 0.785  # of the frequencies, thin disc 0.775 to 0.80 at 20 deg: enough to cut into periods
MIN_PERIODS = 4  # of nutation, to judge a slope by their scatter
MIN_FRAMES = 12


@dataclass(frozen=True)
class ComparedCoordinate:
    """One coordinate that repeats are compared in."""

    name: str
    group: str  # of the trajectory file
    dataset: str
    symbol: str
    unit: str  # on the page
    scale: float  # from SI to that unit
    own_origin: bool  # True where a start elsewhere on the table, or turned, is the same motion


QUANTITIES = (
    ComparedCoordinate("x", "motion", "position_x", "x", "mm", 1e3, True),
    ComparedCoordinate("y", "motion", "position_y", "y", "mm", 1e3, True),
    ComparedCoordinate("z", "motion", "position_z", "z", "mm", 1e3, False),
    ComparedCoordinate("psi", "motion", "psi", "ψ", "deg", 180 / np.pi, True),
    ComparedCoordinate("theta", "motion", "theta", "θ", "deg", 180 / np.pi, False),
    ComparedCoordinate("phi", "motion", "phi", "φ", "deg", 180 / np.pi, True),
    ComparedCoordinate("psidot", "motion", "psidot", "dψ/dt", "rad/s", 1.0, False),
    ComparedCoordinate("energy", "energy", "total", "E", "mJ", 1e3, False),
)
INDEX = {quantity.name: i for i, quantity in enumerate(QUANTITIES)}
FITTED = ("n_energy", "n_theta", "n_psidot", "t_f", "k_m")


@dataclass(frozen=True)
class FittedNumber:
    """A fitted number of one run; NaN where the run does not determine it."""

    value: float
    sigma: float  # noise and scatter within the run
    sigma_calibration: float = 0.0  # common to all runs filmed by one rig

    @property
    def known(self) -> bool:
        """True when it is a number."""
        return bool(np.isfinite(self.value) and np.isfinite(self.sigma) and self.sigma > 0)


UNKNOWN = FittedNumber(float("nan"), float("nan"))


@dataclass(frozen=True)
class AnalysedRun:
    """One analysed recording, as far as it rolls (the brake at the very end is left out)."""

    path: Path
    name: str
    case: str  # as recording.toml names the start; empty where it does not
    surface: str  # likewise the table's surface
    disc: Disc
    rig: StereoRig
    time: Array  # (n,) [s]
    value: Array  # (n, 8) in the order of QUANTITIES, SI; NaN where unknown
    sigma: Array  # (n, 8) noise alone
    fitted: dict[str, FittedNumber]  # FITTED -> value
    k_m_source: str  # "diagnosis" or "energy"
    fingerprint: str  # of what the trajectory was made from
    notes: tuple[str, ...]  # why a fitted number is missing

    def known(self) -> Mask:
        """(n,) True where every quantity is a number."""
        return np.asarray(np.isfinite(self.value).all(axis=1))


def read_run(path: Path, k_m_from_energy: bool = False) -> AnalysedRun:
    """One analysed trajectory file.

    k_m_from_energy : do not take k_m from the diagnosis even where there is one
    Raises TrajectoryFileError or AnalysisError that says what is missing and which command writes it.
    """
    path = Path(path)
    setup, provenance = read_setup(path), read_provenance(path)
    wanted = {
        group: [q.dataset + end for q in QUANTITIES if q.group == group for end in ("", "_sigma")]
        for group in ("motion", "energy")
    }
    motion, _ = read_group(path, "motion", names=[*wanted["motion"], "phidot"])
    energy, energy_attributes = read_group(path, "energy", names=wanted["energy"])
    contact, _ = read_group(path, "contact", names=["force_z"])
    _, scaling = read_group(path, "scaling", names=[])
    _require(path, {**motion, **energy, **contact}, [*wanted["motion"], *wanted["energy"], "phidot", "force_z"])
    groups = {"motion": motion, "energy": energy}
    value = np.stack([groups[q.group][q.dataset] for q in QUANTITIES], axis=1)
    sigma = np.stack([groups[q.group][f"{q.dataset}_sigma"] for q in QUANTITIES], axis=1)
    fitted, notes, end = _power_laws(scaling)
    rolling = np.isfinite(value).all(axis=1) & (setup.time <= end)
    if rolling.sum() < MIN_FRAMES:
        raise AnalysisError(
            f"{path}: only {int(rolling.sum())} frames have a rolling motion; at least {MIN_FRAMES} are needed."
        )
    span = slice(int(np.flatnonzero(rolling)[0]), int(np.flatnonzero(rolling)[-1]) + 1)
    calibration = abs(_number(energy_attributes, "loss_sigma_calibration_J") / _number(energy_attributes, "loss_J"))
    k_m = k_m_of_energy(setup.time[span], value[span], motion["phidot"][span], contact["force_z"][span], calibration)
    source = "energy"
    if not k_m_from_energy and (diagnosed := _diagnosed_k_m(path)) is not None:
        k_m, source = diagnosed, "diagnosis"
    declared = provenance.settings.get("recording", {})
    return AnalysedRun(
        path=path,
        name=provenance.recording,
        case=str(declared.get("case", "")),
        surface=str(declared.get("surface", "")),
        disc=setup.disc,
        rig=setup.rig,
        time=setup.time[span],
        value=value[span],
        sigma=sigma[span],
        fitted={**fitted, "k_m": k_m},
        k_m_source=source,
        fingerprint=setup.fingerprint,
        notes=notes,
    )


def _require(path: Path, arrays: dict[str, NDArray], names: list[str]) -> None:
    missing = [name for name in names if name not in arrays]
    if missing:
        raise AnalysisError(
            f"{path}: the analysis in it has no {', '.join(missing)}: it was made by another version. Run disctrack "
            "analyse again."
        )


def _number(attributes: dict[str, Any], name: str) -> float:
    return float(attributes.get(name, np.nan))


def _power_laws(scaling: dict[str, Any]) -> tuple[dict[str, FittedNumber], tuple[str, ...], float]:
    """Exponents and t_f, why they are missing, and the instant [s] up to which the law was seen to hold."""
    reason = str(scaling.get("reason_undetermined", "the file does not say why"))
    exponents = {
        name: FittedNumber(_number(scaling, name), _number(scaling, f"{name}_sigma"))
        for name in ("n_energy", "n_theta", "n_psidot")
    }
    t_f = FittedNumber(_number(scaling, "t_f_s"), _number(scaling, "t_f_sigma_s"))
    if reason or not t_f.known:
        return dict.fromkeys((*exponents, "t_f"), UNKNOWN), (f"exponents and t_f: {reason}",), np.inf
    return {**exponents, "t_f": t_f}, (), t_f.value - float(np.asarray(scaling["window_s"])[1]) + 1e-9


def _diagnosed_k_m(path: Path) -> FittedNumber | None:
    """k_m of the model that `disctrack diagnose` ended with, where that was run."""
    try:
        _, attributes = read_group(path, "diagnosis", names=[])
        parameters = json.loads(attributes["diagnosis"])["after"]["parameters"]
    except (TrajectoryFileError, KeyError, TypeError, ValueError):
        return None
    for name, item in parameters.items():
        if name.rpartition(".")[2] == "k_m" and item["value"] is not None and item["sigma"] is not None:
            return FittedNumber(float(item["value"]), float(item["sigma"]))
    return None


def k_m_of_energy(
    time: Array, value: Array, phidot: Array, force_z: Array, relative_calibration: float = 0.0
) -> FittedNumber:
    """Coefficient of M_m = -k_m F_z psidot |psidot| [m s^2], eq. (5.4), that accounts for the whole loss of energy.

    The moment's power is -M_m phidot sin theta (along m0 the disc turns at -phidot sin theta), so that E falls along
    k_m times the integral of F_z psidot |psidot| phidot sin theta; the slope of that line is fitted. Its sigma comes
    from leaving out one nutation period at a time: the noise of E and the ripple that the law does not explain.
    An effective coefficient: other losses, where there are any, are in it.
    """
    psidot, theta, energy = (value[:, INDEX[name]] for name in ("psidot", "theta", "energy"))
    good = np.isfinite(psidot) & np.isfinite(theta) & np.isfinite(energy) & np.isfinite(phidot) & np.isfinite(force_z)
    if good.sum() < MIN_FRAMES:
        return UNKNOWN
    power = force_z[good] * psidot[good] * np.abs(psidot[good]) * phidot[good] * np.sin(theta[good])
    step = np.diff(time[good])
    work = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * step)])
    turns = NUTATION_PER_PRECESSION * np.abs(value[good, INDEX["psi"]] - value[good, INDEX["psi"]][0]) / (2 * np.pi)
    period = np.floor(turns).astype(int)
    if len(np.unique(period)) < MIN_PERIODS:
        return UNKNOWN
    slope, sigma = slope_by_jackknife(work, energy[good], period)
    return FittedNumber(slope, sigma, abs(slope) * relative_calibration)


def slope_by_jackknife(x: Array, y: Array, cluster: NDArray[np.int64]) -> tuple[float, float]:
    """Slope of the line y(x) and its sigma from leaving out one cluster at a time."""
    x, y = x - x.mean(), y - y.mean()  # sums of squares without cancellation
    numbers, index = np.unique(cluster, return_inverse=True)
    sums = np.stack([np.bincount(index, w) for w in (np.ones_like(x), x, y, x * x, x * y)])

    def slope(s: Array) -> Array:
        return np.asarray((s[0] * s[4] - s[1] * s[2]) / (s[0] * s[3] - s[1] ** 2))

    whole, g = sums.sum(axis=1), len(numbers)
    without = slope(whole[:, None] - sums)
    return float(slope(whole)), float(np.sqrt((g - 1) / g * np.sum((without - without.mean()) ** 2)))
