"""Experimental design: which further recording would answer the questions that this one leaves open?

The fitted model is simulated from other initial conditions, with the same cameras and noise, and linearised. Its Fisher
information on the shared quantities (laws, cameras, dots) is added to that of this recording; every recording has an
initial state of its own.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.least_squares import triangle
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.motion import state_of
from disctrack.diagnosis.stretch import MIN_FRAMES, MIN_THETA
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.joint.sharing import LAWS, Reduction
from disctrack.discrepancy.joint.together import Bound
from disctrack.discrepancy.score import Score, cleared, sigmas, span
from disctrack.discrepancy.search import Diagnosis
from disctrack.discrepancy.system import Candidate, Quantity, Values
from disctrack.errors import AnalysisError, DiscTrackError
from disctrack.frames import rotation_from_euler
from disctrack.rolling import simulate, steady_precession
from disctrack.trajectory import MarkerStatus, part

STARTS = tuple(product((3.0, 8.0, 15.0, 30.0), (0.5, 5.0), (0.5, 1.0)))  # nutation [deg], omega_3 [rad/s], duration [s]
CHANGES = {  # of a recording, by factors
    "mass": ("with a disc {:g} times as heavy", (0.35, 2.0)),
    "radius": ("with a disc {:g} times as large", (0.6, 1.6)),
    "pressure": ("in air at {:g} of the pressure", (0.1,)),
    "rate": ("at {:g} times the frame rate", (2.0,)),
    "numbers": ("with {:g} times the dots, or further views", (1.5, 2.0)),
}
NUTATION_SHARE = 0.05  # amplitude of the nutation oscillation over the nutation angle
OPEN = 6  # questions at most
ENOUGH = 5.0  # sigmas between two effects, from which a recording distinguishes them


@dataclass(frozen=True)
class Proposal:
    """A possible recording; factors are relative to this one."""

    theta_deg: float | None = None  # initial nutation; None: as in this recording
    omega3: float | None = None  # [rad/s] spin
    duration: float | None = None  # [s] at most: it ends where the disc comes to rest
    mass: float = 1.0  # of a disc of the same size, from another material
    radius: float = 1.0  # of a disc of the same material and thickness, with its dots
    pressure: float = 1.0  # of the air
    rate: float = 1.0  # of the frames
    numbers: float = 1.0  # of data in a frame: more dots, or another view

    @property
    def text(self) -> str:
        """The recording in words."""
        start = "start as here"
        if self.theta_deg is not None:
            start = f"start at {self.theta_deg:g} deg with omega_3 = {self.omega3:g} rad/s"
        changes = [f"film {self.duration:.2g} s"] if self.duration is not None else []
        factors = {name: getattr(self, name) for name in CHANGES}
        changes += [CHANGES[name][0].format(factor) for name, factor in factors.items() if factor != 1.0]
        return f"{start}, {', '.join(changes)}" if changes else f"{start}, the same again"


# An open question: which of two effects is present (the one found comes first), or how large a single one is
Question = tuple[Candidate, ...]


@dataclass(frozen=True)
class Proposed:
    """One proposal and its answer to each question."""

    proposal: Proposal
    duration: float  # [s] until the disc comes to rest, at most that of the proposal
    answers: tuple[float, ...]  # sigmas between effect and alternative; or the standard deviation of the effect's size


@dataclass(frozen=True)
class Plan:
    """Further recordings and their answers to the open questions."""

    questions: tuple[Question, ...]
    now: tuple[float, ...]  # the answers of this recording alone
    rows: tuple[Proposed, ...]

    def best(self, i: int) -> Proposed | None:
        """The proposal that answers question i best."""
        known = (r for r in self.rows if np.isfinite(r.answers[i]))
        more = 1 if len(self.questions[i]) > 1 else -1  # sigmas between two effects, and not those of a size
        return max(known, key=lambda r: more * r.answers[i], default=None)


# Information on quantities, all others marginalised: names (k,), and rows (m, k) whose R^T R is the Fisher information
Information = tuple[Sequence[str], Array]


class Planner:
    """Information of this recording on laws, cameras and dots, and with that of further recordings."""

    def __init__(
        self,
        system: DiscSystem,
        fit: Fit,
        questions: Sequence[Question],
        noise: float = 1.0,
        information: Information | None = None,
    ) -> None:
        """Fit : of the enlarged model.   questions : that `answer` is called with.

        noise : variance of the dots over that stated
        information : present information; by default that of this recording
        """
        self.system, self.fit, self._noise = system, fit, noise
        new = {q.name: q for question in questions for c in question for q in c.quantities}
        self.tested = tuple(new.values())
        fitted = [q for q in fit.quantities if not q.is_initial and q.name not in new]
        self._shared = [q for q in fitted if q.belongs_to]
        names = [q.name for q in (*self._shared, *self.tested)]
        spread = [q.prior_sigma for q in self._shared] + [np.inf] * len(self.tested)
        self._priors = np.diag(1.0 / np.array(spread))
        self.column = {name: j for j, name in enumerate(names)}
        self._base = [j for j, name in enumerate(names) if name not in new]
        if information is None:
            kept = [q for q in fit.quantities if q.name not in new]
            self.now = self._information(system, fit.values, [*kept, *self.tested])
        else:
            self.now = self._placed(*information)

    def with_(self, proposal: Proposal) -> tuple[Array, float] | None:
        """Rows of this recording and of the proposed one, and the latter's duration; None if it is impossible."""
        try:
            planned, values = self._planned(proposal)
            possible = {name for c in planned.candidates for name in c.names}
            found = [q for q in self._shared if q.name in possible]
            quantities = {q.name: q for q in (*planned.base, *found, *self.tested)}
            another = proposal.mass != 1.0 or proposal.radius != 1.0
            rows = self._information(planned, values, quantities.values(), another)
        except DiscTrackError:  # there is no such precession, or it ends at once
            return None
        return np.concatenate([self.now, rows]), float(planned.time[-1] - planned.time[0])

    def answer(self, rows: Array, question: Question) -> float:
        """Distance [sigmas] of the effect at its fitted size from all that the alternative can predict.

        Without an alternative the standard deviation of the effect's first quantity; infinite if not determined.
        """
        matrix = np.concatenate([rows, self._priors])
        columns, *alternative = (matrix[:, [self.column[n] for n in c.names]] for c in question)
        basis = span(np.column_stack([matrix[:, self._base], *alternative]))
        if not alternative:
            return float(sigmas(columns, basis)[0])
        amounts = np.array([self.fit.values.get(q.name, q.null) - q.null for q in question[0].quantities])
        return float(np.linalg.norm(cleared(columns @ amounts, basis)))

    def _information(
        self, system: DiscSystem, values: Values, quantities: Iterable[Quantity], another: bool = False
    ) -> Array:
        """(m, k) rows of a recording on the shared ones among these quantities; its own ones are eliminated.

        another : it is of another disc, which has its own k_m, inertia and dots, as in a joint diagnosis; laws that
            were found or are in question have one coefficient for both
        """
        here, in_base = system is self.system, {q.name for q in system.base}
        own, shared = list[Quantity](), list[Quantity]()
        for q in quantities:
            one_for_all = q.name not in in_base and any(kind in LAWS for kind in q.belongs_to)
            its_own = not q.belongs_to or (another and "disc" in q.belongs_to and not one_for_all)
            (own if its_own and not (here and q in self.tested) else shared).append(q)
        names = [q.name for q in shared]
        start = {q.name: q.null for q in own} | dict(values)
        reduced = Reduction(system, own, start).reduce(start, names)
        if reduced is None:
            raise AnalysisError("the motion cannot be followed")
        return np.asarray(triangle(self._placed(names, reduced[1])) / np.sqrt(self._noise), float)

    def _placed(self, names: Sequence[str], rows: Array) -> Array:
        """Rows (m, k) of these quantities, in the planner's columns; others are left out."""
        placed = np.zeros((len(rows), len(self.column)))
        for j, name in enumerate(names):
            if name in self.column:
                placed[:, self.column[name]] = rows[:, j]
        return placed

    def _planned(self, proposal: Proposal) -> tuple[DiscSystem, dict[str, float]]:
        """The system of the proposed recording, with the same cameras and noise, and the values of its quantities.

        Raises DiscTrackError if its motion is too short.
        """
        system, old = self.system, self.system.trajectory
        disc = replace(  # of another material, or larger of the same thickness, with larger distances of the dots
            system.disc,
            mass=system.disc.mass * proposal.mass * proposal.radius**2,
            radius=system.disc.radius * proposal.radius,
            marker_centres_body=system.disc.marker_centres_body * [proposal.radius, proposal.radius, 1.0],
        )
        changed: dict[str, Any] = {"disc": disc, "air_density": old.air_density * proposal.pressure}
        values = {k: v for k, v in self.fit.values.items() if not k.startswith(("state.", "rig.", "dot_"))}
        start = state_of(self.fit.values)
        if proposal.theta_deg is not None:
            start = steady_precession(
                np.radians(proposal.theta_deg),
                disc,
                system.model.gravity,
                omega3=proposal.omega3,
                nutation_amplitude=np.radians(NUTATION_SHARE * proposal.theta_deg),
            ).moved(**dict(zip("xy", np.nanmean(old.q[:, :2], axis=0).tolist(), strict=True)))
        duration, rate = proposal.duration or float(np.ptp(system.time)), old.frame_rate * proposal.rate
        model = replace(system.model_with(values), **changed)
        motion = simulate(model, start, duration, rate=rate, theta_end=MIN_THETA)
        n, m = len(motion), disc.n_markers
        if n < MIN_FRAMES:
            raise AnalysisError(f"the motion is over after {n} frames")
        R = rotation_from_euler(*motion.q[:, 3:].T)
        pixels = system.rig.project(disc.marker_centres_body @ np.swapaxes(R, 1, 2) + motion.q[:, None, :3])
        pixels = np.moveaxis(pixels, -3, 1)
        usual = np.nanmedian(old.markers_covariance_px2.reshape(-1, 2, 2), axis=0) / proposal.numbers
        seen = np.where(np.isfinite(pixels).all(-1), MarkerStatus.MEASURED, MarkerStatus.OUTSIDE)
        # other arrays by frame are not used by the system
        trajectory = replace(
            part(old, slice(0, 1)),
            time=motion.time,
            q=motion.q,
            markers_px=pixels,
            markers_covariance_px2=np.broadcast_to(usual, (n, 2, m, 2, 2)),
            marker_status=seen.astype(np.uint8),
            frame_rate=rate,
            **changed,
        )
        known = replace(system.model, **changed)
        planned = DiscSystem(trajectory, known, rows=slice(0, n), systematic=system.systematic)
        names = [q.name for q in planned.base]
        state = dict(zip(names[:8], start.array[:8].tolist(), strict=True))
        return planned, dict.fromkeys(names, 0.0) | values | state


def plan(
    system: DiscSystem,
    fit: Fit,
    questions: Sequence[Question],
    noise: float = 1.0,
    information: Information | None = None,
) -> Plan:
    """Answers of many possible recordings: first other initial conditions, then changes of the best of them.

    information : as for `Planner`
    """
    planner = Planner(system, fit, questions, noise, information)

    def answers(rows: Array) -> tuple[float, ...]:
        return tuple(planner.answer(rows, question) for question in questions)

    now = answers(planner.now)

    def made(proposals: Iterable[Proposal]) -> Iterator[Proposed]:
        for proposal in proposals:
            if (possible := planner.with_(proposal)) is not None:
                yield Proposed(proposal, possible[1], answers(possible[0]))

    again = Proposal()
    first = Plan(tuple(questions), now, tuple(made((*(Proposal(*start) for start in STARTS), again))))
    bases = dict.fromkeys([again, *(b.proposal for i in range(len(questions)) if (b := first.best(i)) is not None)])
    changed = (
        replace(base, **{name: factor})
        for base in list(bases)[:3]
        for name, (_, factors) in CHANGES.items()
        for factor in factors
    )
    return replace(first, rows=(*first.rows, *made(changed)))


def open_questions(diagnosis: Diagnosis, sizes: Iterable[Score | Bound]) -> tuple[Question, ...]:
    """Open questions of a diagnosis: effects and their alternatives, then effects of the motion with an upper limit.

    Of the latter those whose standard deviation is largest compared with their typical size.
    sizes : of effects, as estimated from the data
    """
    found: list[Question] = [(f.candidate, r.candidate) for f in diagnosis.found for r in f.cannot_be_told_from]
    known = {f.candidate.name for f in diagnosis.found}
    single = [s for s in sizes if s.candidate.kind == "motion" and len(s.sigma) == 1 and np.isfinite(s.sigma[0])]
    single = [s for s in single if s.candidate.name not in known]
    single.sort(key=lambda s: -float(s.sigma[0]) / s.candidate.quantities[0].typical)
    return (*found[:OPEN], *((s.candidate,) for s in single[: max(OPEN - len(found), 2)]))
