"""Mechanical energy of the disc, where it sits, and how fast it goes.

Equation (2.10) of Ma et al. 2014 with the datum at rest: m g (z - h) instead of m g z, or a power law in the time to
the end is not possible.
"""

from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.brief import Outline
from disctrack.analyse.derivatives import K, MeasuredMotion, MotionState
from disctrack.analyse.propagation import DerivedSeries, Propagated, propagate, rates
from disctrack.disc import Disc, precession_rate
from disctrack.errors import ModelError

ENERGY = (
    ("translation", "J", "kinetic energy of the centre"),
    ("rotation_1", "J", "kinetic energy of the rotation about e1"),
    ("rotation_2", "J", "kinetic energy of the rotation about e2"),
    ("rotation_3", "J", "kinetic energy of the rotation about e3"),
    ("potential", "J", "potential energy, zero at rest (z = h)"),
    ("total", "J", "mechanical energy, zero at rest"),
    ("power", "W", "rate of change of the mechanical energy"),
    ("adiabatic", "J", "3/2 m g r sin theta, the energy of slow steady precession of a thin disc"),
    ("precession_level", "s-2", "psidot^2 sin theta; 4 g / r in slow steady precession of a thin disc"),
)
_NAMES = [name for name, *_ in ENERGY]
TOTAL, LEVEL = _NAMES.index("total"), _NAMES.index("precession_level")


@dataclass(frozen=True, repr=False)
class Energy(Outline):
    """Energy of a recording."""

    series: tuple[DerivedSeries, ...]
    propagated: Propagated
    loss: float  # [J] from the first to the last known frame, positive when lost
    loss_sigma: float  # [J] noise
    loss_sigma_calibration: float  # [J]; most of the calibration's error is common to both ends and cancels
    level_ratio: float  # mean of psidot^2 sin theta over 4 g / r, over whole nutation periods if there are any
    level_ratio_sigma: float  # from the scatter about it
    level_ratio_steady: float  # what steady precession of this disc with its centre at rest has at the median theta


def energy_quantities(state: MotionState, disc: Disc, gravity: float) -> Array:
    """All of ENERGY, (n, 9)."""
    m, J1, J3 = disc.mass, disc.moment_diametral, disc.moment_axial
    e3 = state.axes()[2]
    psidot, _, _, *omega, _ = rates(state).T
    translation = 0.5 * m * np.sum(state.velocity**2, axis=1)
    rotation = [0.5 * J * w**2 for J, w in zip((J1, J1, J3), omega, strict=True)]
    potential = m * gravity * (state.position[:, 2] - disc.half_thickness)
    # omega . d(J omega)/dt = omega . J alpha, since omega . (omega x J omega) = 0
    inertia_alpha = J1 * state.alpha_world + (J3 - J1) * np.sum(state.alpha_world * e3, axis=1)[:, None] * e3
    power = m * np.sum(state.velocity * (state.acceleration + gravity * K), axis=1)
    power = power + np.sum(state.omega_world * inertia_alpha, axis=1)
    s = state.sine
    total = translation + rotation[0] + rotation[1] + rotation[2] + potential
    return np.column_stack(
        [translation, *rotation, potential, total, power, 1.5 * m * gravity * disc.radius * s, psidot**2 * s]
    )


def analyse_energy(motion: MeasuredMotion) -> Energy:
    """Energies with both uncertainties, loss over the recording, and the adiabatic level."""
    found = propagate(motion, lambda state: energy_quantities(state, motion.disc, motion.gravity))
    known = np.isfinite(found.value[:, LEVEL])
    try:
        typical = float(np.median(motion.euler[known, 1])) if known.any() else float("nan")
        steady = precession_rate(typical, motion.disc, motion.gravity)[0] ** 2 * np.sin(typical)
    except ModelError:  # a disc that stands nearly upright does not precess with its centre at rest
        steady = float("nan")
    over = 4 * motion.gravity / motion.disc.radius
    ratios = _level_ratio(motion, found.value[:, LEVEL] / over)
    return Energy(found.series(ENERGY), found, *_loss(found), *ratios, float(steady / over))


def _loss(found: Propagated) -> tuple[float, float, float]:
    """Energy lost between the first and the last known frame, with its two sigmas [J]."""
    known, column = np.flatnonzero(np.isfinite(found.value[:, TOTAL])), slice(TOTAL, TOTAL + 1)
    if known.size < 2:
        return (float("nan"),) * 3
    ends, motion = known[[0, -1]], found.motion
    J = found.jacobian[ends, TOTAL]
    before, after = np.einsum("ns,nsr->nr", J, motion.calibration_sensitivity[ends])
    common = (after - before) @ motion.rig_covariance @ (after - before)
    common += np.einsum("ns,nst,nt->", J, motion.systematic_at(ends), J)
    noise = found.covariance_at(ends, column).sum()
    first, last = found.value[ends, TOTAL]
    return float(first - last), float(np.sqrt(noise)), float(np.sqrt(max(0.0, common)))


def _level_ratio(motion: MeasuredMotion, ratio: Array) -> tuple[float, float]:
    """Mean of a ratio (n,), weighted evenly over the turns of precession, and its scatter per turn."""
    known = np.flatnonzero(np.isfinite(ratio))
    if known.size < 2:
        return float("nan"), float("nan")
    ratio = ratio[known]
    turns = np.floor((motion.euler[known, 0] - motion.euler[known[0], 0]) / (2 * np.pi)).astype(int)
    means = np.array([ratio[turns == turn].mean() for turn in np.unique(turns)])
    if len(means) < 2:
        return float(ratio.mean()), float(ratio.std())
    return float(means.mean()), float(means.std(ddof=1) / np.sqrt(len(means)))
