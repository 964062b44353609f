"""The result of a diagnosis of equations: in words, in numbers, as JSON and as a page."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from calibration.kit.types import Array
from disctrack.discrepancy.document import document, effect_text, tables
from disctrack.discrepancy.elimination import prior_rows
from disctrack.discrepancy.equations import shooting
from disctrack.discrepancy.equations.declared import Equations, Run, Samples, checked
from disctrack.discrepancy.equations.extent import Extent
from disctrack.discrepancy.equations.law import NAME, LearnedForce
from disctrack.discrepancy.equations.system import EquationSystem, fitted_rows
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.held_out import HeldOut
from disctrack.discrepancy.noise import OUTLIER, outlier_limit
from disctrack.discrepancy.search import Diagnosis, Verdict
from disctrack.discrepancy.shape import leaves_most
from disctrack.discrepancy.significance import TWO_SIDED, whiteness
from disctrack.discrepancy.system import Candidate, System
from disctrack.files.json_text import json_file, plain
from disctrack.files.whole import refuse_existing, write_whole
from disctrack.findings import Kind, Severity, of_kind
from disctrack.numbers import in_unit, probability, rounded
from disctrack.report.blocks import Drawn, Figures, Listing, Report, Section
from disctrack.report.terminal import full

FEW = 0.02  # share of the samples, above which outliers are the noise
ODD = 2.0  # rms over the median of all runs, above which one is odd
FAR_OFF = 10.0  # sigmas, or factor, by which a fitted parameter differs from its declared value
OF_SIZE = 1e4  # prior sigma of an initial state over its scale: ten times its size


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of a model in one channel, in its own unit."""

    rms: float  # of the residuals of all samples
    held_out: float  # rms prediction error of the held-out samples
    noise: float  # sigma of the noise, estimated from the residuals


@dataclass(frozen=True)
class Forecast:
    """Predicted sensor values at the instants of a run, by channel; NaN where the motion cannot be integrated."""

    time: Array  # (n,) [s] since the first sample
    values: Mapping[str, Array]  # (n,)
    sigmas: Mapping[str, Array]  # (n,) of a sample: by parameters, initial state, and residuals of the fit

    def __getitem__(self, channel: str) -> Array:
        """Values of a channel (n,)."""
        return self.values[channel]


@dataclass(frozen=True)
class RunScore:
    """How well a free run predicts one channel."""

    rms: float  # of measured minus predicted, in the channel's unit
    covered: float  # share of the samples within the 95 % band
    n_samples: int


@dataclass(frozen=True)
class Answer:
    """Missing terms, with sizes and significance."""

    equations: Equations
    diagnosis: Diagnosis  # result of the search
    system: EquationSystem  # data and model, in the stretches that were fitted
    judged: System  # the same with its noise as estimated
    autocorrelated: bool  # is that noise autocorrelated?
    remarks: tuple[str, ...]  # of the search
    law: LearnedForce | None  # a learned law; None where none describes the data
    holds: Extent | None  # of a single run that nothing explains: the parts in which the equations hold

    @property
    def verdict(self) -> Verdict:
        """`nothing missing`, `found` or `unexplained`."""
        return self.diagnosis.verdict

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the data and on what they do not determine."""
        about = chain(self._nearest_notes(), self._law_notes(), self._departure_notes(), self._whiteness_notes())
        return (*self.remarks, *about, *self._odd_run_notes(), *self._outlier_notes())

    def _law_notes(self) -> Iterator[str]:
        """Alternatives to the learned law, where it is reported; else the law as an alternative."""
        law = self.law
        if law is None:
            return
        known = " and ".join(c.name for c in law.instead.candidates)
        longer = f"{law.length - law.instead.length:+.3g} in -2 log evidence"
        text = law.text(self.equations.units)
        nearest = self.diagnosis.nearest
        named = law.candidate.name in {*self.found, *(nearest.effects if nearest else ())}
        if not law.is_shorter:
            yield f"one law describes the data in place of {known} ({longer}): {text}"
        elif not named:
            yield f"one law comes nearer to the data than {known}, but its residuals are not noise: {text}"
        elif known:
            yield f"of known terms {known} come nearest (the law: {longer})"
        if law.held and named:
            yield f"without the law these numbers have no meaning: {', '.join(law.held)}"
        if law.along.of_time:
            yield "a force that depends on time alone describes any motion, and is never what is missing"
        if law.equivalent:
            others = " or ".join(a.title for a in law.equivalent)
            yield f"these data do not distinguish the law from {others}"

    def _nearest_notes(self) -> Iterator[str]:
        """Where no term is found: those that gain most, and their residuals."""
        nearest, helpful, d = self.diagnosis.nearest, list[str](), self.diagnosis
        if nearest is None or leaves_most(nearest.fit.excess(d.noise), d.before.excess(d.noise)):
            return  # what leaves most of it describes nothing
        for c in nearest.candidates:
            numbers = ((q.part, self.nearest.get(q.name, q.null)) for q in (*c.quantities, *c.shape))
            sizes = ", ".join(f"{name} = {value:.4g}" for name, value in numbers)
            helpful.append(self._law_text(c) or f"{c.title} [{c.name}] ({sizes})")
        left = self._errors(nearest.fit, None)
        sizes = ", ".join(f"{e.rms:.3g} of {self.before[c].rms:.3g} {self._of(c)}" for c, e in left.items())
        yield f"{' and '.join(helpful)} would help most and still leave {sizes}"

    def _departure_notes(self) -> Iterator[str]:
        """Fitted parameters far from their declared values, as by a wrong sign or unit."""
        fitted, in_law = self.diagnosis.after, self.law.held if self.law else ()
        for q in fitted.quantities:
            value, declared = fitted.values[q.name], q.null if np.isfinite(q.prior_sigma) else q.declared
            if declared is None or q.owner == NAME or q.name in in_law:
                continue
            text = f"{q.name.removeprefix('state.')} = {value:.4g} where {declared:.4g} was declared"
            if (away := abs(value - declared) / q.prior_sigma) > FAR_OFF:
                yield f"{text}: {away:.0f} of its sigmas off"
            elif declared * value < 0 and abs(value) > FAR_OFF * self.sigmas[q.name]:
                yield f"{text}: its sign is another; check the signs of the equations"
            elif abs(value) > FAR_OFF * abs(declared) > 0 or abs(declared) > FAR_OFF * abs(value) > 0:
                yield f"{text}: another order of magnitude; check the units"

    def _law_text(self, c: Candidate) -> str:
        """The course of the learned law, if this is its candidate; else empty."""
        return self.law.text(self.equations.units) if self.law and c.name == self.law.candidate.name else ""

    @property
    def nearest(self) -> dict[str, float]:
        """All fitted parameters with the terms that help most, where their residuals are too large; else empty."""
        nearest = self.diagnosis.nearest
        return {n: nearest.fit.values[n] for n in nearest.fit.names} if nearest else {}

    def _whiteness_notes(self) -> Iterator[str]:
        """Residuals that are as small as noise, but not white."""
        if self.verdict != "unexplained" and self.whiteness < self.diagnosis.settings.false_alarm:
            yield (
                f"residuals are as small as the noise but autocorrelated (white noise: p = {self.whiteness:.1g}): "
                "something smaller is missing, too, or the noise changes with time"
            )

    def _odd_run_notes(self) -> Iterator[str]:
        """Runs with much larger residuals than the others."""
        stretches = self.system.stretches
        if any(s.stretch for s in stretches) or self.diagnosis.held_out_before is None:
            return
        residual, _ = self.judged.linearise(self.diagnosis.after.values, [])
        count = np.array([max(float(np.sum(self.judged.weights[rows])), 1.0) for rows in self.system.blocks])
        left = np.array([float(np.sum(residual[rows] ** 2)) for rows in self.system.blocks]) / count
        level = float(np.median(left))
        by_noise = stats.chi2.isf(self.diagnosis.settings.false_alarm / len(left), count) / count
        odd = np.flatnonzero(left > level * np.maximum(ODD**2, by_noise))
        worst = [f"{stretches[i].name} ({np.sqrt(left[i] / level):.3g} times)" for i in odd[np.argsort(-left[odd])]]
        if worst:
            some = ", ".join(worst[:4]) + (", ..." if len(worst) > 4 else "")
            yield f"residuals are far larger than in the other runs in {some}: look at what was different there"

    def _outlier_notes(self) -> Iterator[str]:
        """Single outliers, which make noise and sigmas too large."""
        d = self.diagnosis
        predicted = self.predicted(d.nearest.fit if d.nearest else d.after)
        for c, channel in enumerate(self.system.formulas.channels):
            left = [np.abs(s.data[:, c] - seen[:, c]) for s, seen in predicted]
            limit = outlier_limit(np.concatenate(left))
            off = [(s.run, float(t)) for (s, _), r in zip(predicted, left, strict=True) for t in s.time[r > limit]]
            if limit > 0 and 0 < len(off) < FEW * sum(np.isfinite(r).sum() for r in left):
                some = ", ".join(f"{run} at {t:.4g} s" for run, t in off[:4]) + (", ..." if len(off) > 4 else "")
                lie = "1 sample lies" if len(off) == 1 else f"{len(off)} samples lie"
                yield (
                    f"{lie} farther off in {channel} than {OUTLIER:.0f} times the scatter of the others ({some}): "
                    "if the sensor erred there, write NaN; if not, more is missing there"
                )

    @property
    def found(self) -> tuple[str, ...]:
        """Names of the missing terms."""
        return tuple(f.candidate.name for f in self.diagnosis.found)

    @property
    def values(self) -> dict[str, float]:
        """All fitted parameters of the extended model."""
        return {name: self.diagnosis.after.values[name] for name in self.diagnosis.after.names}

    @property
    def sigmas(self) -> dict[str, float]:
        """Their standard deviations."""
        return {name: self.diagnosis.after.sigma(name) for name in self.diagnosis.after.names}

    @cached_property
    def before(self) -> dict[str, ChannelErrors]:
        """Errors by channel of the equations as declared (and fitted)."""
        return self._errors(self.diagnosis.before, self.diagnosis.held_out_before)

    @cached_property
    def after(self) -> dict[str, ChannelErrors]:
        """Errors by channel with what was found."""
        return self._errors(self.diagnosis.after, self.diagnosis.held_out_after)

    def predicted(self, fit: Fit) -> list[tuple[Samples, Array]]:
        """Every stretch with its predicted sensor values (n, w); NaN where the motion cannot be integrated."""
        found = self.system.predictions(fit.values)
        return [(s, np.full(s.data.shape, np.nan) if p is None else p.seen) for s, p in found]

    def forecast(self, run: Run, *, window: float = 0.0, by: str = "after") -> Forecast:
        """A free run of the model: predicted sensor values at the instants of a run, with sigmas.

        A run of the same name as a fitted one starts from that one's fitted state, and may be longer; another starts
        from its `start` and `known`. Its data are not used, except the names of their channels.
        window : [s] from the first sample: the initial state is fitted to these data only
        by : "after": with what was found, or else with the terms that help most; "before": the equations as declared
        (and fitted)
        """
        d = self.diagnosis
        fitted, errors = (d.before, self.before) if by == "before" else (d.after, self.after)
        if by == "after" and d.nearest is not None:
            fitted, errors = d.nearest.fit, self._errors(d.nearest.fit, None)
        of_noise = d.verdict != "unexplained" and by != "before"
        left = [e.noise if of_noise else np.nanmax([e.noise, e.rms, e.held_out]) for e in errors.values()]
        return free_run(self.system, fitted, self._checked(run), np.array(left), window)

    def score(self, run: Run, *, window: float = 0.0, by: str = "after") -> dict[str, RunScore]:
        """By channel, how well a free run (`forecast`) predicts the samples of a run after the window."""
        found, samples = self.forecast(run, window=window, by=by), self._checked(run)
        scores = {}
        for c, name in enumerate(self.system.formulas.channels):
            rows = np.isfinite(samples.data[:, c]) & (samples.time > window)
            left = (samples.data[:, c] - found[name])[rows]
            within = np.abs(left) <= TWO_SIDED * found.sigmas[name][rows]
            scores[name] = RunScore(float(np.sqrt(np.mean(left**2))), float(np.mean(within)), int(rows.sum()))
        return scores

    def _checked(self, run: Run) -> Samples:
        (samples,) = checked(self.equations, [run])
        first = self.system.stretches[0]
        return samples if run.name else replace(samples, run=first.run, groups=first.groups)

    def _errors(self, fit: Fit, held: HeldOut | None) -> dict[str, ChannelErrors]:
        names = self.system.formulas.channels
        rms = _rms(np.concatenate([s.data - seen for s, seen in self.predicted(fit)]))
        ahead = np.full(len(names), np.nan)
        if held is not None:
            free = [(s.data - seen)[~fitted_rows(s)] for s, seen in self.predicted(held.train)]
            ahead = _rms(np.concatenate(free))
        noise = _rms(np.concatenate([s.sigma for s in self.system.stretches]))
        if not self.autocorrelated:  # as estimated from the residuals, which contain less of the motion than the data
            noise = noise * np.sqrt(self.diagnosis.noise)
        both = zip(names, rms, ahead, noise, strict=True)
        return {name: ChannelErrors(float(r), float(a), float(n)) for name, r, a, n in both}

    @cached_property
    def whiteness(self) -> float:
        """Probability of such an autocorrelation in white noise (Ljung-Box, smallest of all channels and stretches)."""
        residual, _ = self.judged.linearise(self.diagnosis.after.values, [])
        present, channels = self.system.present, range(residual.shape[1])
        series = (residual[rows, c][present[rows, c]] for rows in self.system.blocks for c in channels)
        p_values = [whiteness(x[:, None], 1.0, {}).p_value for x in series if len(x) > 3]
        return min(1.0, min(p_values) * len(p_values)) if p_values else float("nan")

    @property
    def sentence(self) -> str:
        """The result in words."""
        d = self.diagnosis
        if d.held_out_before is None:
            loose = [n for n, v in self.values.items() if "." not in n and not self.sigmas[n] < abs(v)]
            open_ = f" {', '.join(loose)} cannot be determined: declare a value or bounds." if loose else ""
            return f"No answer: {d.reason}.{open_} Initial values nearer to the truth may help."
        level = ", ".join(map(self._left, self.after))
        if d.verdict == "nothing missing":
            return f"Nothing is missing: the equations leave {level}."
        effects = "; and ".join(self._law_text(f.candidate) or effect_text(f, d) for f in d.found)
        if d.verdict == "found":
            return f"Missing: {effects}. With {'it' if len(d.found) == 1 else 'them'} the equations leave {level}."
        where = f" {self.holds.text(self.equations.units)}" if self.holds else ""
        nearest = f"; the nearest is {effects}, which leaves" if effects else ": the equations leave"
        return f"Something is missing that no term describes{nearest} {level}.{where}"

    def _left(self, channel: str) -> str:
        """Size of the residuals; a motion that cannot be integrated to its end has none."""
        e = self.after[channel]
        if np.isnan(e.rms):
            return f"no motion of {channel} to its end"
        return f"{e.rms:.3g} {self._of(channel)} (noise {e.noise:.3g})"

    def _of(self, channel: str) -> str:
        unit = self.equations.units.get(channel, "1")
        return f"of {channel}" if unit == "1" else f"{unit} of {channel}"

    def __str__(self) -> str:
        """The answer, before and after, and remarks."""
        return "\n".join(full(self.report()))

    def report(self, drawn: Sequence[Drawn] = ()) -> Report:
        """The report, for every writer."""
        return Report(
            f"{self.equations.name}: what is missing?",
            f"Verdict: {self.verdict}. {self.sentence}",
            findings=of_kind(Kind.DIAGNOSIS, Severity.NOTE, (f"{note}." for note in self.notes)),
            blocks=[
                Section("Equations", [[f"d{k}/dt = {v}" for k, v in self.equations.rates.items()]]),
                Section("Before and after", [_before_after(self)]),
                Section("In pictures", [Figures(drawn)]),
                *tables(self.diagnosis),
            ],
        )

    def document(self) -> dict[str, Any]:
        """All of it in JSON's types; the keys are those that `disctrack diagnose` writes."""
        sides = [{"channels": errors} for errors in (self.before, self.after)]
        own = {
            "notes": list(self.notes),
            "equations": {k: str(v) for k, v in self.equations.rates.items()},
            "runs": [{"name": s.name, "samples": len(s.time)} for s in self.system.stretches],
            "whiteness_p_value": self.whiteness,
            "law": None if self.law is None else self.law.document(),
            "holds": self.holds,
        }
        return dict(plain(document(self.diagnosis, self.equations.name, self.sentence, *sides) | own))

    def write(self, folder: str | Path, overwrite: bool = False) -> tuple[Path, Path]:
        """Write diagnosis.json and diagnosis.html; returns both. Raises OutputError where one is there already."""
        from disctrack.discrepancy.equations.page import write_answer  # matplotlib is wanted on pages only

        paths = Path(folder) / "diagnosis.json", Path(folder) / "diagnosis.html"
        for path in paths:
            refuse_existing(path, overwrite)
        write_whole(paths[0], json_file(self.document()))
        write_answer(self, paths[1])
        return paths


def free_run(system: EquationSystem, fitted: Fit, samples: Samples, left: Array, window: float) -> Forecast:
    """Integrate the model with the fitted parameters.

    system : with formulas and sizes; its stretches are not used
    left : (w,) rms of the residuals of each channel
    window : [s] of the run to which its initial state is fitted; 0: it starts from the state of the fit or the run
    """
    alone = replace(system, stretches=[replace(samples, sigma=np.broadcast_to(left, samples.data.shape))])
    values, states = dict(fitted.values), [q for q in alone.base if q.is_initial]
    by_state = [q.name for q in states] if window > 0 else []
    numbers = [n for n in fitted.shared if n in alone.names_of(samples) and n not in by_state]
    covariance = fitted.amounts(numbers)[1]
    spread, follows = np.zeros((0, 0)), np.zeros((0, len(numbers)))
    if by_state:
        n = int(np.searchsorted(samples.time, window, side="right"))
        begin = replace(alone, stretches=[alone.stretches[0].part(0, n)])
        begun = shooting.initial_guess(begin)[0]
        loose = [
            replace(q, null=begun[q.name], prior_sigma=OF_SIZE * q.scale) if np.isinf(q.prior_sigma) else q
            for q in states
        ]
        start = fit(begin, loose, values | begun)
        values, spread = values | start.values, start.covariance
        residual, J = begin.linearise(values, [*by_state, *numbers])
        J = J.reshape(-1, J.shape[-1])
        # one more step: with a wide band the fit stops before the minimum
        prior, by_prior = prior_rows(loose, values)
        step = spread @ (J[:, : len(by_state)].T @ residual.ravel() + by_prior.T @ prior)
        values |= {name: values[name] + float(d) for name, d in zip(by_state, step, strict=True)}
        # with other numbers the fit of the initial state is another
        follows = -spread @ J[:, : len(by_state)].T @ J[:, len(by_state) :]
    found = alone.predict(values, alone.stretches[0], [*by_state, *numbers])
    seen = sigma = np.full(samples.data.shape, np.nan)
    if found is not None:
        of_start, of_numbers = np.split(found.derivative, [len(by_state)], axis=2)
        of_numbers = of_numbers + of_start @ follows
        variance = np.broadcast_to(left**2, seen.shape).copy()
        for J, C in ((of_start, spread), (of_numbers, covariance)):
            variance += np.einsum("nwi,ij,nwj->nw", J, C, J)
        seen, sigma = found.seen, np.sqrt(np.maximum(variance, 0.0))
    by_channel = [dict(zip(alone.formulas.channels, each.T, strict=True)) for each in (seen, sigma)]
    return Forecast(samples.time, *by_channel)


def _rms(values: Array) -> Array:
    """Root mean squares (w,) of the values (n, w) that are not NaN; NaN where all are."""
    return np.asarray(np.sqrt(np.ma.masked_invalid(values**2).mean(axis=0).filled(np.nan)), float)


def _before_after(answer: Answer) -> Listing:
    rows = []
    for c in answer.system.formulas.channels:
        b, a = answer.before[c], answer.after[c]
        unit = answer.equations.units.get(c, "1")
        rows.append((in_unit(f"rms of {c}", unit), *(rounded(x, 4) for x in (b.rms, a.rms, a.noise))))
        named = in_unit(f"prediction error of {c}, held out", unit)
        rows.append((named, rounded(b.held_out, 4), rounded(a.held_out, 4), ""))
    white = f"p {probability(answer.whiteness)}"
    rows.append(("Ljung-Box: probability of this autocorrelation in white noise", "", white, ""))
    return Listing(("", "before", "after", "noise"), rows)
