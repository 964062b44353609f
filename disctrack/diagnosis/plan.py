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

from calibration.kit.least_squares import triangle
from calibration.kit.types import Array
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.motion import state_of, state_quantities
from disctrack.diagnosis.stretch import MIN_FRAMES, MIN_THETA
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.joint.sharing import Member, Reduced, Reduction, Sharing
from disctrack.discrepancy.joint.together import Bound
from disctrack.discrepancy.score import Score, cleared, sigmas, span
from disctrack.discrepancy.search import Diagnosis
from disctrack.discrepancy.system import Candidate, Values
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
        factors = ((words, getattr(self, name)) for name, (words, _) in CHANGES.items())
        changes += [words.format(factor) for words, factor in factors if factor != 1.0]
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


class Planner:
    """Information of recordings, and with that of a further one, which is one more member of their joint system."""

    def __init__(
        self, members: Sequence[Member], like: int, found: Iterable[str], tested: Iterable[str], noise: float = 1.0
    ) -> None:
        """Like : which of the members has the surface, the cameras and, unless it is another, the disc of further ones.

        found, tested : names of candidates that are fitted in any case, and of those that are in question
        noise : variance of the dots over that stated
        """
        self._noise, self._number = noise, len(members)
        further = replace(members[like], labels={**members[like].labels, "recording": "further"})
        another = replace(further, labels={**further.labels, "disc": "another"})
        self.sharing = Sharing([*members, further, another])
        variants = {c.name: c for c in self.sharing.candidates}
        fitted = self.sharing.base | {q.name: q for name in found for q in variants[name].quantities}
        quantities = {q.name: q for name in tested for q in variants[name].quantities} | fitted
        self._names, parts = tuple(quantities), reversed(self.sharing.local[like].items())
        self._priors = np.diag([1.0 / q.prior_sigma for q in quantities.values()])
        # of a sum of shared quantities the first one is kept
        self._column = {local: self._names.index(shared) for shared, local in parts if shared in quantities}
        self._free = [j for j, name in enumerate(self._names) if name in fitted or j not in self._column.values()]
        self.now = np.zeros((0, len(self._names)))

    def names(self, i: int) -> tuple[str, ...]:
        """Quantities of member i to which the shared ones contribute."""
        return self.sharing.local_names(i, self._names)

    def know(self, problems: Sequence[Reduced | None]) -> None:
        """Present information: each recording's problem in its `names`. Raises AnalysisError if one has none."""
        self.now = np.concatenate([self._rows(i, problem) for i, problem in enumerate(problems)])

    def with_(self, proposal: Proposal, system: DiscSystem, values: Values) -> tuple[Array, float] | None:
        """Rows of all recordings and of the proposed one, and the latter's duration; None if it is impossible.

        system, values : of the member that it is like
        """
        i = self._number + (proposal.mass != 1.0 or proposal.radius != 1.0)
        try:
            planned, at = planned_recording(proposal, system, values)
            own = self.sharing.own(i, planned.base)
            rows = self._rows(i, Reduction(planned, own, at).reduce(at, self.names(i)))
        except DiscTrackError:  # there is no such precession, or it ends at once
            return None
        return np.concatenate([self.now, rows]), float(planned.time[-1] - planned.time[0])

    def answer(self, rows: Array, question: Question, values: Values) -> float:
        """Distance [sigmas] of the effect at its fitted size from all that the alternative can predict.

        Without an alternative the standard deviation of the effect's first quantity; infinite if not determined.
        """
        tested = [[self._column[n] for n in c.names] for c in question]
        matrix = np.concatenate([rows, np.delete(self._priors, np.concatenate(tested), axis=0)])
        columns, *alternative = (matrix[:, each] for each in tested)
        others = [j for j in self._free if not any(j in each for each in tested)]
        basis = span(np.column_stack([matrix[:, others], *alternative]))
        if not alternative:
            return float(sigmas(columns, basis)[0])
        amounts = np.array([values.get(q.name, q.null) - q.null for q in question[0].quantities])
        return float(np.linalg.norm(cleared(columns @ amounts, basis)))

    def _rows(self, i: int, reduced: Reduced | None) -> Array:
        """(m, k) derivatives by the shared quantities, in units of the noise."""
        if not isinstance(reduced, tuple):
            raise AnalysisError("the motion cannot be followed")
        return triangle(self.sharing.placed(i, reduced[1], self._names)) / np.sqrt(self._noise)


def planner_alone(system: DiscSystem, fit: Fit, questions: Sequence[Question], noise: float = 1.0) -> Planner:
    """For further recordings after a single one.   fit : of the enlarged model.   noise : as for `Planner`"""
    tested = {q.name: q for question in questions for c in question for q in c.quantities}
    in_base = {q.name for q in system.base}
    base = tuple(q for q in fit.quantities if q.name in in_base or not (q.belongs_to or q.name in tested))
    added = {q.name: q for q in (*tested.values(), *fit.quantities) if q not in base and q.name not in in_base}
    of_one = [replace(q, belongs_to=q.belongs_to or ("recording",)) for q in added.values()]
    candidates = tuple(Candidate(q.name, q.owner, "motion", q.name, "", (q,)) for q in of_one)
    member = Member("", base, candidates, fit.values, 0, {})
    found, new = [n for n in added if n in fit.names], [n for n in added if n not in fit.names]
    planner = Planner([member], 0, found, new, noise)
    own = planner.sharing.own(0, base)
    planner.know([Reduction(system, own, fit.values).reduce(fit.values, planner.names(0))])
    return planner


def planned_recording(proposal: Proposal, system: DiscSystem, values: Values) -> tuple[DiscSystem, dict[str, float]]:
    """The system of the proposed recording, with the same cameras and noise, and the values of its quantities.

    Raises DiscTrackError if its motion is too short.
    """
    old, disc = system.trajectory, system.disc
    # of another material, or larger of the same thickness, with larger distances of the dots
    mass, radius = disc.mass * proposal.mass * proposal.radius**2, disc.radius * proposal.radius
    centres = disc.marker_centres_body * [proposal.radius, proposal.radius, 1.0]
    disc = replace(disc, mass=mass, radius=radius, marker_centres_body=centres)
    changed: dict[str, Any] = {"disc": disc, "air_density": old.air_density * proposal.pressure}
    kept = {k: v for k, v in values.items() if not k.startswith(("state.", "rig.", "dot_"))}
    start = state_of(values)
    if proposal.theta_deg is not None:
        theta, swing = np.radians(proposal.theta_deg), np.radians(NUTATION_SHARE * proposal.theta_deg)
        gravity, (x, y) = system.model.gravity, np.nanmean(old.q[:, :2], axis=0).tolist()
        steady = steady_precession(theta, disc, gravity, omega3=proposal.omega3, nutation_amplitude=swing)
        start = steady.moved(x=x, y=y)
    duration, rate = proposal.duration or float(np.ptp(system.time)), old.frame_rate * proposal.rate
    motion = simulate(replace(system.model_with(kept), **changed), start, duration, rate=rate, theta_end=MIN_THETA)
    n, m = len(motion), disc.n_markers
    if n < MIN_FRAMES:
        raise AnalysisError(f"the motion is over after {n} frames")
    R = rotation_from_euler(*motion.q[:, 3:].T)
    pixels = system.rig.project(disc.marker_centres_body @ np.swapaxes(R, 1, 2) + motion.q[:, None, :3])
    pixels = np.moveaxis(pixels, -3, 1)
    usual = np.nanmedian(old.markers_covariance_px2.reshape(-1, 2, 2), axis=0) / proposal.numbers
    seen = np.where(np.isfinite(pixels).all(-1), MarkerStatus.MEASURED, MarkerStatus.OUTSIDE)
    covariance, status = np.broadcast_to(usual, (n, 2, m, 2, 2)), seen.astype(np.uint8)
    # other arrays by frame are not used by the system
    filmed = replace(
        part(old, slice(0, 1)),
        time=motion.time,
        q=motion.q,
        markers_px=pixels,
        markers_covariance_px2=covariance,
        marker_status=status,
        frame_rate=rate,
        **changed,
    )
    planned = DiscSystem(filmed, replace(system.model, **changed), rows=slice(0, n), systematic=system.systematic)
    return planned, kept | {q.name: x for q, x in zip(state_quantities(), start.array[:8].tolist(), strict=True)}


def plan(planner: Planner, questions: Sequence[Question], system: DiscSystem, values: Values) -> Plan:
    """Answers of many possible recordings: first other initial conditions, then changes of the best of them.

    system, values : of the recording that they are like
    """

    def answers(rows: Array) -> tuple[float, ...]:
        return tuple(planner.answer(rows, question, values) for question in questions)

    now = answers(planner.now)

    def made(proposals: Iterable[Proposal]) -> Iterator[Proposed]:
        for proposal in proposals:
            if (possible := planner.with_(proposal, system, values)) is not None:
                yield Proposed(proposal, possible[1], answers(possible[0]))

    again = Proposal()
    first = Plan(tuple(questions), now, tuple(made((*(Proposal(*start) for start in STARTS), again))))
    bases = dict.fromkeys([again, *(b.proposal for i in range(len(questions)) if (b := first.best(i)) is not None)])
    changes = [{name: factor} for name, (_, factors) in CHANGES.items() for factor in factors]
    changed = (replace(base, **change) for base, change in product(list(bases)[:3], changes))
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
