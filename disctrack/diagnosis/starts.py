"""Initial guesses of fits: the state from the first poses, and shape parameters for which a grid has to be searched.

Chi-square has no derivative by an angle on the rim or a frequency of the table while the effect is absent, and many
local minima. So the amplitudes of the effect are fitted to first order at many angles round the rim, or at the peaks in
the spectrum of the position residuals, and refits begin where chi-square decreases most.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import find_peaks, periodogram

from calibration.kit.types import Array
from disctrack.analyse.derivatives import MeasuredMotion, differentiate
from disctrack.analyse.quantities import COLUMN, from_to, quantities
from disctrack.analyse.smoothing import SEGMENT
from disctrack.diagnosis.motion import SLIP, SLIP_VELOCITY, model_quantities, state_quantities
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.score import cleared, span
from disctrack.discrepancy.system import Candidate, Values
from disctrack.trajectory import part

if TYPE_CHECKING:
    from disctrack.diagnosis.disc_system import DiscSystem


STRETCHES = (0.03, 0.08, 0.2, 0.5)  # [s] from the fit of one, Gauss-Newton converges for the next
FRICTIONS = (0.03, 1.0)  # range of the initial guess of a coefficient of friction
ANGLES = 48  # round the rim: 7.5 deg apart, half the width of a flat
PEAKS = 6  # highest peaks of the spectrum that are tried
PADDED = 8  # zero padding of the spectrum, in lengths of the recording
REFITS = 2  # initial guesses that are returned
SLOW = 3.0  # periods of a vibration in the recording at least


def first_motion(system: "DiscSystem") -> MeasuredMotion:
    """The first poses and their derivatives, at the instants corrected for the known faults. Raises AnalysisError."""
    n = int(np.flatnonzero(system.trajectory.measured[system.rows])[:SEGMENT][-1]) + 1
    first = part(system.trajectory, slice(system.rows.start, system.rows.start + n))
    return differentiate(replace(first, time=system.instants(system.known)[:n]))


def first_state(motion: MeasuredMotion) -> dict[str, float]:
    """Initial state of a measured motion: state.x ... state.omega3, and for slip the centre's state.v_x, state.v_y."""
    rates = quantities(motion, motion.disc, motion.gravity)[0, from_to("omega_1", "omega_3")]
    names = (*(q.name for q in state_quantities()), *SLIP_VELOCITY)
    numbers = *motion.position[0, :2], *motion.euler[0], *rates, *motion.velocity[0, :2]
    return dict(zip(names, map(float, numbers), strict=True))


def first_contact(motion: MeasuredMotion) -> tuple[float, float]:
    """Slip [m/s] at the first instant, and horizontal over vertical contact force, which is mu where the disc slips."""
    at_first = quantities(motion, motion.disc, motion.gravity)[0]
    slip = np.hypot(*at_first[from_to("slip_n", "slip_m")])
    return float(slip), float(np.clip(np.nan_to_num(at_first[COLUMN["friction_needed"]], nan=np.inf), *FRICTIONS))


def start_values(system: "DiscSystem") -> dict[str, float]:
    """State and declared effects from which the fit of the whole recording converges; the known faults are held."""
    names, motion = {quantity.name for quantity in system.base}, first_motion(system)
    values = system.known | {k: v for k, v in first_state(motion).items() if k in names}
    laws = model_quantities(system.model)
    values |= {law.name: system.model.values[law.name] for law in laws}
    if SLIP in names:
        values[SLIP] = 1.0 / first_contact(motion)[1]
    state = tuple(quantity for quantity in system.base if quantity.is_initial or quantity.name == SLIP)
    for stretch, beginning in zip(STRETCHES, system.beginnings(), strict=False):
        # laws of friction are determined over several turns only: held in short stretches
        moved = state if stretch < 0.1 else (*state, *laws)
        values = fit(beginning, moved, values).values
    return values


def shape_guesses(system: "DiscSystem", candidate: Candidate, values: Values, least: float) -> list[tuple[float, ...]]:
    """Initial guesses of the candidate's shape, the best first; empty if it needs none.

    least : gain to first order, below which a guess is not returned
    """
    if not candidate.sought:
        return []
    first, *rest = candidate.shape
    places = 2 * np.pi * np.arange(ANGLES) / ANGLES if first.unit == "rad" else _frequencies(system, values)
    residual, derivative = system.linearise(values, [q.name for q in system.base])
    priors = np.diag([1.0 / q.prior_sigma for q in system.base])
    basis = span(np.concatenate([derivative.reshape(-1, len(priors)), priors]))
    r, no_prior = residual.ravel(), np.zeros((len(priors), len(candidate.names)))
    null, gains = {q.name: q.null for q in (*candidate.quantities, *rest)} | dict(values), list[float]()
    for x in places:
        _, derivatives = system.linearise({**null, first.name: float(x)}, candidate.names)
        left = cleared(np.concatenate([derivatives.reshape(len(r), -1), no_prior]), basis)[: len(r)]
        amounts, *_ = np.linalg.lstsq(left, r, rcond=1e-10)
        inside = all(q.lower <= q.null + a <= q.upper for q, a in zip(candidate.quantities, amounts, strict=True))
        gains.append(float(r @ r - np.sum((r - left @ amounts) ** 2)) if inside else 0.0)
    best = np.argsort(gains)[::-1][:REFITS]
    return [(float(places[i]), *(q.null for q in rest)) for i in best if gains[i] > least]


def _frequencies(system: "DiscSystem", values: Values) -> Array:
    """Peaks [Hz] in the spectrum of the whitened position residuals, and frequencies half a bin from them."""
    difference, sigma = (x[:, :3] for x in system.coordinate_errors(values))
    residual = np.nan_to_num(difference / sigma)
    n, rate = len(residual), system.rate
    frequency, powers = periodogram(residual, rate, nfft=PADDED * n, axis=0)
    power = powers.sum(axis=1)
    power[frequency < SLOW * rate / n] = 0.0
    peaks, _ = find_peaks(power)
    highest = frequency[peaks[np.argsort(power[peaks])[::-1][:PEAKS]]]
    # noise shifts and splits peaks by as much
    return np.ravel(highest[:, None] + 0.5 * rate / n * np.array([0.0, -1.0, 1.0]))
