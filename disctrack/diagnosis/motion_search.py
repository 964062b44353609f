"""The search for missing effects in a motion that rolls, or that slips first and rolls after friction has stopped it.

Rolling from the first frame on is tried first. If it fails, slip of mm/s is fitted, which is below the noise of the
velocities; then the measured velocity at the contact decides, which needs no model. Slip is described by Coulomb's
coefficient and the initial velocity of the centre. If no coefficient describes it, the diagnosis begins at the onset of
rolling.
"""

from dataclasses import replace

import numpy as np

from disctrack.analyse.contact import RollingOnset, rolling_onset
from disctrack.analyse.derivatives import differentiate
from disctrack.analyse.quantities import propagate
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import simulated
from disctrack.diagnosis.large_faults import large_faults
from disctrack.diagnosis.motion import slip_start
from disctrack.diagnosis.starts import first_contact, first_motion
from disctrack.diagnosis.stretch import free_stretch
from disctrack.diagnosis.systematic import find_systematic, with_noise_of_frames
from disctrack.discrepancy.fit import TRIAL, Fit, fit
from disctrack.discrepancy.held_out import HeldOut, held_out, training_rows
from disctrack.discrepancy.noise import noise_variance
from disctrack.discrepancy.search import FAR, Diagnosis, Former, Found, Settings, explain, threshold, with_found
from disctrack.discrepancy.system import Candidate, GivenUp, Values
from disctrack.errors import AnalysisError
from disctrack.faults.clock_jump import clock_jumps, in_words, without_jumps
from disctrack.rolling import Model, Regime
from disctrack.trajectory import Trajectory, part

LEAST_SLIP = 12e-3  # [m/s] friction of 0.1 stops it in 12 ms


Rolling = tuple[Fit, HeldOut]  # the model without slip, for a recording that begins with slip
# system, with slip in its base if the disc slips at first; the answer of the search; and then the model without slip
Answer = tuple[DiscSystem, Diagnosis, Rolling | None]


def diagnose_motion(trajectory: Trajectory, model: Model, faults: Values, settings: Settings | None) -> Answer:
    """Diagnose a motion that rolls or slips at its start, with times corrected for pairs that both cameras lost.

    Raises AnalysisError.
    """
    jumps = clock_jumps(trajectory)
    system, diagnosis, rolling = _at_true_times(without_jumps(trajectory, jumps), model, faults, settings or Settings())
    lost = tuple(f"frame {trajectory.frame[row]}: {in_words(n)}; counted with them" for row, n in jumps.items())
    return system, _noted(diagnosis, *lost, *system.notes), rolling


def with_slip(system: DiscSystem, diagnosis: Diagnosis, rolling: Rolling | None) -> Diagnosis:
    """The diagnosis with slip among the effects found, and rolling from the first frame on as the model before."""
    if rolling is None:
        return diagnosis
    (without, held_without), held, noise = rolling, diagnosis.held_out_before, diagnosis.noise
    gain = (without.cost - diagnosis.before.cost) / noise
    held_gain = held.gain_over(held_without, noise) if held else np.nan
    candidate = slip_start(system.model)
    enough = threshold(system, diagnosis.settings, len(candidate.names))
    found = Found(candidate, float(gain), held_gain, enough, ())
    reason = f"with slip at the start, {diagnosis.reason}"
    return replace(with_found(diagnosis, [found]), reason=reason, before=without, held_out_before=held_without)


def _at_true_times(as_tracked: Trajectory, model: Model, faults: Values, settings: Settings) -> Answer:
    rolling = DiscSystem(with_noise_of_frames(as_tracked), model, known=faults)
    systematic = find_systematic(rolling)
    # what the fields do not explain of the components that no pose absorbs is in the poses as well
    settings = replace(settings, at_noise=settings.at_noise * systematic.left)
    if (large := large_faults(as_tracked, rolling, systematic)) is not None:
        system, former = large
        without = system.start() | dict.fromkeys(system.known, 0.0) | dict(faults)
        return system, _from_guess(system, without, settings, former, "the dots alone"), None
    rolling = rolling.again(systematic=systematic)
    return _rolling_or_slipping(settings, rolling, fit(rolling, rolling.base, rolling.start()))


def _from_guess(system: DiscSystem, start: Values, settings: Settings, former: Former, source: str) -> Diagnosis:
    """The diagnosis by a search that begins with these explanations, and remarks on those of them that are found."""
    diagnosis = explain(system, start, settings, former=former)
    found = (f.candidate for f in diagnosis.found if any(f.candidate.name in names for names in former))
    return _noted(diagnosis, *(f"{c.title}: its initial guess is from {source}, as it is large" for c in found))


def _by_clock(rolling: DiscSystem) -> Former:
    """Initial guess by the frame rate at which the disc precesses as gravity determines for steady rolling."""
    q = rolling.trajectory.q[rolling.rows]
    good = np.isfinite(q).all(axis=1)
    psidot = np.gradient(q[good, 3], rolling.time[good])
    # a thin disc has psidot^2 sin(theta) = 4 g / r
    speed = np.median(psidot**2 * np.sin(q[good, 4])) * rolling.disc.radius / (4 * rolling.model.gravity)
    change = {"frame_rate.change": float(1.0 / np.sqrt(speed) - 1.0)}
    return {frozenset(["frame_rate"]): rolling.again(known={**rolling.known, **change}).start()}


def _rolling_or_slipping(settings: Settings, rolling: DiscSystem, base: Fit) -> Answer:
    """The diagnosis of a motion without large faults."""
    large = not base.reduced_chi_square <= FAR * noise_variance(rolling, base)
    if large and _slips_slowly(settings, rolling):
        return _slipping(settings, rolling, base, None)
    rolls = _at_noise(rolling, base, settings) or first_contact(first_motion(rolling))[0] <= LEAST_SLIP
    onset = None if rolls else _onset(rolling)
    # the data show both slip at the first frame and rolling at the end
    if onset is None or not (onset.low > rolling.time[0] and np.isfinite(onset.high)):
        former = {} if base.converged else _by_clock(rolling)
        return rolling, _from_guess(rolling, base.values, settings, former, "the precession, which gravity sets"), None
    # the velocity at the contact assumes the declared rim: if it is not round, a rolling disc seems to slip
    others = rolling.again(_without_slip(rolling))
    diagnosis = explain(others, base.values, settings)
    if diagnosis.verdict == "found":
        return others, diagnosis, None
    return _slipping(settings, rolling, base, onset)


def _slips_slowly(settings: Settings, rolling: DiscSystem) -> bool:
    """Does slip during the first frames reduce residuals far above the noise to noise?

    With friction slightly below what rolling needs, the contact slips at mm/s, which the first poses do not show but a
    fit does. That three quantities explain all residuals by chance is impossible.
    """
    slipping = rolling.again(slips=True)
    try:
        with slipping.budget.trial(slipping.trial_work):
            alone = fit(slipping, slipping.base, slipping.start(), TRIAL)
    except GivenUp:
        return False
    return _at_noise(slipping, alone, settings)


def _noted(diagnosis: Diagnosis, *notes: str) -> Diagnosis:
    return replace(diagnosis, remarks=(*notes, *diagnosis.remarks))


def _without_slip(system: DiscSystem) -> tuple[Candidate, ...]:
    return tuple(c for c in system.candidates if c.effect != "slip")


def _at_noise(system: DiscSystem, fit_: Fit, settings: Settings) -> bool:
    return fit_.converged and fit_.reduced_chi_square <= settings.at_noise * noise_variance(system, fit_)


def _onset(rolling: DiscSystem) -> RollingOnset | None:
    """Onset of rolling, from the velocity at the contact; None if the velocities cannot be computed."""
    try:
        return rolling_onset(propagate(differentiate(part(rolling.trajectory, rolling.rows))))
    except AnalysisError:
        return None


def _slipping(settings: Settings, rolling: DiscSystem, base: Fit, onset: RollingOnset | None) -> Answer:
    """The diagnosis with slip at first; or of the rolling after it, if no coefficient describes the slip."""
    system = rolling.again(slips=True)
    diagnosis = explain(system, system.start(), settings)
    if diagnosis.verdict == "unexplained" and onset is not None:
        later = _after_slip(settings, rolling, onset, diagnosis)
        if later is not None:
            return later
    without = None
    if diagnosis.held_out_after is not None and not system.model.effect("slip"):  # else friction was declared
        without = base, held_out(diagnosis.judged or system, base.quantities, base.values, training_rows(system))
    return system, _noted(diagnosis, *_in_words(system, diagnosis)), without


def _after_slip(settings: Settings, rolling: DiscSystem, onset: RollingOnset, slipping: Diagnosis) -> Answer | None:
    """Diagnosis from the onset of rolling on; None if too few frames remain, or if it is unexplained too."""
    try:
        rows, notes = free_stretch(rolling.trajectory, onset.high)
    except AnalysisError:
        return None
    system = rolling.again(_without_slip(rolling), rows=rows)  # the first part has shown that its law is not Coulomb's
    system.notes = notes
    diagnosis = explain(system, system.start(), settings)
    if diagnosis.verdict == "unexplained":
        return None
    left = f"chi-square {slipping.after.reduced_chi_square:.3g}" if slipping.after.converged else "no fit"
    note = (
        f"the disc slips until {onset.time:.4f} s (95 %: {onset.low:.4f} to {onset.high:.4f} s), and no coefficient of "
        f"friction describes that ({left}): the diagnosis is that of the motion after it"
    )
    return system, _noted(diagnosis, note), None


def _in_words(system: DiscSystem, diagnosis: Diagnosis) -> tuple[str, ...]:
    if not diagnosis.after.converged:
        return ()
    motion = simulated(system, diagnosis.after.values)
    slip = float(np.hypot(*motion.slip_velocity[0]))
    end = next((s.time for s in motion.switches if s.after is Regime.ROLLING), None)
    until = "to the end of the recording" if end is None else f"until {end:.4f} s, and rolls after it"
    return (f"the disc slips at first, with {1e3 * slip:.4g} mm/s at the contact, {until}",)
