"""A force that no term names, learned from what the equations leave: of one or two states or inputs, or of time.

The function is a normal process: a line, cosines over the range that the motion visits, and for velocities a jump at
rest, each amplitude with a standard deviation that falls with its wave number (Solin & Sarkka 2020). How large and how
smooth it is follows from the data (evidence, MacKay 1992); so does which equation it acts in, and along what. Two
variables are looked at where no law of one is enough. It stands in the equations as any term does, with exact
derivatives. Where the declared equations are far from the data, it is first learned over short stretches with a start
each, and these are joined two by two.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product
from typing import Any

import numpy as np
from scipy import linalg

from calibration.kit.arrays import Array
from disctrack.discrepancy.equations.declared import Equations, Parameter, Term
from disctrack.discrepancy.equations.expressions import Formula
from disctrack.discrepancy.equations.formulas import Formulas
from disctrack.discrepancy.equations.start import cut_short, guessed, near_declared, sizes_alike, trusted
from disctrack.discrepancy.equations.system import MOST_STATES, EquationSystem
from disctrack.discrepancy.fit import TRIAL, Fit, fit, no_fit
from disctrack.discrepancy.held_out import HeldOut, held_out
from disctrack.discrepancy.noise import with_memory
from disctrack.discrepancy.score import Linearisation
from disctrack.discrepancy.search import (
    CLASS_GAIN,
    FAR,
    WIDTH,
    Diagnosis,
    Explanation,
    Found,
    alike,
    is_noise,
    length,
    with_found,
)
from disctrack.discrepancy.significance import evidence
from disctrack.discrepancy.system import Candidate, GivenUp, Quantity, System, Values

NAME = "learned"  # of the term
HARMONICS = (24, 8)  # of a law of one variable, and in any direction of one of two
MARGIN = 0.2  # of the range that is visited, beyond it: what cosines do at their ends is not the law's
SMOOTH = (0.7, 1.5, 3.0, 6.0)  # wave numbers from which on amplitudes fall ...
FALLS = (1.5, 1.0)  # ... as these powers of 1 + (wave number over it) squared: without kinks, and with some
FINE, STRAIGHT = 0.03, 1e4  # of the largest value: the variable's inverse hyperbolic sine beyond it, or itself
SIZES = np.logspace(-4, 2, 31)  # prior sigma of the first amplitudes, over the rms of the equation that it stands in
MOST_LAWS = 40  # that are looked at in any case
REFITTED = 4  # laws that are fitted in full: the next one may wander for longer than these take
WORTH = 50.0  # of -2 log evidence to first order: a law that is so much worse than another is not fitted ...
ROUGHLY = 4.0  # ... times that of the other, where the declared equations are far from the data
PLAUSIBLE = 4.0  # the same, by which a rougher law may be less probable than the best one
ROUNDS = 3  # in which size and smoothness follow the fit, and the fit them
POINTS = (61, 400)  # of the course that is told
TURNING = 2  # times that a velocity changes its sign, from which on friction may jump with it


@dataclass(frozen=True)
class Along:
    """Where a law acts, and what it is a function of."""

    equation: str  # state whose equation it stands in
    variables: tuple[str, ...]  # one or two states or inputs; or "t" alone
    jumps: bool = False  # with the variable's sign, as friction does
    fine: bool = False  # of finer waves near zero, as drag that falls with speed has them

    @property
    def title(self) -> str:
        """In words."""
        return f"a force on {self.equation} that is a function of {'time' if self.of_time else self.variable}"

    @property
    def variable(self) -> str:
        """What it is a function of."""
        return " and ".join(self.variables)

    @property
    def of_time(self) -> bool:
        """Of time alone, which any motion has, and which foretells nothing?"""
        return self.variables == ("t",)

    def units(self, of_states: Mapping[str, str]) -> list[str]:
        """Of its variables."""
        return ["s"] if self.of_time else [of_states.get(name, "1") for name in self.variables]


@dataclass(frozen=True, kw_only=True)
class LearnedForce(Explanation):
    """An explanation by a learned law, the last of its candidates, and by known terms before it."""

    along: Along
    instead: Explanation  # the shortest by known terms alone
    at_noise: bool  # are its residuals noise?
    noise: float  # variance over that stated
    system: EquationSystem  # that knows the law
    judged: System  # the same with its noise as judged
    alike: tuple[Along, ...] = ()  # laws that are not longer by CLASS_GAIN

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
        """Prediction of the samples that judge the fit."""
        return held_out(self.judged, self.fit.quantities, self.fit.values, self.system.training)

    @cached_property
    def held(self) -> tuple[str, ...]:
        """Parameters that are a part of the law, and held as declared."""
        return tuple(sorted(_part_of_law(self.system.formulas, self.along, self.system.held)))

    @cached_property
    def course(self) -> tuple[Array, Array, Array]:
        """Where (k, 1 or 2) it is reported; the force (k,) there beyond the declared equations, and its sigma (k,)."""
        law, fitted, own = self.along, self.fit, self.candidate.quantities
        visited, k = _visited(self.system, law.variables, fitted.values), len(law.variables) - 1
        at = np.linspace(visited.min(axis=0), visited.max(axis=0), POINTS[0])
        if k:
            at = visited[np.linspace(0, len(visited) - 1, POINTS[1]).astype(int)]
        names = [*(q.name for q in own), *self.held]
        force, columns = _course(self.system, law, names, fitted.values, at)
        variance = np.einsum("ij,jk,ik->i", columns, fitted.amounts(names)[1], columns)
        # waves finer than those that are fitted go on as the inverse square of their number
        finer = (HARMONICS[0] / 6.0, np.pi / 16.0 * HARMONICS[1] ** 2)[k] * min(q.prior_sigma for q in own) ** 2
        scale = max(self.noise, fitted.reduced_chi_square)
        return at, force, np.sqrt(scale * np.maximum(variance, 0.0) + self.noise * finer)

    @property
    def variable(self) -> Array:
        """(k,) from the smallest to the largest value visited; of two variables (k, 2) along the motion."""
        return self.course[0] if len(self.along.variables) > 1 else self.course[0][:, 0]

    @property
    def force(self) -> Array:
        """(k,) beyond the declared equations."""
        return self.course[1]

    @property
    def sigma(self) -> Array:
        """(k,) of the force."""
        return self.course[2]

    def is_named(self, diagnosis: Diagnosis) -> bool:
        """Is this the law that describes the data best, or comes nearest, together with all that is found?"""
        stays = {f.candidate.name for f in diagnosis.found} <= {c.name for c in self.known}
        return self.is_shorter and (self.at_noise or stays)

    @property
    def is_shorter(self) -> bool:
        """Than the known terms that come nearest? Of two that the data do not tell apart, what is known is named."""
        return self.length < self.instead.length - CLASS_GAIN

    def document(self) -> dict[str, Any]:
        """Its course in JSON's types, with the names of what describes the data too."""
        return {
            "equation": self.along.equation,
            "variable": self.along.variable,
            "jumps_with_its_sign": self.along.jumps,
            "beyond": list(self.held),
            "beside": [c.name for c in self.known],
            "at": self.variable,
            "force": self.force,
            "sigma": self.sigma,
            "at_noise": self.at_noise,
            "minus_2_log_evidence": self.length,
            "cannot_be_told_from": [{"equation": a.equation, "variable": a.variable} for a in self.alike],
            "known_terms": [c.name for c in self.instead.candidates],
            "minus_2_log_evidence_of_known_terms": self.instead.length,
        }

    def text(self, units: Mapping[str, str]) -> str:
        """Its course at five places: over the range of one variable, or from the least to the largest by two."""
        places = self.variable.reshape(len(self.force), -1)
        order = np.argsort(self.force) if places.shape[1] > 1 else np.arange(len(places))
        told = []
        for i in order[np.linspace(0, len(order) - 1, 5).round().astype(int)]:
            place = zip(places[i], self.along.units(units), strict=True)
            where = ", ".join(f"{x:.3g} {unit if unit != '1' else ''}".rstrip() for x, unit in place)
            told.append(f"{self.force[i]:.3g}({self.sigma[i]:.2g}) at {where}")
        held = f", beyond {' and '.join(self.held)} as declared" if self.held else ""
        return f"{self.along.title} [{NAME}{held}]: {'; '.join(told)}"


def learn(
    system: EquationSystem, diagnosis: Diagnosis, channels: Mapping[str, Formula], judged: System | None = None
) -> LearnedForce | None:
    """The law with which the data are most probable, beside known terms, or of two variables, where it takes them.

    channels : formulas of what is observed, without terms
    judged : the system with its noise as judged, if that remembers
    Where none describes the data, the one that comes nearest, beside known terms. None where no law describes most of
    what is missing, where one known term describes it, or where there are too many runs.
    """
    if diagnosis.held_out_before is None or (diagnosis.verdict != "unexplained" and len(diagnosis.found) < 2):
        return None
    if len(system.stretches) * len(system.formulas.states) > MOST_STATES:  # more than are fitted side by side
        return None
    one, law, tells = _Competition(1, _knowing(system, channels, 1), diagnosis, judged), None, False
    several = diagnosis.verdict == "unexplained" or len(diagnosis.found) > 2
    for variables, beside_known in ((1, False), (1, True), (2, False))[: 3 if several else 1]:
        if law is not None and tells and law.at_noise:
            break
        over = one if variables == 1 else _Competition(2, _knowing(system, channels, 2), diagnosis, judged)
        for beside in [(c,) for c in over.beside()] if beside_known else [()]:
            trial = over.best(beside) if system.budget.open() else None
            if trial is not None and (law is None or trial.length < law.length):
                law, tells = trial, over.is_worth_telling(trial)
    return law if tells else _nearest(one.system, diagnosis, judged)


def _nearest(system: EquationSystem, diagnosis: Diagnosis, judged: System | None) -> LearnedForce | None:
    """The law that comes nearest beside the known terms that do, at the noise that these leave; it is no finding.

    No law of a real system comes as near as good sensors see. None where known terms do not lead near the data.
    """
    known, d = diagnosis.ranked[0], diagnosis
    noise = max(d.noise, known.fit.reduced_chi_square)
    near = known.candidates and d.before.reduced_chi_square > FAR * noise
    if d.verdict != "unexplained" or not near:
        return None
    view = system if judged is None else judged.over(system)
    before = held_out(view, known.fit.quantities, known.fit.values, system.training)
    known = replace(known, length=length(view, d.settings, noise, known.fit, known.candidates))
    left = replace(d, noise=noise, before=known.fit, held_out_before=before, ranked=(known,))
    over = _Competition(1, system, left, judged)
    law = over.best(known.candidates)
    if law is None or law.along.of_time:
        return None
    foretells = law.held_out.chi_square < before.chi_square  # itself, and not by being open
    return replace(law, at_noise=False) if foretells and law.is_shorter and over.is_worth_telling(law) else None


class _Competition:
    """Laws among each other and with the known terms that were found, by the evidence of the same samples."""

    def __init__(self, variables: int, system: EquationSystem, diagnosis: Diagnosis, judged: System | None) -> None:
        self.system, self.diagnosis, self.noise = system, diagnosis, diagnosis.noise
        self._judged = judged
        base = diagnosis.before
        self.declared = {q.name: q.null for q in system.base if not q.is_initial}
        self.begin = dict(base.values)
        chi_square = float(np.sum(system.linearise(self.begin, [])[0] ** 2))
        self.far = not chi_square < FAR * self.noise * max(float(np.sum(system.weights)), 1.0)
        self.laws = tuple(_laws(system, self.begin, variables))
        self.looked = 2.0 * float(np.log(max(len(self.laws), 1)))
        self.shots = cut_short(system) if self.far else [system]
        self.instead = next((e for e in diagnosis.ranked if e.candidates), Explanation((), base))

    def view(self, system: EquationSystem) -> System:
        """With the noise as judged, where the samples are those that were judged."""
        return system if self._judged is None else self._judged.over(system)

    def arrived(self, fitted: Fit) -> bool:
        """Could further steps gain no more than nothing? Along what only the prior holds, they go on for ever."""
        return fitted.converged or fitted.promised < CLASS_GAIN * self.noise

    def at_noise(self, fitted: Fit) -> bool:
        """As the search has it."""
        return self.arrived(fitted) and is_noise(fitted, self.diagnosis.settings, self.noise)

    def beside(self) -> list[Candidate]:
        """Known terms that may act with a law: those of the shortest explanations."""
        named = dict.fromkeys(c.name for e in self.diagnosis.ranked for c in e.candidates)
        own = {c.name: c for c in self.system.candidates}
        return [own[name] for name in named if name in own][:WIDTH]

    def is_worth_telling(self, law: LearnedForce) -> bool:
        """Does it describe the data, or nearly all of what is missing, and samples that it has not seen as well?

        As known terms are asked: where it is not noise that is left, they must leave more, and foretell less.
        """
        d = self.diagnosis
        if not self.arrived(law.fit) or d.held_out_before is None:
            return False
        if not law.held_out.gain_over(d.held_out_before, self.noise) > CLASS_GAIN:
            return False
        most = d.settings.unexplained_share * d.before.excess(self.noise)
        foretells = d.held_out_after is None or law.held_out.chi_square < d.held_out_after.chi_square
        return law.at_noise or (law.is_shorter and foretells and law.fit.excess(self.noise) < most)

    def best(self, beside: tuple[Candidate, ...]) -> LearnedForce | None:
        """The law that makes the data most probable beside these terms."""
        first = self.shots[0]
        values = self.begin
        if self.far:
            values = self.begin | self.declared | guessed(first)[0]
            values = fit(first, [near_declared(q) for q in first.base], values, TRIAL).values
        scans = []
        for law in self.laws:
            there, numbers = _set(first, law, values)
            length, quantities = self._evidence(there, law, beside, {**values, **numbers})
            if np.isfinite(length):
                scans.append((length, law, quantities))
        scans.sort(key=lambda scan: scan[0])
        if not scans:
            return None
        trials = []
        for length, law, quantities in scans[:REFITTED]:
            # along stretches that the declared equations do not follow the first order says little
            enough = ROUGHLY * scans[0][0] + WORTH if self.far else scans[0][0] + CLASS_GAIN
            if length > enough or not self.system.budget.open():
                break
            with suppress(GivenUp), self.system.budget.trial(self.system.trial_steps):
                if (trial := self._led(law, beside, quantities, values)) is not None:
                    trials.append(trial)
        if not trials:
            return None
        near = alike([trial for trial in trials if self.arrived(trial.fit)] or trials)
        # a function of time describes any motion: one of the motion itself says more, and is tried by every other run
        best = min(near, key=lambda trial: trial.along.of_time)
        others = (Along(t.along.equation, t.along.variables) for t in near if t.along.title != best.along.title)
        return replace(best, alike=tuple(dict.fromkeys(others)))

    def _others(self, system: EquationSystem, beside: Sequence[Candidate]) -> tuple[Quantity, ...]:
        return (*system.base, *(q for c in beside for q in c.quantities))

    def _evidence(
        self, system: EquationSystem, law: Along, beside: Sequence[Candidate], values: Values
    ) -> tuple[float, tuple[Quantity, ...]]:
        """-2 log evidence to first order, and the law's quantities with the priors that bring it."""
        others, own = self._others(system, beside), _amplitudes(system, law)
        values = {q.name: q.null for q in (*others, *own)} | dict(values)
        view = self.view(system) if len(system.stretches) == len(self.system.stretches) else system
        linear = Linearisation(view, no_fit(others, values), [_candidate(law, own)])
        columns = linear.columns([q.name for q in own])
        # the residual as it would be without the law
        right = linear.cleared(linear.right + columns @ np.array([values[q.name] for q in own]))
        columns = linear.cleared(columns)
        if not (np.isfinite(columns).all() and np.isfinite(right).all()):
            return np.inf, own
        size, root, found = sizes_alike(system, values).get(own[0].name, 1.0), np.sqrt(self.noise), []
        basis = _basis(len(law.variables))
        waves = np.array([basis[q.part][1] for q in own])
        for smooth, fall in product(SMOOTH, FALLS):
            falls = (1.0 + (waves / smooth) ** 2) ** -fall  # prior sigma of each amplitude over that of the first
            # the faster driver gives up where columns are alike
            U, singular, _ = linalg.svd(columns * falls, full_matrices=False, lapack_driver="gesvd")
            lengths = evidence(size * singular / root, U.T @ right / root, SIZES)
            # columns of nothing: no size can be told from them
            if not (np.isfinite(lengths).all() and np.isfinite(right @ right / self.noise)):
                return np.inf, own
            found.append((float(lengths.min()), SIZES[int(np.argmin(lengths))] * size * falls))
        shortest = min(length for length, _ in found)
        # of those that the data do not refute the roughest: what it leaves open is not called known for being smooth
        plausible = [prior for length, prior in found if length < shortest + PLAUSIBLE]
        prior = max(plausible, key=lambda prior: float(prior[np.argmax(waves)])) / root
        quantities = zip(own, prior.tolist(), strict=True)  # of chi-squares that are not yet in units of the noise
        return shortest + float(right @ right) / self.noise + self.looked, tuple(
            replace(q, prior_sigma=sigma, scale=1e-3 * sigma) for q, sigma in quantities
        )

    def _led(
        self, law: Along, beside: tuple[Candidate, ...], own: tuple[Quantity, ...], values: Values
    ) -> LearnedForce | None:
        """The law's fit to stretches that are joined two by two; None where it loses the data."""
        first, numbers = _set(self.shots[0], law, values)
        now, evident = dict(values) | {q.name: 0.0 for q in own} | numbers, np.inf
        for system, longer in zip(self.shots, [*self.shots[1:], None], strict=True):
            there = replace(system, widths=first.widths)
            others, view = self._others(there, beside), there if longer else self.view(there)
            for _ in range(1 if longer else ROUNDS):
                fitted = self._fitted(view, (*others, *own), now)
                if not fitted.reduced_chi_square < FAR * self.noise:  # joined, it leaves more
                    return None
                before, now = evident, dict(fitted.values)
                evident, own = self._evidence(there, law, beside, now)
                if abs(before - evident) < 1.0:
                    break

        fitted = self._fitted(view, (*others, *own), now)
        # known numbers and terms are priced as where no law is; of the law, the evidence has paid
        prices = length(view, self.diagnosis.settings, self.noise, fitted, beside) - fitted.cost / self.noise
        known = _set(self.system, law, fitted.values)[0]
        return LearnedForce(
            (*beside, _candidate(law, own)), fitted, length=evident + prices, along=law, instead=self.instead,
            at_noise=self.at_noise(fitted), noise=self.noise, system=known, judged=self.view(known),
        )  # fmt: skip

    def _fitted(self, system: System, quantities: Sequence[Quantity], values: Values) -> Fit:
        """The fit; where its steps have to be halved again and again, with a region of trust for each number.

        Amplitudes that the data hardly show may go far to first order, and shift the phase in second.
        """
        found = fit(system, quantities, values, TRIAL)
        # were the rest of the way linear
        ahead = (found.chi_square - found.promised) / max(found.degrees_of_freedom, 1)
        if self.arrived(found) or not ahead < FAR * self.noise:
            return found
        return fit(system, quantities, trusted(system, quantities, found.values), TRIAL)


def _laws(system: EquationSystem, values: Values, n: int) -> Iterator[Along]:
    """Every law of n variables that is looked for: in every equation of a force, along states, inputs, or time alone.

    In a large system, along what stands in that equation already, and time.
    """
    equations = system.formulas.equations
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
            if n == 1 and variables[0] in {equation, *velocities}:
                yield Along(equation, variables, fine=True)
                if np.sum(np.diff(np.sign(_visited(system, variables, values)[:, 0])) != 0) >= TURNING:
                    yield Along(equation, variables, jumps=True)


def _forced(equations: Equations) -> list[str]:
    """States whose equations are more than a definition (x' = v)."""
    return [s for s, f in equations.rates.items() if str(f).strip() not in equations.rates]


def _knowing(system: EquationSystem, channels: Mapping[str, Formula], n: int) -> EquationSystem:
    """The same system with a law of n variables as one more term; where it acts, and along what, is said by numbers."""
    f = system.formulas
    e = f.equations
    words = {"sign": "sign"}
    constants = {f"{NAME}_on_{s}": 0.0 for s in _forced(e)}
    for i in range(n):
        own = f"{NAME}_{i}"
        words[f"x{i}"] = "(" + " + ".join(f"{own}_of_{name}*{name}" for name in (*e.states, *e.inputs, "t")) + ")"
        words[f"r{i}"] = f"{own}_reach"
        words[f"p{i}"] = f"({own}_bend*asinh({words[f'x{i}']}/{own}_bend) - {own}_from)/{own}_span"
        constants |= dict.fromkeys([f"{own}_of_{name}" for name in (*e.states, *e.inputs, "t")] + [f"{own}_from"], 0.0)
        constants |= dict.fromkeys([f"{own}_span", f"{own}_reach", f"{own}_bend"], 1.0)
    course = " + ".join(f"own_{name}*{formula.format(**words)}" for name, (formula, _) in _basis(n).items())
    term = Term(
        NAME, {s: f"{NAME}_on_{s}*({course})" for s in _forced(e)},
        parameters={name: Parameter(0.0) for name in _basis(n)}, title="a force that no term names",
    )  # fmt: skip
    known = Formulas(replace(e, constants={**e.constants, **constants}), (*f.terms, term), channels)
    widths = {known.widths[a].name: system.widths[w.name] for a, w in f.widths.items() if a in known.widths}
    new = {w.name: 1.0 for w in known.widths.values() if w.name not in widths}
    return replace(system, formulas=known, widths=widths | new)


def _basis(n: int) -> dict[str, tuple[str, float]]:
    """Of a law of n variables, by amplitude: what it multiplies, by places {p} over the range and variables {x}.

    With it the wave number.
    """
    most = HARMONICS[n - 1]
    found = {}
    for waves in product(range(most + 1), repeat=n):
        cosines = [f"cos({k}*pi*{{p{i}}})" for i, k in enumerate(waves) if k]
        if (number := float(np.linalg.norm(waves))) <= most:
            found["a" + "_".join(map(str, waves))] = "*".join(cosines) or "1", number
    found |= {f"slope{i or ''}": (f"{{x{i}}}/{{r{i}}}", 0.0) for i in range(n)}
    return found if n > 1 else found | {"jump": ("sign({x0})", 0.0)}


def _candidate(law: Along, own: tuple[Quantity, ...]) -> Candidate:
    return Candidate(NAME, NAME, "motion", law.title, "learned from what is left", own)


def _amplitudes(system: EquationSystem, law: Along) -> tuple[Quantity, ...]:
    """Of the law, without priors as yet."""
    own = (q for c in system.candidates if c.name == NAME for q in c.quantities)
    return tuple(q for q in own if law.jumps or q.part != "jump")


def _set(system: EquationSystem, law: Along, values: Values) -> tuple[EquationSystem, dict[str, float]]:
    """The system for one law, and the numbers that say where it acts and over which range."""
    numbers = {n: 0.0 for n in system.formulas.constants if n.startswith(f"{NAME}_")}
    numbers[f"{NAME}_on_{law.equation}"] = 1.0
    visited = _visited(system, law.variables, values)
    for i, (variable, x) in enumerate(zip(law.variables, visited.T, strict=True)):
        reach = max(float(np.abs(x).max()), 1e-12)
        bend = reach * (FINE if law.fine else STRAIGHT)
        low, high = (float(bend * np.arcsinh(end / bend)) for end in (x.min(), x.max()))
        span = max(high - low, 1e-12 * reach)
        own = {f"of_{variable}": 1.0, "from": low - MARGIN * span, "span": (1 + 2 * MARGIN) * span}
        own |= {"reach": reach, "bend": bend}
        numbers |= {f"{NAME}_{i}_{n}": x for n, x in own.items()}
    of = f"{NAME}_0_of_"
    mine = [w.name for a, w in system.formulas.widths.items() if any(s.name.startswith(of) for s in a.free_symbols)]
    size = float(np.sqrt(np.mean(visited[:, 0] ** 2)))
    return replace(system, widths=system.widths | {w: 1e-3 * (size or 1.0) for w in mine}), numbers


def _visited(system: EquationSystem, variables: Sequence[str], values: Values) -> Array:
    """States, inputs or time (n, k) at the samples of all stretches, one after the other."""
    e, found = system.formulas.equations, [np.zeros((0, len(variables)))]
    for s, motion in zip(system.stretches, system.predictions(values), strict=True):
        states = dict(zip(e.states, motion.states.T if motion else [], strict=False))
        known = {"t": s.time, **dict(zip(e.inputs, system.inputs_of(s), strict=False)), **states}
        if known.keys() >= {*variables}:
            found.append(np.stack([known[name] for name in variables], axis=1))
    everything = np.concatenate(found)
    return everything if len(everything) else np.tile([[-1.0], [1.0]], len(variables))


def _part_of_law(f: Formulas, law: Along, held: Sequence[str]) -> set[str]:
    """Parameters that act in the law's equation as a function of its variable alone, and nowhere else."""
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
    """What these numbers make at places (n, k), beyond their declared values, where the law acts; and each of them."""
    f, s = system.formulas, system.stretches[0]
    states = np.tile(system.start_of(values, s), (len(at), 1))
    times = at[:, 0] if law.of_time else np.asarray(np.arange(len(at)) + 0.5, float)
    pieces = np.zeros((len(s.pieces), 5, len(at)))
    for variable, x in zip(law.variables, at.T, strict=True):
        if variable in f.equations.states:
            states[:, f.equations.states.index(variable)] = x
        elif variable in f.equations.inputs:
            pieces[list(f.equations.inputs).index(variable), 3] = x
            s = replace(s, knots=np.arange(len(at) + 1.0), pieces=pieces)
    declared = {name: f.declared[name].value for name in names}
    here = f.equations.states.index(law.equation)
    (now, _, by_number), (before, *_) = (
        f.rates_at(s, system.numbers({**values, **changed}, s), times, states) for changed in ({}, declared)
    )
    acting = by_number[:, here, f.names.index(names[0])]  # of the constant
    own = by_number[:, here, [f.names.index(name) for name in names]]
    return (now - before)[:, here] / acting, own / acting[:, None]


def with_law(diagnosis: Diagnosis, law: LearnedForce) -> Diagnosis:
    """The answer with the law in place of known terms, and with those that act beside it.

    Where more than noise is left, it is the nearest description, and what was found stays; of a function of time alone,
    which any motion has, nothing does.
    """
    level = f"{law.fit.reduced_chi_square:.3g} per degree of freedom at a noise of {diagnosis.noise:.3g}"
    at_first = f"{diagnosis.before.reduced_chi_square:.3g}"
    reason = f"chi-square stays at {at_first}, with a law that was learned at {level}"
    if not law.at_noise:
        return replace(diagnosis, reason=reason, nearest=replace(law, fit=with_memory(law.system, law.fit)))
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
    found = [Found(c, gain, held_gain, 0.0, ()) for c in law.candidates]
    answer = replace(
        nothing, verdict="found", reason=f"with a law that no term names, chi-square falls to {level}",
        found=tuple(found[:-1]), after=law.fit, held_out_after=law.held_out, nearest=None,
    )  # fmt: skip
    return with_found(answer, found[-1:])
