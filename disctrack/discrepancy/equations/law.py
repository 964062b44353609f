"""An unknown force learned from the residuals: a function of one or two states or inputs, or of time.

The function is a Gaussian process in a reduced-rank basis: a line, cosines over the range of the motion, and for
velocities a jump at rest, each amplitude with a prior sigma that falls with its wave number (Solin & Sarkka 2020). Of
an angle that goes round, it is periodic.
Amplitude and smoothness maximise the marginal likelihood (MacKay 1992), which also selects the equation and the
variables. Two variables are tried where one is not enough. The law is a term like any other, with exact derivatives.
Where the declared equations are far from the data, it is learned by multiple shooting.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations, product
from typing import Any

import numpy as np
from scipy import linalg
from scipy.spatial import KDTree

from calibration.kit.types import Array
from disctrack.discrepancy import search
from disctrack.discrepancy.equations import shooting
from disctrack.discrepancy.equations.declared import Equations, Parameter, Samples, Term
from disctrack.discrepancy.equations.formulas import Formulas
from disctrack.discrepancy.equations.system import MOST_STATES, EquationSystem, Prediction
from disctrack.discrepancy.fit import TRIAL, Fit, fit, no_fit
from disctrack.discrepancy.held_out import HeldOut, held_out
from disctrack.discrepancy.noise import outlier_limit, with_autocorrelation
from disctrack.discrepancy.score import Linearisation
from disctrack.discrepancy.significance import evidence
from disctrack.discrepancy.system import Candidate, GivenUp, Quantity, System, Values
from disctrack.numbers import Measured

NAME = "learned"  # of the term
HARMONICS = (24, 8)  # highest wave number of a law of one variable, and of two
MARGIN = 0.2  # of the visited range, added at both ends: cosines have zero slope at the ends of their interval
SMOOTH = (0.7, 1.5, 3.0, 6.0)  # wave numbers above which amplitudes fall as the inverse square
SIZES = np.logspace(-4, 2, 31)  # prior sigma of the first amplitudes over the rms of their equation
MOST_LAWS = 40  # above which a law depends on variables of its own equation only
REFITTED = 4  # laws that are fitted in full
WORTH = 50.0  # of first-order -2 log evidence over the best law, up to which a law is fitted ...
ROUGHLY = 4.0  # ... over this multiple of the best, where the declared equations are far from the data
PLAUSIBLE = 4.0  # of -2 log evidence: a rougher prior may be less probable by so much
POINTS = (61, 400)  # of the reported course, for one and two variables
FORMULAS: Mapping[str, Callable[[Array], Array]] = {  # sums of which tell a law of one variable; of equals the first
    "": np.ones_like, "{0}": np.positive, "{0}²": np.square, "{0}³": lambda x: x * np.square(x), "|{0}|": np.abs,
    "sign {0}": np.sign, "{0} |{0}|": lambda x: x * np.abs(x),
}  # fmt: skip
TURNS = {"rad": 2 * np.pi, "deg": 360.0}  # a turn, by the unit of an angle


@dataclass(frozen=True)
class Along:
    """The equation in which a law acts, and the variables on which it depends."""

    equation: str  # state of the equation
    variables: tuple[str, ...]  # one or two states or inputs; or "t" alone
    jumps: bool = False  # with the sign of the variable, as friction does
    period: float = 0.0  # of an angle that goes round

    @property
    def title(self) -> str:
        """In words."""
        of = f"{'time' if self.of_time else self.variable}{', the same in every turn' if self.period else ''}"
        return f"a force on {self.equation} that is a function of {of}"

    @property
    def variable(self) -> str:
        """Its variables in words."""
        return " and ".join(self.variables)

    @property
    def of_time(self) -> bool:
        """A function of time alone, which fits any motion and predicts nothing?"""
        return self.variables == ("t",)

    def units(self, of_states: Mapping[str, str]) -> list[str]:
        """Of its variables."""
        return ["s"] if self.of_time else [of_states.get(name, "1") for name in self.variables]


@dataclass(frozen=True, kw_only=True)
class LearnedForce(search.Explanation):
    """An explanation by a learned law, the last of its candidates, and by known terms before it."""

    along: Along
    instead: search.Explanation  # the shortest by known terms alone
    at_noise: bool  # are its residuals noise?
    noise: float  # variance over that stated
    system: EquationSystem  # with the law as a term
    judged: System  # the same with its noise as estimated
    equivalent: tuple[Along, ...] = ()  # laws that are not longer by CLASS_GAIN

    @property
    def candidate(self) -> Candidate:
        """The law."""
        return self.candidates[-1]

    @property
    def known(self) -> tuple[Candidate, ...]:
        """Known terms that were fitted with it."""
        return self.candidates[:-1]

    @cached_property
    def held_out(self) -> HeldOut:
        """Prediction of the held-out samples."""
        return held_out(self.judged, self.fit.quantities, self.fit.values, self.system.training)

    @cached_property
    def held(self) -> tuple[str, ...]:
        """Declared parameters that act as a part of the law: it is reported relative to their declared values."""
        return tuple(sorted(_part_of_law(self.system.formulas, self.along, self.system.held)))

    @cached_property
    def course(self) -> tuple[Array, Array, Array]:
        """Places (k,), or (k, 2) along the motion; the force (k,) there, and its covariance (k, k).

        Places are evenly over the values visited; the force is beyond the declared equations.
        """
        law, fitted, own = self.along, self.fit, self.candidate.quantities
        visited, k = _visited(self.system, law.variables, fitted.values), len(law.variables) - 1
        ends = (0.0, law.period) if law.period else (float(visited.min()), float(visited.max()))
        some = np.linspace(0, len(visited) - 1, POINTS[1]).astype(int)
        at = visited[some] if k else np.linspace(*ends, POINTS[0])[:, None]
        names = [*(q.name for q in own), *self.held]
        force, columns = _course(self.system, law, names, fitted.values, at)
        # variance of the truncated basis, whose amplitudes fall as the inverse square of the wave number
        finer = (HARMONICS[0] / 6.0, np.pi / 16.0 * HARMONICS[1] ** 2)[k] * min(q.prior_sigma for q in own) ** 2
        scale = max(self.noise, fitted.reduced_chi_square)
        covariance = scale * columns @ fitted.amounts(names)[1] @ columns.T + self.noise * finer * np.eye(len(at))
        return at if k else at[:, 0], force, covariance

    @property
    def variable(self) -> Array:
        """Places (k,) or (k, 2) of the course."""
        return self.course[0]

    @property
    def force(self) -> Array:
        """(k,) beyond the declared equations."""
        return self.course[1]

    @property
    def sigma(self) -> Array:
        """(k,) of the force."""
        return np.sqrt(np.diag(self.course[2]))

    @cached_property
    def formula(self) -> dict[str, Measured]:
        """Amounts of the shortest sum of `FORMULAS`; empty if its chi-square to the course is above one per point.

        Empty, too, if the course is uncertain enough to be zero everywhere.
        """
        (places, force, covariance), told = self.course, dict[str, Measured]()
        if places.ndim > 1 or self.along.period or not np.isfinite(force @ covariance @ force):
            return {}
        root = np.linalg.cholesky(covariance + 1e-9 * np.trace(covariance) / len(force) * np.eye(len(force)))
        columns = np.column_stack([force, *(f(places) for f in FORMULAS.values())])
        right, *whitened = linalg.solve_triangular(root, columns, lower=True).T
        made, shortest = dict(zip(FORMULAS, whitened, strict=True)), float(right @ right)  # of none
        for names in chain(*(combinations(FORMULAS, n) for n in (1, 2, 3))):
            matrix = np.stack([made[name] for name in names], axis=1)
            amounts = np.linalg.lstsq(matrix, right)[0]
            left = float(np.sum((right - matrix @ amounts) ** 2))
            if left < len(right) and (its := left + search.CLASS_GAIN * len(names)) < shortest - 1e-3:
                shortest, sigmas = its, np.sqrt(np.diag(np.linalg.pinv(matrix.T @ matrix)))
                words = (name.format(self.along.variable) for name in names)
                told = dict(zip(words, map(Measured, amounts, sigmas), strict=True))
        return told

    def is_named(self, diagnosis: search.Diagnosis) -> bool:
        """Is the law reported as the best description, together with all known terms that were found?"""
        stays = {f.candidate.name for f in diagnosis.found} <= {c.name for c in self.known}
        return self.is_shorter and (self.at_noise or stays)

    @property
    def is_shorter(self) -> bool:
        """Is it shorter than the best known terms? Of two that are indistinguishable, the known one is reported."""
        return self.length < self.instead.length - search.CLASS_GAIN

    def document(self) -> dict[str, Any]:
        """Its course in JSON types, with the alternatives."""
        return {
            "equation": self.along.equation,
            "variable": self.along.variable,
            "jumps_with_its_sign": self.along.jumps,
            "period": self.along.period or None,
            "beyond": list(self.held),
            "beside": [c.name for c in self.known],
            "at": self.variable,
            "force": self.force,
            "formula": {function: vars(amount) for function, amount in self.formula.items()},
            "sigma": self.sigma,
            "at_noise": self.at_noise,
            "minus_2_log_evidence": self.length,
            "cannot_be_told_from": [{"equation": a.equation, "variable": a.variable} for a in self.equivalent],
            "known_terms": [c.name for c in self.instead.candidates],
            "minus_2_log_evidence_of_known_terms": self.instead.length,
        }

    def text(self, units: Mapping[str, str]) -> str:
        """Its formula, or its course at both ends, in the middle and at its extremes; of two variables at quantiles."""
        places, last = self.variable.reshape(len(self.force), -1), len(self.force) - 1
        order, points = np.argsort(self.force), []
        quantiles = order[np.linspace(0, last, 5).round().astype(int)]
        shown = quantiles if places.shape[1] > 1 else np.unique([0, last // 2, last, order[0], order[-1]])
        for i in shown:
            place = zip(places[i], self.along.units(units), strict=True)
            where = ", ".join(f"{x:.3g} {unit if unit != '1' else ''}".rstrip() for x, unit in place)
            points.append(f"{self.force[i]:.3g}({self.sigma[i]:.2g}) at {where}")
        held = f", beyond {' and '.join(self.held)} as declared" if self.held else ""
        formula = " + ".join(f"({amount}) {function}".rstrip() for function, amount in self.formula.items())
        return f"{self.along.title} [{NAME}{held}]: {formula or '; '.join(points)}"


def learn(system: EquationSystem, diagnosis: search.Diagnosis, judged: System) -> LearnedForce | None:
    """The law of the largest evidence; together with a known term, or of two variables, where that is needed.

    judged : the system with its noise as estimated
    Where no law leaves noise, the law nearest to the data, together with known terms. None where no law explains most
    of the excess chi-square, where one known term explains it, or where there are too many runs.
    """
    if diagnosis.held_out_before is None or (diagnosis.verdict != "unexplained" and len(diagnosis.found) < 2):
        return None
    if len(system.stretches) * len(system.formulas.states) > MOST_STATES:  # too many initial states to fit
        return None
    begin = diagnosis.before.values
    one, law, reportable = _Competition(1, _knowing(system, 1, begin), diagnosis, judged), None, False
    several = diagnosis.verdict == "unexplained" or len(diagnosis.found) > 2
    for variables, with_known in ((1, False), (1, True), (2, False))[: 3 if several else 1]:
        if law is not None and reportable and law.at_noise:
            break
        over = one if variables == 1 else _Competition(2, _knowing(system, 2, begin), diagnosis, judged)
        for known in [(c,) for c in over.known_terms()] if with_known else [()]:
            trial = over.best(known) if system.budget.open() else None
            if trial is not None and (law is None or trial.length < law.length):
                law, reportable = trial, over.is_reportable(trial)
    return law if reportable else _nearest(one.system, diagnosis, judged)


def _nearest(system: EquationSystem, diagnosis: search.Diagnosis, judged: System) -> LearnedForce | None:
    """The law that improves the best known terms, with their residuals taken for noise; it is no finding.

    With good sensors no model of a real system leaves noise. None where known terms do not come near the data.
    """
    known, d = diagnosis.ranked[0], diagnosis
    noise = max(d.noise, known.fit.reduced_chi_square)
    near = known.candidates and d.before.reduced_chi_square > search.FAR * noise
    if d.verdict != "unexplained" or not near:
        return None
    view = judged.over(system)
    before = held_out(view, known.fit.quantities, known.fit.values, system.training)
    known = replace(known, length=search.length(view, d.settings, noise, known.fit, known.candidates))
    worse = replace(d, noise=noise, before=known.fit, held_out_before=before, ranked=(known,))
    over = _Competition(1, system, worse, judged)
    law = over.best(known.candidates)
    if law is None or law.along.of_time:
        return None
    predicts = law.held_out.chi_square < before.chi_square  # by its values, and not by its uncertainty
    return replace(law, at_noise=False) if predicts and law.is_shorter and over.is_reportable(law) else None


class _Competition:
    """Comparison of laws with each other and with known terms, by the evidence of the same samples."""

    def __init__(self, variables: int, system: EquationSystem, diagnosis: search.Diagnosis, judged: System) -> None:
        self.system, self.diagnosis, self.noise, self.judged = system, diagnosis, diagnosis.noise, judged
        self.begin = diagnosis.before.values
        chi_square = float(np.sum(system.linearise(self.begin, [])[0] ** 2))
        self.far = not chi_square < search.FAR * self.noise * max(float(np.sum(system.weights)), 1.0)
        self.laws = tuple(_laws(system, self.begin, variables))
        self.trials_penalty = 2.0 * float(np.log(max(len(self.laws), 1)))
        self.shots = shooting.levels(system) if self.far else [system]
        self.instead = next((e for e in diagnosis.ranked if e.candidates), search.Explanation((), diagnosis.before))

    def has_converged(self, fitted: Fit) -> bool:
        """Is the promised gain insignificant? Along directions that only the prior determines, steps never end."""
        return fitted.converged or fitted.promised < search.CLASS_GAIN * self.noise

    def at_noise(self, system: System, fitted: Fit) -> bool:
        """As in the search; and has the law no outliers? A kink that it does not follow raises the noise, too."""
        if not (self.has_converged(fitted) and search.is_noise(fitted, self.diagnosis.settings, self.noise)):
            return False
        size = np.abs(system.linearise(fitted.values, [])[0])
        return not size.max() > outlier_limit(size[size > 0])  # missing data have zeros

    def known_terms(self) -> list[Candidate]:
        """Known terms that may act with a law: those of the shortest explanations."""
        named = dict.fromkeys(c.name for e in self.diagnosis.ranked for c in e.candidates)
        own = {c.name: c for c in self.system.candidates}
        return [own[name] for name in named if name in own][: search.WIDTH]

    def is_reportable(self, law: LearnedForce) -> bool:
        """Does the law predict held-out data, and leave noise, or nearly all of the excess chi-square explained?

        If its residuals are not noise, it also has to be shorter than known terms, and to predict better than these.
        """
        d = self.diagnosis
        if not self.has_converged(law.fit) or d.held_out_before is None:
            return False
        gain, error = law.held_out.gain_over(d.held_out_before, self.noise), law.held_out.chi_square
        # where no two values return, any force is a function of them: by its values, and not by a wide uncertainty
        closer = len(law.along.variables) == 1 or error < d.held_out_before.chi_square
        if not (gain > search.CLASS_GAIN and closer):
            return False
        most = d.settings.unexplained_share * d.before.excess(self.noise)
        predicts = d.held_out_after is None or error < d.held_out_after.chi_square
        return law.at_noise or (law.is_shorter and predicts and law.fit.excess(self.noise) < most)

    def best(self, known: tuple[Candidate, ...]) -> LearnedForce | None:
        """The law of the largest evidence, fitted together with these terms."""
        first, values = self.shots[0], self.begin
        if self.far:
            declared = {q.name: q.null for q in first.base if not q.is_initial}
            values = self.begin | declared | shooting.initial_guess(first)[0]
            values = fit(first, [shooting.with_weak_prior(q) for q in first.base], values, TRIAL).values
        scans = []
        for law in self.laws:
            there, numbers = _set(first, law, values)
            length, quantities = self._evidence(there, law, known, {**values, **numbers})
            if np.isfinite(length):
                scans.append((length, law, quantities))
        scans.sort(key=lambda scan: scan[0])
        trials: list[LearnedForce] = []
        shortest = min((length for length, law, _ in scans if not law.of_time), default=0.0)
        # where the declared equations do not follow the data, the first order is a rough guide
        enough = ROUGHLY * shortest + WORTH if self.far else shortest + search.CLASS_GAIN
        for length, law, quantities in scans[:REFITTED]:
            if length > enough or not self.system.budget.open():
                break
            trials += self._fitted(law, known, quantities, values, self.shots)
        if not trials:
            return None
        near = search.equivalent([trial for trial in trials if self.has_converged(trial.fit)] or trials)
        # a function of time fits any motion: a function of the state says more, and is tested by every other run
        best = min(near, key=lambda trial: trial.along.of_time)
        if known:  # which may only have led to the law
            without = best.fit.values | {q.name: q.null for c in known for q in c.quantities}
            alone = self._fitted(best.along, (), best.candidate.quantities, without, self.shots[-1:])
            best = min(best, *alone, key=lambda trial: trial.length) if alone else best
        others = (replace(t.along, jumps=False) for t in near if t.along.title != best.along.title)
        return replace(best, equivalent=tuple(dict.fromkeys(others)))

    def _others(self, system: EquationSystem, known: Sequence[Candidate]) -> tuple[Quantity, ...]:
        return (*system.base, *(q for c in known for q in c.quantities))

    def _evidence(
        self, system: EquationSystem, law: Along, known: Sequence[Candidate], values: Values
    ) -> tuple[float, tuple[Quantity, ...]]:
        """First-order -2 log evidence, and the law's quantities with the priors that maximise the evidence."""
        others = self._others(system, known)
        initials = "ab" if law.period else "asj" if law.jumps else "as"  # of the law's basis functions
        own = tuple(q for c in system.candidates if c.name == NAME for q in c.quantities if q.part[0] in initials)
        values = {q.name: q.null for q in (*others, *own)} | dict(values)
        view = self.judged.over(system) if len(system.stretches) == len(self.system.stretches) else system
        linear = Linearisation(view, no_fit(others, values), [_candidate(law, own)])
        columns = linear.columns([q.name for q in own])
        # residuals without the law
        right = linear.cleared(linear.right + columns @ np.array([values[q.name] for q in own]))
        columns = linear.cleared(columns)
        if not linear.usable:
            return np.inf, own
        size, root, found = shooting.scales(system, values).get(own[0].name, 1.0), np.sqrt(self.noise), []
        basis = _basis(len(law.variables))
        waves = np.array([basis[q.part][1] for q in own])
        for smooth in SMOOTH:
            falls = 1.0 / (1.0 + (waves / smooth) ** 2)  # prior sigma of each amplitude over that of the first
            # the faster driver may fail for nearly equal columns
            U, singular, _ = linalg.svd(columns * falls, full_matrices=False, lapack_driver="gesvd")
            lengths = evidence(size * singular / root, U.T @ right / root, SIZES)
            # zero columns do not determine a size
            if not (np.isfinite(lengths).all() and np.isfinite(right @ right / self.noise)):
                return np.inf, own
            found.append((float(lengths.min()), SIZES[int(np.argmin(lengths))] * size * falls))
        shortest = min(length for length, _ in found)
        # the roughest of the plausible priors: a smooth one would understate the uncertainty between the data
        plausible = [prior for length, prior in found if length < shortest + PLAUSIBLE]
        prior = max(plausible, key=lambda prior: float(prior[np.argmax(waves)])) / root
        # chi-square of the fit is not in units of the noise
        own = tuple(replace(q, prior_sigma=s, scale=1e-3 * s) for q, s in zip(own, prior.tolist(), strict=True))
        return shortest + float(right @ right) / self.noise + self.trials_penalty, own

    def _fitted(
        self, law: Along, known: tuple[Candidate, ...], own: tuple[Quantity, ...], values: Values,
        shots: Sequence[EquationSystem],
    ) -> list[LearnedForce]:  # fmt: skip
        """The law fitted over longer and longer stretches; none where it loses the data, or takes too many steps."""
        with suppress(GivenUp), self.system.budget.trial(self.system.trial_work):
            first, numbers = _set(shots[0], law, values)
            now = {q.name: 0.0 for q in own} | dict(values) | numbers
            for system in shots:
                there = replace(system, widths=first.widths)
                others, view = self._others(there, known), self.judged.over(there) if system is shots[-1] else there
                fitted = fit(view, (*others, *own), now, TRIAL)
                if not fitted.reduced_chi_square < search.FAR * self.noise:  # longer stretches leave more
                    return []
                now = fitted.values
                evident, own = self._evidence(there, law, known, now)
            fitted = fit(view, (*others, *own), now, TRIAL)
            # declared parameters and known terms have their usual penalties; that of the law is part of the evidence
            usual = search.length(view, self.diagnosis.settings, self.noise, fitted, known) - fitted.cost / self.noise
            there = _set(self.system, law, fitted.values)[0]
            return [LearnedForce(
                (*known, _candidate(law, own)), fitted, length=evident + usual, along=law, instead=self.instead,
                at_noise=self.at_noise(view, fitted), noise=self.noise, system=there, judged=self.judged.over(there),
            )]  # fmt: skip
        return []


def _laws(system: EquationSystem, values: Values, n: int) -> Iterator[Along]:
    """Every law of n variables that is tried: in every equation of a force, of states, inputs, or time alone.

    In a large system, of the variables that its equation contains already, and time.
    """
    equations, turns = system.formulas.equations, _periods(system, values) if n == 1 else {}
    moving = (*equations.states, *equations.inputs)
    velocities = {str(f).strip() for f in equations.rates.values()} & set(equations.rates)
    choices = [*combinations(moving, n), *[("t",)][: 2 - n]]
    many = len(_forced(equations)) * len(choices) > MOST_LAWS
    for equation in _forced(equations):
        there = {s.name for s in system.formulas.forces[equations.states.index(equation)].free_symbols} | {"t"}
        for variables in choices:
            if many and not there.issuperset(variables):
                continue
            yield Along(equation, variables)
            if variables[0] in turns:
                yield Along(equation, variables, period=turns[variables[0]])
            velocity = n == 1 and variables[0] in {equation, *velocities}
            if velocity and {-1.0, 1.0} <= set(np.sign(_visited(system, variables, values)[:, 0]).tolist()):
                yield Along(equation, variables, jumps=True)


def _periods(system: EquationSystem, values: Values) -> dict[str, float]:
    """A turn, of each state that is an angle and of which more than that was seen."""
    e = system.formulas.equations
    turns = {state: TURNS[e.units[state]] for state in e.states if e.units.get(state) in TURNS}
    seen = np.ptp(_visited(system, [*turns], values), axis=0) if turns else []
    return {state: turn for (state, turn), range_ in zip(turns.items(), seen, strict=True) if range_ > turn}


def _forced(equations: Equations) -> list[str]:
    """States whose equations are more than a definition (x' = v)."""
    return [s for s, f in equations.rates.items() if str(f).strip() not in equations.rates]


def _knowing(system: EquationSystem, n: int, values: Values) -> EquationSystem:
    """The system with a law of n variables as a further term; constants select its equation and its variables."""
    f = system.formulas
    e = f.equations
    words = dict[str, str]()
    constants = {f"{NAME}_on_{s}": 0.0 for s in _forced(e)}
    for i in range(n):
        own = f"{NAME}_{i}"
        words[f"x{i}"] = "(" + " + ".join(f"{own}_of_{name}*{name}" for name in (*e.states, *e.inputs, "t")) + ")"
        words[f"p{i}"] = f"({words[f'x{i}']} - {own}_from)/{own}_span"
        constants |= dict.fromkeys([f"{own}_of_{name}" for name in (*e.states, *e.inputs, "t")] + [f"{own}_from"], 0.0)
        constants[f"{own}_span"] = 1.0
    # functions that no law has would cost as much as the others
    omitted = () if n == 1 and _periods(system, values) else ("b",)
    basis = {name: formula for name, (formula, _) in _basis(n).items() if not name.startswith(omitted)}
    course = " + ".join(f"own_{name}*{formula.format(**words)}" for name, formula in basis.items())
    term = Term(
        NAME, {s: f"{NAME}_on_{s}*({course})" for s in _forced(e)},
        parameters=dict.fromkeys(basis, Parameter(0.0)), title="a force that no term names",
    )  # fmt: skip
    known = Formulas(replace(e, constants={**e.constants, **constants}), (*f.terms, term), f.channels)
    widths = {known.widths[a].name: system.widths[w.name] for a, w in f.widths.items() if a in known.widths}
    new = {w.name: 1.0 for w in known.widths.values() if w.name not in widths}
    return replace(system, formulas=known, widths=widths | new)


def _basis(n: int) -> dict[str, tuple[str, float]]:
    """Basis functions of a law of n variables and their wave numbers, by the names of their amplitudes.

    Formulas of the positions {p} within the ranges, and of the variables {x}.
    """
    most = HARMONICS[n - 1]
    found = {}
    for waves in product(range(most + 1), repeat=n):
        cosines = [f"cos({k}*pi*{{p{i}}})" for i, k in enumerate(waves) if k]
        if (number := float(np.linalg.norm(waves))) <= most:
            found["a" + "_".join(map(str, waves))] = "*".join(cosines) or "1", number
    found |= {f"slope{i or ''}": (f"(2*{{p{i}}} - 1)", 0.0) for i in range(n)}
    if n > 1:
        return found
    sines = {f"b{k}": (f"sin({k}*pi*{{p0}})", float(k)) for k in range(1, most + 1)}
    return found | sines | {"jump": ("sign({x0})", 0.0)}


def _candidate(law: Along, own: tuple[Quantity, ...]) -> Candidate:
    return Candidate(NAME, NAME, "motion", law.title, "learned from the residuals", own)


def _set(system: EquationSystem, law: Along, values: Values) -> tuple[EquationSystem, dict[str, float]]:
    """The system for one law, and the constants that select its equation, variables and ranges."""
    numbers = {n: 0.0 for n in system.formulas.constants if n.startswith(f"{NAME}_")}
    numbers[f"{NAME}_on_{law.equation}"] = 1.0
    visited = _visited(system, law.variables, values)
    for i, (variable, x) in enumerate(zip(law.variables, visited.T, strict=True)):
        span = max(float(np.ptp(x)), 1e-12 * max(float(np.abs(x).max()), 1e-12))
        first, length = float(x.min()) - MARGIN * span, (1 + 2 * MARGIN) * span
        if law.period:
            first, length = 0.0, law.period / 2
        own = {f"of_{variable}": 1.0, "from": first, "span": length}
        numbers |= {f"{NAME}_{i}_{n}": x for n, x in own.items()}
    of = f"{NAME}_0_of_"
    mine = [w.name for a, w in system.formulas.widths.items() if any(s.name.startswith(of) for s in a.free_symbols)]
    size = float(np.sqrt(np.mean(visited[:, 0] ** 2)))
    return replace(system, widths=system.widths | {w: 1e-3 * (size or 1.0) for w in mine}), numbers


def _visited(system: EquationSystem, variables: Sequence[str], values: Values) -> Array:
    """States, inputs or time (n, k) at the samples of all stretches."""
    everything = np.concatenate([_along(system, variables, s, motion) for s, motion in system.predictions(values)])
    return everything if len(everything) else np.tile([[-1.0], [1.0]], len(variables))


def _along(system: EquationSystem, variables: Sequence[str], s: Samples, motion: Prediction | None) -> Array:
    """States, inputs or time (n, k) at the samples of a stretch; none (0, k) where its motion cannot be integrated."""
    e = system.formulas.equations
    states = dict(zip(e.states, motion.states.T if motion else [], strict=False))
    known = {"t": s.time, **dict(zip(e.inputs, system.inputs_of(s), strict=False)), **states}
    there = known.keys() >= {*variables}
    return np.stack([known[name] for name in variables], axis=1) if there else np.zeros((0, len(variables)))


def _part_of_law(f: Formulas, law: Along, held: Sequence[str]) -> set[str]:
    """Parameters that act only in the law's equation, as a function of its variables alone."""
    here = f.equations.states.index(law.equation)
    forces = [*f.forces[:here], *f.forces[here + 1 :], *f.observed, *f.late, *f.masses]
    elsewhere = set().union(*(e.free_symbols for e in forces))
    driving = {s.name for s in (*f.states, *f.inputs, *f.input_rates)} | {"t"}
    found = set()
    for name, symbol in f.fitted.items():
        if f.owner[name] or f.declared[name].per or name in held or symbol in elsewhere:
            continue
        acts = f.forces[here].diff(symbol)
        if acts != 0 and {s.name for s in acts.free_symbols} & driving <= {*law.variables}:
            found.add(name)
    return found


def _course(system: EquationSystem, law: Along, names: Sequence[str], values: Values, at: Array) -> tuple[Array, Array]:
    """Force (n,) by these parameters, relative to the declared ones, at places (n, k); derivatives (n, names)."""
    f, s = system.formulas, system.stretches[0]
    # other states and inputs as they were near these places: elsewhere the equations may have no value
    motion = system.predict(values, s)
    visited = _along(system, law.variables, s, motion)
    near = KDTree(visited).query(at)[1] if len(visited) else np.zeros(len(at), int)
    states = np.tile(system.start_of(values, s), (len(at), 1)) if motion is None else motion.states[near]
    times = at[:, 0] if law.of_time else np.asarray(np.arange(len(at)) + 0.5, float)
    pieces = np.zeros((len(s.pieces), 5, len(at)))
    pieces[:, 3] = np.reshape([u[near] for u in system.inputs_of(s)[: len(s.pieces)]], (-1, len(at)))
    for variable, x in zip(law.variables, at.T, strict=True):
        if variable in f.equations.states:
            states[:, f.equations.states.index(variable)] = x
        elif variable in f.equations.inputs:
            pieces[list(f.equations.inputs).index(variable), 3] = x
    s = s if law.of_time else replace(s, knots=np.arange(len(at) + 1.0), pieces=pieces)
    declared = {name: f.declared[name].value for name in names}
    here = f.equations.states.index(law.equation)
    (now, _, by_number), (before, *_) = (
        f.rates_at(s, system.numbers({**values, **changed}, s), times, states) for changed in ({}, declared)
    )
    column = {name: i for i, name in enumerate(f.numbers)}
    own = by_number[:, here, [column[name] for name in names]]
    return (now - before)[:, here] / own[:, 0], own / own[:, :1]  # first that by the constant


def with_law(diagnosis: search.Diagnosis, law: LearnedForce) -> search.Diagnosis:
    """The answer with the law, and the known terms that were fitted with it, in place of what was found.

    Where its residuals are not noise, the law is the nearest description, and what was found stays. A function of time
    alone, which fits any motion, is no finding.
    """
    level = f"{law.fit.reduced_chi_square:.3g} per degree of freedom at a noise of {diagnosis.noise:.3g}"
    reason = f"chi-square stays at {diagnosis.before.reduced_chi_square:.3g}, with a law that was learned at {level}"
    if not law.at_noise:
        return replace(diagnosis, reason=reason, nearest=replace(law, fit=with_autocorrelation(law.system, law.fit)))
    ranked = sorted((*diagnosis.ranked, law), key=lambda e: e.length)
    known = () if law.along.of_time else law.known
    outcomes = {f.candidate.name: "the law that was learned describes more" for f in diagnosis.found}
    outcomes |= {c.name: "chosen" for c in known}
    tried = [replace(t, reason=outcomes.get(t.candidate.name, t.reason)) for t in diagnosis.tried]
    nothing = replace(
        diagnosis, verdict="unexplained", reason=reason, found=(), after=diagnosis.before, tried=tuple(tried),
        held_out_after=diagnosis.held_out_before, nearest=law, ranked=tuple(ranked), length=law.length,
    )  # fmt: skip
    if law.along.of_time or diagnosis.held_out_before is None:
        return nothing
    held_gain = law.held_out.gain_over(diagnosis.held_out_before, diagnosis.noise)
    gain = (diagnosis.before.cost - law.fit.cost) / diagnosis.noise
    found = [search.Found(c, gain, held_gain, 0.0, ()) for c in law.candidates]
    answer = replace(
        nothing, verdict="found", reason=f"with a law that no term names, chi-square falls to {level}",
        found=tuple(found[:-1]), after=law.fit, held_out_after=law.held_out, nearest=None,
    )  # fmt: skip
    return search.with_found(answer, found[-1:])
