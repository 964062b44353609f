"""From equations and runs to an answer: what is missing, how much of it, and how sure that is."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import qr

from calibration.kit.arrays import Array
from disctrack.discrepancy.equations import terms as library
from disctrack.discrepancy.equations.declared import Equations, Run, Samples, Term, checked
from disctrack.discrepancy.equations.formulas import Formulas
from disctrack.discrepancy.equations.law import LearnedForce, learn, with_law
from disctrack.discrepancy.equations.start import LOST, ample, guessed, lasting, led, misfit, sizes_alike, trusted, turn
from disctrack.discrepancy.equations.system import MOST_STATES, EquationSystem, fitted_rows
from disctrack.discrepancy.fit import Fit, fit, no_fit
from disctrack.discrepancy.noise import (
    autoregression,
    fast_part,
    persistence,
    step_of,
    with_memory,
    with_noise,
    without_memory,
)
from disctrack.discrepancy.score import Linearisation
from disctrack.discrepancy.search import WIDTH, Diagnosis, Former, Settings, explain, with_shapes
from disctrack.discrepancy.significance import wald
from disctrack.discrepancy.system import USED_UP, Candidate, System, Values
from disctrack.errors import AnalysisError

JUMP = 1e-3  # width of a jump over the rms of what jumps: it errs by 1e-6 of a friction's work
SHARPER, SHARPEST = 0.1, 1e-6  # widths of a jump over the one before, and over the first
BLUNT = 0.1  # of chi-square, by which a sharper jump may move the motion: numbers then move by 0.3 sigma at most
REDUNDANT = 1e-5  # share of a parameter's effect left beside the others', below which the data cannot part them
SLOW = 0.05  # of a turn of the motion: what is left and lasts longer is taken for the motion's own
NO_SENSOR = 5.0  # times the noise that was declared or is seen from sample to sample: no sensor's error
FORGOTTEN = float(np.arccos(np.exp(-1.0)) / (2 * np.pi))  # of its turn, after which an oscillation's memory is 1/e
SCANNED = 8  # values along the motion that are tried for a limit
NEARLY = 0.2  # of the excess chi-square: what leaves less is named as the nearest description of what no term is
STANDS = 8  # samples of the same largest or least value, above which a sensor stands at a limit
USUAL_SHARE = 0.1  # of the rms of the motion's own forces: a term of that size would surprise nobody


def ask(
    equations: Equations, runs: Sequence[Run], terms: Sequence[Term] | None = None, settings: Settings | None = None
) -> tuple[Diagnosis, EquationSystem, System, bool, tuple[str, ...], LearnedForce | None]:
    """Fit the equations to the runs and look for what they lack.

    terms : None: the usual ones (`terms.usual`)
    returns : diagnosis, system in the stretches that were judged, the same with its noise as judged, whether that
        remembers, remarks, and a learned law where one describes the data
    """
    settings = settings or Settings(unexplained_share=NEARLY)
    given = checked(equations, runs)
    if all(fitted_rows(s).all() for s in given):
        raise AnalysisError("no run keeps samples back to judge the fit: give one of them a smaller fit_until.")
    channels = equations.channels(runs[0])
    offered = tuple(library.usual(replace(equations, observed=channels)) if terms is None else terms)
    compiled = Formulas(equations, offered, channels)
    notes = [n for c, name in enumerate(compiled.channels) for n in _sensor_notes(given, c, name)]
    whole = EquationSystem(compiled, with_noise(given), np.ones(len(compiled.states)), {})
    system, diagnosis, more = _first_answer(whole, settings)
    notes += more
    if not np.isfinite(diagnosis.before.chi_square):
        raise AnalysisError(_not_followed(system, diagnosis.before.values))
    diagnosis, remembers, of_memory = _with_memory(system, diagnosis, settings)
    judged = diagnosis.judged or system
    law = learn(system, diagnosis, channels, None if judged is system else judged)
    named = law is not None and law.is_named(diagnosis)
    notes += of_memory if remembers or not (law and named and law.at_noise) else []
    if law is not None and named:
        judged = law.system if judged is system else judged.over(law.system)
        system, diagnosis = law.system, with_law(diagnosis, law)
    elif diagnosis.found and (diagnosis.verdict == "found" or any(f.candidate.shape for f in diagnosis.found)):
        diagnosis = with_shapes(judged, diagnosis)
        notes += diagnosis.remarks
    notes += [] if system.budget.open() else [USED_UP]
    if system.held:
        held = ", ".join(system.held)
        notes.append(f"{held} cannot be distinguished from other numbers by these data: held as declared")
    return diagnosis, system, judged, remembers, tuple(notes), law


def _first_answer(system: EquationSystem, settings: Settings) -> tuple[EquationSystem, Diagnosis, list[str]]:
    """The search over as much as the model can be made to follow, and remarks on how far that is."""
    whole, declared = _prepared(system)
    start = led(whole, declared)
    if held := redundant(start.system, start.values) if start.followed > 0.0 else ():
        whole = replace(whole, held=held)
        start = led(whole, declared)
    answer, values = None, declared
    promising: list[tuple[str, ...]] = [(c.name,) for c in whole.candidates]
    if start.followed:
        answer = system, diagnosis = _searched(_sized(start.system, start.values), start.values, settings)
        promising = _promising(diagnosis, start.whole)
        values = {} if start.whole else diagnosis.after.values
    # stretches may be too short to tell what is missing, and no step may lead to it: then by way of some terms
    if ways := _leading(whole, values, promising):
        names, values = next(iter(ways.items()))
        system, diagnosis = _searched(_sized(whole, values), values, settings, ways)
        note = f"the fit goes by way of {' and '.join(sorted(names))}: without it, longer stretches lose the data"
        if {f.candidate.name for f in diagnosis.found} & frozenset().union(*ways):
            note = "with what was found the model follows the whole runs, and they are judged whole"
        return system, diagnosis, [] if start.whole else [note]
    if answer is None:
        raise AnalysisError(_not_followed(whole, declared))
    note = (
        f"the model loses the data after {start.followed:.2g} s: runs are taken in {len(system.stretches)} stretches "
        f"of {lasting(system):.3g} s with an initial state each"
    )
    further = ["with it the model does not follow the whole runs"] if diagnosis.found else []
    return system, diagnosis, [] if start.whole else [note, *further]


def _promising(diagnosis: Diagnosis, whole: bool) -> list[tuple[str, ...]]:
    """Terms by way of which a fit of whole runs may be reached; none where an answer of whole runs needs no better one.

    Of an arm that friction stops, no step leads from a motion without end to the instant at which it stops.
    """
    if diagnosis.found or (whole and diagnosis.verdict != "unexplained"):
        return [] if whole else [tuple(f.candidate.name for f in diagnosis.found)]
    tried = [t for t in diagnosis.tried if not whole or (t.stuck and t.gain is not None and t.gain > 0)]
    return [(t.candidate.name,) for t in sorted(tried, key=lambda t: -t.score)[:WIDTH]]


def _searched(
    system: EquationSystem, values: Mapping[str, float], settings: Settings, former: Former | None = None
) -> tuple[EquationSystem, Diagnosis]:
    """The engine's search, with jumps as sharp as the motion asks, and limits where they tell most.

    former : as of `explain`; then the values are those of one of these
    """
    system = _aimed(system, values)
    scans = SCANNED * len(system.formulas.along)
    if scans:  # each value that was looked at is a chance more
        share = len(system.candidates) / (len(system.candidates) + scans)
        settings = replace(settings, false_alarm=settings.false_alarm * share)
    values = {q.name: values[q.name] for q in system.base if q.name in values}
    diagnosis = explain(system, values, settings, system.training, former)
    if diagnosis.held_out_before is None and np.isfinite(diagnosis.before.chi_square):
        # no step leads down: by way of others, and without what the data do not tell apart
        system = replace(system, held=(*system.held, *redundant(system, diagnosis.before.values)))
        values = trusted(system, system.base, diagnosis.before.values)
        diagnosis = explain(system, values, settings, system.training)

    sharper = _sharp_enough(system, diagnosis.after)
    if sharper is system:
        return system, diagnosis
    return sharper, explain(sharper, diagnosis.before.values, settings, sharper.training, _former(diagnosis))


def _former(diagnosis: Diagnosis) -> Former:
    """What an answer found or came nearest by, as where fits of nearly the same system may begin."""
    found = {frozenset(f.candidate.name for f in diagnosis.found): diagnosis.after.values}
    if (nearest := diagnosis.nearest) is not None:
        found[frozenset(nearest.effects)] = nearest.fit.values
    return {names: values for names, values in found.items() if names}


def _aimed(system: EquationSystem, values: Mapping[str, float]) -> EquationSystem:
    """With a start for every term that has a number to be tried along the motion, where it explains most."""
    f = system.formulas
    if not f.along:
        return system
    passed: list[list[Array]] = []
    for s, motion in zip(system.stretches, system.predictions(values), strict=True):
        if motion is not None:
            p, u = system.numbers(values, s), system.inputs_of(s)
            passed.append(f.along_motion(f.along.values(), s.time, motion.states, p, u))
    best: dict[str, tuple[float, dict[str, float]]] = {}
    amounts = [c for c in system.candidates if any(f.owner[n] == c.name for n in f.along)]
    here = no_fit(system.base, values)
    for share in (np.arange(SCANNED) + 0.5) / SCANNED:
        tried = {}
        for i, name in enumerate(f.along):
            value = float(np.nanquantile(np.concatenate([x[i] for x in passed]), share))
            bounds = f.declared[name]
            tried[name] = float(np.clip(value, bounds.lower, bounds.upper))
        there = replace(system, aims=tried)
        if not np.isfinite(there.linearise(values, [n for c in amounts for n in c.names])[1]).all():
            continue
        linear = Linearisation(there, here, amounts)
        for c in amounts:
            gain, _ = linear.gain_of(c.names)
            if gain > best.get(c.name, (0.0, {}))[0]:
                best[c.name] = gain, {n: v for n, v in tried.items() if f.owner[n] == c.name}
    return replace(system, aims={n: v for _, aims in best.values() for n, v in aims.items()})


def _leading(
    system: EquationSystem, values: Values, terms: Collection[tuple[str, ...]]
) -> dict[frozenset[str], dict[str, float]]:
    """Those with which, over longer and longer stretches, the model follows the data to their end; the best first."""
    ways = {frozenset(names): led(replace(system, promoted=names), values) for names in terms}
    whole = {names: way.values for names, way in ways.items() if way.whole}
    return dict(sorted(whole.items(), key=lambda item: misfit(system, item[1])))


def _prepared(system: EquationSystem) -> tuple[EquationSystem, dict[str, float]]:
    """With sizes of states and widths of jumps read off the data, and initial states."""
    values, sizes = guessed(system)
    system = replace(system, sizes=sizes)
    # states of the size that the data show, in place of a motion that is not known yet
    phase = 2 * np.pi * np.arange(64) / 64
    states = np.sqrt(2) * sizes * np.cos(phase[:, None] + np.arange(len(sizes)))
    return replace(system, widths=_widths(system, [(system.stretches[0], states)])), values


def _widths(system: EquationSystem, along: Sequence[tuple[Samples, Array]]) -> dict[str, float]:
    """Of every jump, from the rms of what jumps along these motions."""
    f = system.formulas
    square, count = np.zeros(len(f.widths)), 0
    for s, states in along:
        t, p = np.linspace(s.time[0], s.time[-1], len(states)), system.numbers({}, s)
        square += [float(np.nansum(a**2)) for a in f.along_motion(f.widths, t, states, p, system.inputs_of(s, t))]
        count += len(states)
    size = np.sqrt(square / max(count, 1))
    return {w.name: JUMP * (x or 1.0) for w, x in zip(f.widths.values(), size, strict=True)}


def _sharp_enough(system: EquationSystem, fitted: Fit) -> EquationSystem:
    """With jumps so sharp that sharper ones would move the motion by nothing that matters; mostly as it is.

    A thousandth of what jumps is much where a ball's contact is as short, or where a motion starts from rest.
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


def _sized(system: EquationSystem, values: Mapping[str, float]) -> EquationSystem:
    """With sizes and widths of the motion as fitted, and what each term's numbers would typically be."""
    found = [(s, m) for s, m in zip(system.stretches, system.predictions(values), strict=True) if m is not None]
    if not found:
        return system
    sizes = np.maximum(np.max([np.abs(m.states).max(axis=0) for _, m in found], axis=0), 1e-9 * system.sizes)
    system = replace(system, sizes=sizes, widths=_widths(system, [(s, m.states) for s, m in found]))
    found_alike = sizes_alike(system, values)
    typical = {name: USUAL_SHARE * size for name, size in found_alike.items() if system.formulas.owner[name]}
    return replace(system, typical=typical)


def redundant(system: EquationSystem, values: Mapping[str, float]) -> tuple[str, ...]:
    """Parameters that the data cannot part from others, to be held as declared."""
    # of many runs with numbers of their own a few tell it
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
    if not np.isfinite(shares).all():
        return ()
    stems = np.array([q.stem for q in free])
    weak: list[str] = []
    while (left := np.flatnonzero(~np.isin(stems, weak))).size:
        _, R, order = qr(shares[:, left], mode="economic", pivoting=True)
        open_ = [str(stems[left[j]]) for i, j in enumerate(order) if abs(R[i, i]) <= REDUNDANT]
        if not open_:
            break
        weak.append(max(reversed(open_), key=open_.count))  # runs may leave one or the other of two open
    return tuple(sorted(weak))


def _with_memory(system: EquationSystem, diagnosis: Diagnosis, settings: Settings) -> tuple[Diagnosis, bool, list[str]]:
    """Search again with noise that remembers, where what is left of the best model does and is as small as noise.

    returns : diagnosis, whether its noise remembers, and a remark on that
    """
    if settings.noise is not None or diagnosis.held_out_before is None:
        return diagnosis, False, []
    residual, _ = system.linearise(diagnosis.after.values, [])
    present = np.zeros(residual.shape, bool)
    for rows, s in zip(system.rows, system.stretches, strict=True):
        present[rows] = np.isfinite(s.data)
    coefficients, share = autoregression(residual, present, system.rows)
    if not coefficients.any():
        return diagnosis, False, []
    size = float(np.sqrt(np.sum(residual**2) / max(present.sum(), 1)))
    memory = persistence(residual, system.rows) * float(np.median(np.diff(ample(system)[0].time)))
    shortest_turn = min(min(turn(s), _pace(s)) for s in ample(system))
    # so slow an error is the motion's own: that it can be predicted sample by sample does not make it noise
    as_noise = diagnosis.verdict != "unexplained" or memory <= SLOW * shortest_turn
    as_noise &= size <= NO_SENSOR
    remembering = without_memory(system, system.rows, coefficients, present)
    base = fit(remembering, system.base, diagnosis.before.values) if as_noise else None
    if base is None or not base.converged:
        if diagnosis.verdict != "unexplained":
            return diagnosis, False, []
        reason = f"what is left is {size:.3g} times the noise and lasts for {memory:.2g} s: no sensor's noise"
        diagnosis = replace(_certain(system, diagnosis), reason=reason)
        return diagnosis, False, ["sigmas are those of what is left, not of the noise alone"]
    noise = float(share * size**2)
    again = explain(remembering, base.values, replace(settings, noise=noise), system.training, _former(diagnosis))
    order = int(np.max(np.nonzero(coefficients)[1])) + 1
    text = f"what the model leaves remembers {order} sample{'s' if order > 1 else ''}; sigmas allow for that"
    return replace(again, judged=again.judged or remembering), True, [text]


def _pace(s: Samples) -> float:
    """Turn [s] of the oscillation that would lose its memory as fast as the data do, which an input may drive at will.

    Of such data the strongest line is the slowest, and says nothing of how fast they change.
    """
    rows = np.isfinite(s.data)
    mean = np.nansum(s.data, axis=0) / np.maximum(rows.sum(axis=0), 1)  # a channel may show nothing in a stretch
    away = np.where(rows, (s.data - mean) / s.sigma, 0.0)
    return persistence(away, [slice(0, len(away))]) * float(np.median(np.diff(s.time))) / FORGOTTEN


def _certain(system: EquationSystem, diagnosis: Diagnosis) -> Diagnosis:
    """Sigmas, and gains by them (Wald's test), as what is left makes them."""
    after, nearest = with_memory(system, diagnosis.after), diagnosis.nearest
    gains = [wald(*after.amounts(f.candidate.names)) for f in diagnosis.found]
    return replace(
        diagnosis,
        found=tuple(replace(f, gain=gain) for f, gain in zip(diagnosis.found, gains, strict=True)),
        before=with_memory(system, diagnosis.before),
        after=after,
        nearest=None if nearest is None else replace(nearest, fit=with_memory(system, nearest.fit)),
    )


def _not_followed(system: EquationSystem, values: Mapping[str, float]) -> str:
    lost = misfit(system, dict(values))
    what = "is nothing like the data"
    if not np.isfinite(lost):
        what = "has no value somewhere on the way (the root of a negative number, a division by zero, no end of growth)"
    elif not np.isfinite(system.linearise(values, [q.name for q in system.base])[1]).all():
        return (
            "the motion can be followed, but not how it depends on its parameters: so it is where equations jump, as "
            "at a stiff contact. Write the contact wider, or cut the data into runs without it."
        )
    guess = ", ".join(f"{k.partition('.')[2]} = {v:.4g}" for k, v in list(values.items())[:4] if k.startswith("state."))
    return (
        f"the model does not follow the data even over a short time (residual over {LOST:.0%} of the signal): "
        f"as declared it {what}. Guessed start: {guess}. Check signs and units of the equations, declare parameters "
        "nearer to the truth, or give Run(start={...})."
    )


def _sensor_notes(samples: Sequence[Samples], channel: int, name: str) -> list[str]:
    """Steps in which a sensor shows, and limits at which it stands."""
    notes = []
    values = [s.data[:, channel] for s in samples if np.isnan(s.sigma[:, channel]).any()]
    step = step_of(values) if values else 0.0
    if step and fast_part(values) < 3 * step:
        notes.append(f"{name} stands on steps of {step:.4g}, which alone scatter by {step / np.sqrt(12):.3g}")
    everything = np.concatenate([s.data[:, channel] for s in samples])
    least, most = np.nanmin(everything, initial=np.inf), np.nanmax(everything, initial=-np.inf)
    if least == most:
        raise AnalysisError(f"{name} shows {most:g} at all times: its sensor is dead. Leave it out.")
    for limit, which in ((most, "most"), (least, "least")):
        count = int(np.sum(everything == limit))
        if not step and count > STANDS:  # noise repeats no value; an encoder at rest does
            notes.append(
                f"{name} shows {limit:.4g}, the {which} of all, {count} times: where its sensor is dead or at its "
                "limit, write NaN, or offer terms.sensor_limit"
            )
    return notes
