"""From equations and runs to an answer: which terms are missing, their sizes and their significance."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import qr

from calibration.kit.threads import one_blas_thread
from calibration.kit.types import Array
from disctrack.discrepancy import noise
from disctrack.discrepancy.equations import shooting
from disctrack.discrepancy.equations import terms as library
from disctrack.discrepancy.equations.answer import Answer
from disctrack.discrepancy.equations.declared import Equations, Run, Samples, Term, checked
from disctrack.discrepancy.equations.extent import extent
from disctrack.discrepancy.equations.formulas import Formulas
from disctrack.discrepancy.equations.law import learn, with_law
from disctrack.discrepancy.equations.system import MOST_STATES, EquationSystem, fitted_rows
from disctrack.discrepancy.fit import Fit, fit, no_fit
from disctrack.discrepancy.score import Linearisation, score_all
from disctrack.discrepancy.search import WIDTH, Diagnosis, Former, Settings, explain
from disctrack.discrepancy.significance import wald
from disctrack.discrepancy.system import USED_UP, Candidate, Values
from disctrack.errors import AnalysisError

JUMP = 1e-3  # width of a jump over the rms of its argument: an error of 1e-6 of the work of a friction
SHARPER, SHARPEST = 0.1, 1e-6  # widths of a jump over the one before, and over the first
BLUNT = 0.1  # of chi-square, by which a sharper jump may change the motion: parameters change by 0.3 sigma at most
REDUNDANT = 1e-5  # share of a parameter's effect that others cannot absorb, below which it is unidentifiable
SLOW = 0.05  # of a period of the motion: residuals with a longer correlation time are not taken for noise
NO_SENSOR = 5.0  # times the noise declared or estimated: larger residuals are no error of a sensor
FORGOTTEN = float(np.arccos(np.exp(-1.0)) / (2 * np.pi))  # lag of autocorrelation 1/e of an oscillation, in periods
SCANNED = 8  # values along the motion that are tried for a limit
NEARLY = 0.2  # of the excess chi-square: an explanation that leaves less is given as the nearest description
STANDS = 8  # equal extreme samples, above which a sensor may be at its limit
USUAL_SHARE = 0.1  # of the rms of an equation: the typical size of a term


@one_blas_thread
def diagnose(
    equations: Equations, runs: Run | Sequence[Run], terms: Sequence[Term] | None = None, *,
    settings: Settings | None = None,
) -> Answer:  # fmt: skip
    """Fit the equations to the runs and search for what they lack.

    runs : they share all parameters, except those declared `per` run or group; each has its own initial state
    terms : candidates; by default the usual terms (`terms.usual`)
    settings : extent of the search, and its significance level
    Raises AnalysisError, which says what was found and what to do.
    """
    settings = settings or Settings(unexplained_share=NEARLY)
    runs = [runs] if isinstance(runs, Run) else list(runs)
    given = checked(equations, runs)
    if all(fitted_rows(s).all() for s in given):
        raise AnalysisError("no run keeps samples back to judge the fit: give one of them a smaller fit_until.")
    channels = equations.channels(runs[0])
    sensors = {name: _sensor_notes(given, c, name) for c, name in enumerate(channels)}
    notes = [note for told, _ in sensors.values() for note in told]
    if terms is None:
        limits = (library.sensor_limit(n, str(channels[n]), side) for n, (_, ends) in sensors.items() for side in ends)
        usual = library.usual(replace(equations, observed=channels), {name for run in runs for name in run.constants})
        by_name = {term.name: term for term in (*usual, *limits)}
        terms = tuple(by_name.values())
    compiled = Formulas(equations, tuple(terms), channels)
    whole = EquationSystem(compiled, noise.with_noise(given), np.ones(len(compiled.states)), {})
    system, diagnosis, more = _first_answer(whole, settings)
    notes += more
    if not np.isfinite(diagnosis.before.chi_square):
        raise AnalysisError(_failure(system, diagnosis.before.values))
    declared = all(np.isfinite(s.sigma).all() for s in given)
    diagnosis, autocorrelated, on_noise = _prewhiten(system, diagnosis, settings, declared)
    # over less than a period initial states explain nearly any motion
    short = len(system.stretches) > len(given) and shooting.longest_duration(system) < shooting.shortest_period(whole)
    if diagnosis.verdict == "nothing missing" and short:
        reason = "the model follows less than a period of the motion, and has no term with which it follows more"
        diagnosis = replace(diagnosis, verdict="unexplained", reason=reason)
        notes.append(reason)
    judged, runs_whole = diagnosis.judged or system, replace(system, stretches=whole.stretches)
    law = learn(system, diagnosis, judged)
    named = law is not None and law.is_named(diagnosis)
    notes += on_noise if autocorrelated or not (law and named and law.at_noise) else []
    if law is not None and named:
        system, judged, diagnosis = law.system, law.judged, with_law(diagnosis, law)
    else:
        notes += diagnosis.remarks
    holds = extent(runs_whole, diagnosis) if diagnosis.verdict == "unexplained" and len(given) == 1 else None
    notes += [] if system.budget.open() else [USED_UP]
    if system.held:
        held = ", ".join(system.held)
        notes.append(f"{held} cannot be distinguished from other numbers by these data: held as declared")
    return Answer(equations, diagnosis, system, judged, autocorrelated, tuple(notes), law, holds)


def _first_answer(system: EquationSystem, settings: Settings) -> tuple[EquationSystem, Diagnosis, list[str]]:
    """The search over whole runs, or over stretches as long as the model follows them; and remarks on that."""
    whole, declared = _with_guessed_sizes(system)
    start = shooting.fitted_start(whole, declared)
    if held := unidentifiable(start.system, start.values) if start.followed > 0.0 else ():
        whole = replace(whole, held=held)
        start = shooting.fitted_start(whole, declared)
    values, left = declared, np.inf
    promising: list[tuple[str, ...]] = [(c.name,) for c in whole.candidates]
    if start.followed:
        system, diagnosis = _searched(_with_sizes(start.system, start.values), start.values, settings)
        promising = _promising(whole, declared, diagnosis, start.whole)
        values = {}  # a fit of whole runs that stopped early begins anew
        if start.whole:
            left = shooting.misfits(whole, diagnosis.ranked[0].fit.values).max() if diagnosis.ranked else np.inf
        else:
            values, whole = diagnosis.after.values, replace(whole, guesses=system.guesses)
    # stretches may be too short to show what is missing, and a fit without it may stop early: fit some terms first
    if ways := _reached_by(whole, values, promising, left):
        names, values = next(iter(ways.items()))
        # without these terms their values may lead nowhere
        starts = ({q.name: v[q.name] for q in whole.base if q.name in v} for v in (values, start.values))
        begin = next((v for v in starts if np.isfinite(shooting.misfits(whole, v)).all()), declared)
        system, diagnosis = _searched(_with_sizes(whole, values), begin, settings, ways)
        note = f"the fit was reached with {' and '.join(sorted(names))}: without it the model loses longer stretches"
        if {f.candidate.name for f in diagnosis.found} & frozenset().union(*ways):
            note = "with what was found the model follows the whole runs, and these were fitted"
        return system, diagnosis, [] if start.whole else [note]
    if not start.followed:
        raise AnalysisError(_failure(whole, declared))
    note = (
        f"the model follows the data for {start.followed:.2g} s only: runs are in {len(system.stretches)} stretches "
        f"of {shooting.longest_duration(system):.3g} s with an initial state each"
    )
    further = ["with it the model does not follow the whole runs"] if diagnosis.found else []
    return system, diagnosis, [] if start.whole else [note, *further]


def _promising(system: EquationSystem, values: Values, diagnosis: Diagnosis, whole: bool) -> list[tuple[str, ...]]:
    """Terms with which a fit of whole runs may be reached; none where the answer is one of whole runs already.

    For an arm that friction stops, no fit gets from a motion that never ends to the instant of the stop. Where a model
    is far from whole runs, first-order gains over these mean nothing: over the shortest stretches they are exact.
    """
    if diagnosis.found or (whole and diagnosis.verdict != "unexplained"):
        return [] if whole else [tuple(f.candidate.name for f in diagnosis.found)]
    tried = [t for t in diagnosis.tried if not whole or (t.stuck and t.gain is not None and t.gain > 0)]
    named = [t.candidate.name for t in sorted(tried, key=lambda t: -t.score)[:WIDTH]]
    if whole and system.budget.open():
        first = shooting.fit_over_levels(shooting.levels(system)[:1], values)
        short = _with_guesses(_with_sizes(first.system, first.values), first.values)
        scores = score_all(Linearisation(short, no_fit(short.base, first.values), short.candidates), short.candidates)
        named += [s.candidate.name for s in scores[:WIDTH]]
    return [(name,) for name in dict.fromkeys(named)]


def _searched(
    system: EquationSystem, values: Mapping[str, float], settings: Settings, former: Former | None = None
) -> tuple[EquationSystem, Diagnosis]:
    """The search of the engine, with initial guesses of shapes, and jumps that are sharp enough for the motion.

    former : see `explain`; then the values are those of one of these
    """
    system = _with_guesses(system, values)
    scans = SCANNED * len(system.formulas.along)
    if scans:  # each value tried is a further trial
        share = len(system.candidates) / (len(system.candidates) + scans)
        settings = replace(settings, false_alarm=settings.false_alarm * share)
    values = {q.name: values[q.name] for q in system.base if q.name in values}
    diagnosis = explain(system, values, settings, system.training, former)
    if diagnosis.held_out_before is None and np.isfinite(diagnosis.before.chi_square):
        # not converged: hold unidentifiable parameters, and start from a trust-region fit
        system = replace(system, held=(*system.held, *unidentifiable(system, diagnosis.before.values)))
        values = shooting.trust_region(system, system.base, diagnosis.before.values)
        diagnosis = explain(system, values, settings, system.training)

    sharper = _with_sharp_jumps(system, diagnosis.after)
    if sharper is system:
        return system, diagnosis
    return sharper, explain(sharper, diagnosis.before.values, settings, sharper.training, _starts(diagnosis))


def _starts(diagnosis: Diagnosis) -> Former:
    """Explanations of an answer, as initial values for nearly the same system."""
    found = {frozenset(f.candidate.name for f in diagnosis.found): diagnosis.after.values}
    if (nearest := diagnosis.nearest) is not None:
        found[frozenset(nearest.effects)] = nearest.fit.values
    return {names: values for names, values in found.items() if names}


def _with_guesses(system: EquationSystem, values: Mapping[str, float]) -> EquationSystem:
    """With an initial guess of every shape that is tried along the motion: where its term gains most to first order."""
    f = system.formulas
    passed = [
        f.along_motion(f.along.values(), s.time, motion.states, system.numbers(values, s), system.inputs_of(s))
        for s, motion in (system.predictions(values) if f.along else [])
        if motion is not None
    ]
    if not passed:  # no shapes, or no motion that ends with the data
        return system
    shares = (np.arange(SCANNED) + 0.5) / SCANNED
    best: dict[str, tuple[float, dict[str, float]]] = {}
    amounts = [c for c in system.candidates if any(f.owner[n] == c.name for n in f.along)]
    here = no_fit(system.base, values)
    for along in np.nanquantile(np.concatenate(passed, axis=1), shares, axis=1):
        bounds = [(f.declared[name].lower, f.declared[name].upper) for name in f.along]
        tried = dict(zip(f.along, np.clip(along, *np.transpose(bounds)).tolist(), strict=True))
        linear = Linearisation(replace(system, guesses=tried), here, amounts)
        for c in amounts if linear.usable else ():
            gain, _ = linear.gain_of(c.names)
            if gain > best.get(c.name, (0.0, {}))[0]:
                best[c.name] = gain, {n: v for n, v in tried.items() if f.owner[n] == c.name}
    return replace(system, guesses={n: v for _, guesses in best.values() for n, v in guesses.items()})


def _reached_by(
    system: EquationSystem, values: Values, terms: Collection[tuple[str, ...]], most: float
) -> dict[frozenset[str], dict[str, float]]:
    """Terms with which multiple shooting reaches whole runs, with the values; the best first.

    most : misfit of a known explanation, to which each of them has to be closer
    """
    ways = {frozenset(names): shooting.fitted_start(replace(system, promoted=names), values) for names in terms}
    misfits = {names: shooting.misfits(system, way.values).max() for names, way in ways.items() if way.whole}
    return {names: ways[names].values for names in sorted(misfits, key=misfits.__getitem__) if misfits[names] < most}


def _with_guessed_sizes(system: EquationSystem) -> tuple[EquationSystem, dict[str, float]]:
    """With sizes of states and widths of jumps estimated from the data; and the initial states."""
    values, sizes = shooting.initial_guess(system)
    system = replace(system, sizes=sizes)
    # oscillating states of these sizes, as the motion is not known yet
    phase = 2 * np.pi * np.arange(64) / 64
    states = np.sqrt(2) * sizes * np.cos(phase[:, None] + np.arange(len(sizes)))
    return replace(system, widths=_widths(system, [(system.stretches[0], states)])), values


def _widths(system: EquationSystem, along: Sequence[tuple[Samples, Array]]) -> dict[str, float]:
    """Of every jump, from the rms of its argument along these motions."""
    f = system.formulas
    square, count = np.zeros(len(f.widths)), 0
    for s, states in along:
        t, p = np.linspace(s.time[0], s.time[-1], len(states)), system.numbers({}, s)
        arguments = f.along_motion(f.widths, t, states, p, system.inputs_of(s, t))
        square += [float(np.nansum(a**2)) for a in arguments]
        count += len(states)
    size = np.sqrt(square / max(count, 1))
    return {w.name: JUMP * (x or 1.0) for w, x in zip(f.widths.values(), size, strict=True)}


def _with_sharp_jumps(system: EquationSystem, fitted: Fit) -> EquationSystem:
    """With jumps so sharp that even sharper ones would not change the motion significantly; mostly unchanged.

    The first width is too large where the contact of a ball is very short, or where a motion starts from rest.
    """
    first, share = system.widths, 1.0
    if not first or not np.isfinite(fitted.chi_square):
        return system
    residual = system.linearise(fitted.values, [])[0]
    while share > SHARPEST:
        share *= SHARPER
        sharper = replace(system, widths={name: share * w for name, w in first.items()})
        moved = residual - (residual := sharper.linearise(fitted.values, [])[0])
        if np.sum(moved**2) < BLUNT * max(1.0, fitted.reduced_chi_square):
            break
        system = sharper
    return system


def _with_sizes(system: EquationSystem, values: Mapping[str, float]) -> EquationSystem:
    """With sizes and widths from the fitted motion, and typical sizes of the terms' parameters."""
    found = [(s, m) for s, m in system.predictions(values) if m is not None]
    if not found:
        return system
    sizes = np.maximum(np.max([np.abs(m.states).max(axis=0) for _, m in found], axis=0), 1e-9 * system.sizes)
    system = replace(system, sizes=sizes, widths=_widths(system, [(s, m.states) for s, m in found]))
    scales, owner = shooting.scales(system, values), system.formulas.owner
    return replace(system, typical={name: USUAL_SHARE * size for name, size in scales.items() if owner[name]})


def unidentifiable(system: EquationSystem, values: Mapping[str, float]) -> tuple[str, ...]:
    """Parameters that these data do not distinguish from others; they are to be held as declared."""
    # a few of many runs are enough
    every = -(-len(system.stretches) * len(system.formulas.states) // MOST_STATES)
    system = replace(system, stretches=system.stretches[::every])
    states = [q for q in system.base if q.is_initial]
    free = [q for q in system.base if not q.is_initial and np.isinf(q.prior_sigma)]
    if len(free) < 2:
        return ()
    everything = Candidate("all", "all", "motion", "", "", tuple(free))
    linear = Linearisation(system, no_fit(states, values), [everything])
    columns = linear.columns(everything.names) * [max(abs(values.get(q.name, q.null)), q.scale) for q in free]
    length = np.linalg.norm(columns, axis=0)
    shares = linear.cleared(columns) / np.where(length > 0, length, 1.0)
    if not linear.usable:
        return ()
    stems = np.array([q.stem for q in free])
    weak: list[str] = []
    while (left := np.flatnonzero(~np.isin(stems, weak))).size:
        _, R, order = qr(shares[:, left], mode="economic", pivoting=True)
        open_ = [str(stems[left[j]]) for i, j in enumerate(order) if abs(R[i, i]) <= REDUNDANT]
        if not open_:
            break
        weak.append(max(reversed(open_), key=open_.count))  # in different runs it may be either of two
    return tuple(sorted(weak))


def _prewhiten(
    system: EquationSystem, diagnosis: Diagnosis, settings: Settings, declared: bool
) -> tuple[Diagnosis, bool, list[str]]:
    """Search again with autocorrelated noise, where the residuals are autocorrelated and small enough for noise.

    declared : the noise of every sensor is: what is found leaves no more
    returns : diagnosis, whether its noise is autocorrelated, and a remark on that
    """
    if settings.noise is not None or diagnosis.held_out_before is None:
        return diagnosis, False, []
    residual, _ = system.linearise(diagnosis.after.values, [])
    coefficients, share = noise.autoregression(residual, system.present, system.blocks)
    if not coefficients.any():
        return diagnosis, False, []
    size = _rms(system, residual)
    longest = shooting.longest_stretches(system)
    lasting = noise.correlation_lag(residual, system.blocks) * float(np.median(np.diff(longest[0].time)))
    shortest_period = min(min(shooting.period(s), _decorrelation_period(s)) for s in longest)
    # slow residuals are errors of the model, although an autoregression can predict them
    as_noise = diagnosis.verdict != "unexplained" or lasting <= SLOW * shortest_period
    as_noise &= size <= NO_SENSOR
    white = noise.prewhitened(system, system.blocks, coefficients, system.present)
    base = fit(white, system.base, diagnosis.before.values) if as_noise else None
    again = None
    if base is not None and base.converged:
        level = replace(settings, noise=float(share * size**2))
        again = explain(white, base.values, level, system.training, _starts(diagnosis))
        if declared and (diagnosis.verdict, again.verdict) == ("unexplained", "found"):
            left, _ = system.linearise(again.after.values, [])
            as_noise = _rms(system, left) ** 2 <= settings.at_noise
    if again is None or not as_noise:
        if diagnosis.verdict != "unexplained":
            return diagnosis, False, []
        reason = f"residuals are {size:.3g} times the noise and correlated over {lasting:.2g} s: no sensor's noise"
        diagnosis = replace(_with_residual_sigmas(system, diagnosis), reason=reason)
        return diagnosis, False, ["sigmas are scaled to the residuals, which are larger than the noise"]
    order = int(np.max(np.nonzero(coefficients)[1])) + 1
    text = f"residuals are autocorrelated over {order} sample{'s' if order > 1 else ''}; sigmas allow for that"
    return replace(again, judged=again.judged or white), True, [text]


def _rms(system: EquationSystem, residual: Array) -> float:
    """Of the residuals, over the noise stated."""
    return float(np.sqrt(np.sum(residual**2) / max(system.present.sum(), 1)))


def _decorrelation_period(s: Samples) -> float:
    """Period [s] of the oscillation whose autocorrelation falls as fast as that of the data.

    In data driven by an arbitrary input the strongest line is the slowest, and not the rate at which they change.
    """
    rows = np.isfinite(s.data)
    mean = np.nansum(s.data, axis=0) / np.maximum(rows.sum(axis=0), 1)  # a channel may show nothing in a stretch
    away = np.where(rows, (s.data - mean) / s.sigma, 0.0)
    return noise.correlation_lag(away, [slice(0, len(away))]) * float(np.median(np.diff(s.time))) / FORGOTTEN


def _with_residual_sigmas(system: EquationSystem, diagnosis: Diagnosis) -> Diagnosis:
    """Sigmas scaled by the residuals, and gains by Wald's test with these."""
    after, nearest = noise.with_autocorrelation(system, diagnosis.after), diagnosis.nearest
    gains = [wald(*after.amounts(f.candidate.names)) for f in diagnosis.found]
    return replace(
        diagnosis,
        found=tuple(replace(f, gain=gain) for f, gain in zip(diagnosis.found, gains, strict=True)),
        before=noise.with_autocorrelation(system, diagnosis.before),
        after=after,
        nearest=None if nearest is None else replace(nearest, fit=noise.with_autocorrelation(system, nearest.fit)),
    )


def _failure(system: EquationSystem, values: Mapping[str, float]) -> str:
    what = "is nothing like the data"
    if not np.isfinite(shooting.misfits(system, dict(values))).all():
        what = "has no value at some instant (the root of a negative number, a division by zero, unlimited growth)"
    elif not np.isfinite(system.linearise(values, [q.name for q in system.base])[1]).all():
        return (
            "the motion can be integrated, but not its derivatives by the parameters, as where equations jump at a "
            "contact. Write the contact wider, or cut the data into runs without it."
        )
    guess = ", ".join(f"{k.partition('.')[2]} = {v:.4g}" for k, v in list(values.items())[:4] if k.startswith("state."))
    return (
        f"the model does not follow the data even over a short time (residual over {shooting.LOST:.0%} of the signal): "
        f"as declared it {what}. Guessed start: {guess}. Check signs and units of the equations, declare parameters "
        "nearer to the truth, or give Run(start={...})."
    )


def _sensor_notes(samples: Sequence[Samples], channel: int, name: str) -> tuple[list[str], list[int]]:
    """Notes on the resolution of a sensor, and on limits of its range; sides (1: above, -1) on which it is at one."""
    notes, sides = [], []
    values = [s.data[:, channel] for s in samples if np.isnan(s.sigma[:, channel]).any()]
    step = noise.quantisation(values) if values else 0.0
    if step and noise.noise_sigma(values) < 3 * step:
        notes.append(f"{name} has a resolution of {step:.4g}, a rounding noise of {step / np.sqrt(12):.3g}")
    everything = np.concatenate([s.data[:, channel] for s in samples])
    least, most = np.nanmin(everything, initial=np.inf), np.nanmax(everything, initial=-np.inf)
    if least == most:
        raise AnalysisError(f"{name} shows {most:g} at all times: its sensor is dead. Leave it out.")
    for side, limit, which in ((1, most, "largest"), (-1, least, "smallest")):
        count = int(np.sum(everything == limit))
        if not step and count > STANDS:  # noise repeats no value; an encoder at rest does
            sides.append(side)
            notes.append(
                f"{name} shows its {which} value, {limit:.4g}, {count} times: its sensor is at its limit there "
                "(terms.sensor_limit), or dead (write NaN)"
            )
    return notes, sides
