"""Which further recording would tell what this one cannot? Computed for recordings that were not made yet.

The fitted model is started anew, filmed by the same cameras with the same noise, and linearised. What it would say of
the shared quantities (laws, cameras, dots) is put beside what this recording says; initial states are each one's own.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.least_squares import triangle
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.motion import state_of
from disctrack.diagnosis.stretch import MIN_FRAMES, MIN_THETA, Stretch
from disctrack.disc import Disc
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.joint.reduction import Reduction
from disctrack.discrepancy.joint.sharing import LAWS
from disctrack.discrepancy.score import Linearisation, cleared, score, span
from disctrack.discrepancy.search import Diagnosis
from disctrack.discrepancy.system import Candidate, Quantity
from disctrack.errors import AnalysisError, DiscTrackError
from disctrack.frames import rotation_from_euler
from disctrack.rolling import State, simulate, steady_precession
from disctrack.trajectory import MarkerStatus

NUTATIONS_DEG = (3.0, 8.0, 15.0, 30.0)
SPINS = (0.5, 5.0)  # omega_3 [rad/s]
DURATIONS = (0.5, 1.0)  # [s]
NUTATION_SHARE = 0.05  # amplitude of the nutation oscillation over the nutation angle
SEEN = 1e-6  # share of a column that is left after clearing, below which nothing is seen of it
OPEN = 6  # questions that further recordings are sought for
ENOUGH = 5.0  # sigmas from which on a recording answers a question


@dataclass(frozen=True)
class Proposal:
    """A recording that could be made; factors are those on what this recording had."""

    theta_deg: float | None = None  # at the start; None: as in this recording
    omega3: float | None = None  # [rad/s] spin
    duration: float | None = None  # [s] at most: it ends where the disc comes to rest
    mass: float = 1.0  # of a disc of the same size, from another material
    radius: float = 1.0  # of a disc of the same material and thickness, with its dots
    pressure: float = 1.0  # of the air
    rate: float = 1.0  # of the frames
    numbers: float = 1.0  # of the dots' images in a frame: more dots, or another view

    @property
    def text(self) -> str:
        """The recording in words."""
        start = "start as here"
        if self.theta_deg is not None:
            start = f"start at {self.theta_deg:g} deg with omega_3 = {self.omega3:g} rad/s"
        changes = [f"film {self.duration:.2g} s"] if self.duration is not None else []
        for factor, what in (
            (self.mass, "with a disc {} times as heavy"), (self.radius, "with a disc {} times as large"),
            (self.pressure, "in air at {} of the pressure"), (self.rate, "at {} times the frame rate"),
        ):  # fmt: skip
            changes += [what.format(f"{factor:g}")] if factor != 1.0 else []
        if self.numbers != 1.0:
            changes.append("with twice the dots" if self.numbers == 2.0 else "with a third view")
        return f"{start}, {', '.join(changes)}" if changes else f"{start}, the same again"


def starts() -> Iterator[Proposal]:
    """Recordings of the same disc by the same cameras."""
    for theta_deg in NUTATIONS_DEG:
        for omega3 in SPINS:
            for duration in DURATIONS:
                yield Proposal(theta_deg, omega3, duration)


CHANGES: tuple[Mapping[str, float], ...] = (
    {}, {"mass": 0.35}, {"mass": 2.0}, {"radius": 0.6}, {"radius": 1.6}, {"pressure": 0.1}, {"rate": 2.0},
    {"numbers": 1.5}, {"numbers": 2.0},
)  # fmt: skip


@dataclass(frozen=True)
class Question:
    """What a recording leaves open: an effect and its rival, or the size of an effect that was not found."""

    effect: Candidate
    rival: Candidate | None = None


@dataclass(frozen=True)
class Proposed:
    """One proposal and what it would bring to each question."""

    proposal: Proposal
    duration: float  # [s] until the disc comes to rest, at most that of the proposal
    answers: tuple[float, ...]  # sigmas between effect and rival; or the standard deviation of the effect's size


@dataclass(frozen=True)
class Plan:
    """Recordings that would settle what this one leaves open."""

    questions: tuple[Question, ...]
    now: tuple[float, ...]  # the answers of this recording alone
    rows: tuple[Proposed, ...]

    def best(self, i: int) -> Proposed | None:
        """The proposal that answers question i best."""
        known = [r for r in self.rows if np.isfinite(r.answers[i])]
        if not known:
            return None
        pick: Callable[..., Proposed] = min if self.questions[i].rival is None else max
        return pick(known, key=lambda r: r.answers[i])


class Planner:
    """The say of this recording on laws, cameras and dots, and that of recordings beside it."""

    def __init__(
        self,
        system: DiscSystem,
        fit: Fit,
        candidates: Sequence[Candidate],
        noise: float = 1.0,
        said: Callable[[Sequence[str]], Array] | None = None,
    ) -> None:
        """Fit : of the enlarged model.   candidates : whose columns will be asked for.

        noise : variance of the dots over that stated
        said : rows (m, k) of what is known of quantities by their names, where that is more than this recording says
        """
        self.system, self.fit, self._noise = system, fit, noise
        new = {q.name: q for c in candidates for q in c.quantities}
        self.tested = tuple(new.values())
        fitted = tuple(q for q in fit.quantities if not q.is_initial and q.name not in new)
        self._local = tuple(q for q in fitted if q.belongs_to)
        self.own = tuple(q for q in fit.quantities if not q.belongs_to and q.name not in new)
        n_rig = system.rig_directions.shape[1]
        laws = [q for q in self._local if not q.name.startswith("rig.")]
        # directions of the rig in common, laws and dots, what is tested
        sigmas = [1.0] * n_rig + [q.prior_sigma for q in laws] + [np.inf] * len(self.tested)
        self._priors = np.diag(1.0 / np.array(sigmas))
        names = [f"rig.common_{j}" for j in range(n_rig)] + [q.name for q in (*laws, *self.tested)]
        self.column = {name: j for j, name in enumerate(names)}
        self._base = [j for j, name in enumerate(names) if name not in new]
        self.now = self._said(system, fit.values, Proposal()) if said is None else said(names)

    def amounts(self, candidate: Candidate) -> Array:
        """(k,) fitted sizes."""
        return np.array([self.fit.values.get(q.name, q.null) - q.null for q in candidate.quantities])

    def with_(self, proposal: Proposal) -> tuple[Array, float] | None:
        """Rows of this recording and of the proposed one, and how long that lasts; None where it cannot be made."""
        try:
            planned, values = self._planned(proposal)
            said = self._said(planned, values, proposal)
        except DiscTrackError:  # no such precession, or over at once: not a recording to propose
            return None
        return np.concatenate([self.now, said]), float(planned.time[-1] - planned.time[0])

    def sigmas(self, rows: Array, effect: Candidate, rival: Candidate) -> float:
        """Root of the chi-square that the rival leaves where the effect is true at its fitted size."""
        matrix = self._with_priors(rows)
        signal = matrix[:, self._columns(effect)] @ self.amounts(effect)
        return float(np.linalg.norm(cleared(signal, span(matrix[:, [*self._base, *self._columns(rival)]]))))

    def sigma(self, rows: Array, candidate: Candidate) -> float:
        """Standard deviation of its first number; infinite where nothing is seen of it."""
        matrix = self._with_priors(rows)
        mine, *rest = self._columns(candidate)
        column = matrix[:, mine]
        left = float(np.linalg.norm(cleared(column, span(matrix[:, [*self._base, *rest]]))))
        return 1.0 / left if left > SEEN * float(np.linalg.norm(column)) else float("inf")

    def _columns(self, candidate: Candidate) -> list[int]:
        return [self.column[n] for n in candidate.names]

    def _with_priors(self, rows: Array) -> Array:
        return np.concatenate([rows, self._priors])

    def _said(self, system: DiscSystem, values: dict[str, float], proposal: Proposal) -> Array:
        """(m, k) what a recording says of the shared quantities, its own at their best.

        Another disc has its own k_m, its own inertia and its own dots, as in a diagnosis of both together; laws that
        were found or are asked for have one constant.
        """
        here = system is self.system
        another = proposal.mass != 1.0 or proposal.radius != 1.0
        in_base = {q.name for q in system.base}
        foreseen = {name for c in system.candidates for name in c.names}
        found = [q for q in self._local if q.name in foreseen]
        known = {q.name: q for q in (*system.base, *found, *self.tested)}

        def shared(q: Quantity) -> bool:
            if not another:
                return bool(q.belongs_to)
            one_for_all = q.name not in in_base and any(kind in LAWS for kind in q.belongs_to)
            return bool(q.belongs_to) and ("disc" not in q.belongs_to or one_for_all)

        own = self.own if here else [q for q in known.values() if not shared(q)]
        local = [*self._local, *self.tested] if here else [q for q in known.values() if shared(q)]
        names = [q.name for q in local]
        start = {q.name: q.null for q in own} | values
        scales = {q.name: q.scale for q in (*known.values(), *local)}
        reduced = Reduction(system, own, start, scales).reduce(start, names)
        if reduced is None:
            raise AnalysisError("the motion cannot be followed")
        mixing = np.zeros((len(names), len(self.column)))
        for row, name in enumerate(names):
            if name.startswith("rig."):
                mixing[row, : system.rig_directions.shape[1]] = system.rig_directions[int(name[4:])]
            elif name in self.column:
                mixing[row, self.column[name]] = 1.0
        return np.asarray(triangle(reduced.matrix @ mixing) / np.sqrt(self._noise), float)

    def _planned(self, proposal: Proposal) -> tuple[DiscSystem, dict[str, float]]:
        """The system of a recording as proposed, and the values at which it would be found."""
        system = self.system
        disc = _changed(system.disc, proposal)
        values = {k: v for k, v in self.fit.values.items() if not k.startswith(("state.", "rig.", "dot_"))}
        start = state_of(self.fit.values)
        if proposal.theta_deg is not None:
            start = steady_precession(
                np.radians(proposal.theta_deg),
                disc,
                system.model.gravity,
                omega3=proposal.omega3,
                nutation_amplitude=np.radians(NUTATION_SHARE * proposal.theta_deg),
                x=float(np.nanmean(system.trajectory.q[:, 0])),
                y=float(np.nanmean(system.trajectory.q[:, 1])),
            )
        duration = proposal.duration or float(system.time[-1] - system.time[0])
        planned = planned_recording(system, values, start, duration, disc, proposal)
        names = [q.name for q in planned.base]
        state = {n: float(v) for n, v in zip(names[:8], start.array[:8], strict=False)}
        return planned, dict.fromkeys(names, 0.0) | values | state


def planned_recording(
    system: DiscSystem,
    values: dict[str, float],
    start: State,
    duration: float,
    disc: Disc | None = None,
    proposal: Proposal | None = None,
) -> DiscSystem:
    """The same cameras and noise, another motion; raises DiscTrackError where that motion is too short."""
    old, proposal, disc = system.trajectory, proposal or Proposal(), disc or system.disc
    density = old.air_density * proposal.pressure
    model = replace(system.model_with(values), disc=disc, air_density=density)
    rate = old.frame_rate * proposal.rate
    motion = simulate(model, start, duration, rate=rate, theta_end=MIN_THETA)
    n, m = len(motion), disc.n_markers
    if n < MIN_FRAMES:
        raise AnalysisError(f"the motion is over after {n} frames")
    R = rotation_from_euler(*motion.q[:, 3:].T)
    pixels = system.rig.project(disc.marker_centres_body @ np.swapaxes(R, 1, 2) + motion.q[:, None, :3])
    pixels = np.moveaxis(pixels, -3, 1)
    usual = np.nanmedian(old.markers_covariance_px2.reshape(-1, 2, 2), axis=0) / proposal.numbers
    inside = np.isfinite(pixels).all(-1)
    trajectory = replace(
        old,
        time=motion.time,
        frame=np.arange(n),
        q=motion.q,
        pose_covariance=np.broadcast_to(np.eye(6), (n, 6, 6)),
        calibration_sensitivity=np.zeros((n, 6, old.calibration_sensitivity.shape[2])),
        quaternion=np.zeros((n, 4)),
        frame_status=np.zeros(n, np.uint8),
        reprojection_rms_px=np.zeros((n, 2)),
        reduced_chi_square=np.ones(n),
        markers_px=pixels,
        markers_covariance_px2=np.broadcast_to(usual, (n, 2, m, 2, 2)),
        markers_residual_px=np.zeros((n, 2, m, 2)),
        marker_status=np.where(inside, MarkerStatus.MEASURED, MarkerStatus.OUTSIDE).astype(np.uint8),
        disc=disc,
        frame_rate=rate,
        air_density=density,
    )
    stretch = Stretch(slice(0, n))
    known = replace(system.model, disc=disc, air_density=density)
    return DiscSystem(trajectory, known, stretch=stretch, systematic=system.systematic)


def _changed(disc: Disc, proposal: Proposal) -> Disc:
    """Another disc: of another material, or larger from the same plate, its dots with it."""
    return replace(
        disc,
        mass=disc.mass * proposal.mass * proposal.radius**2,
        radius=disc.radius * proposal.radius,
        marker_centres_body=disc.marker_centres_body * [proposal.radius, proposal.radius, 1.0],
    )


def plan(
    system: DiscSystem,
    fit: Fit,
    questions: Sequence[Question],
    noise: float = 1.0,
    said: Callable[[Sequence[str]], Array] | None = None,
) -> Plan:
    """What each of many recordings would bring to the questions: starts first, then changes of the best of them.

    said : as for `Planner`
    """
    candidates = {c.name: c for q in questions for c in (q.effect, q.rival) if c is not None}
    planner = Planner(system, fit, list(candidates.values()), noise, said)

    def answers(rows: Array) -> tuple[float, ...]:
        return tuple(
            planner.sigma(rows, q.effect) if q.rival is None else planner.sigmas(rows, q.effect, q.rival)
            for q in questions
        )

    now = answers(planner.now)

    def made(proposals: Iterable[Proposal]) -> Iterator[Proposed]:
        for proposal in proposals:
            if (said := planner.with_(proposal)) is not None:
                yield Proposed(proposal, said[1], answers(said[0]))

    first = Plan(tuple(questions), now, tuple(made(starts())))
    bases = {Proposal(): None} | {b.proposal: None for i in range(len(questions)) if (b := first.best(i)) is not None}
    changed = (replace(base, **c) for base in list(bases)[:3] for c in CHANGES if c or base == Proposal())
    return replace(first, rows=(*first.rows, *made(changed)))


def open_questions(diagnosis: Diagnosis, system: DiscSystem) -> tuple[Question, ...]:
    """What a diagnosis leaves open: effects and their rivals, then effects of the motion with an upper bound only.

    Of the latter those whose standard deviation is largest beside their usual size.
    """
    found = [Question(f.candidate, r.candidate) for f in diagnosis.found for r in f.cannot_be_told_from]
    named = {f.candidate.name for f in diagnosis.found}
    single = [
        c
        for c in system.candidates
        if c.kind == "motion" and len(c.quantities) == 1 and not (c.threshold or c.sought) and c.name not in named
    ]
    linear = Linearisation(system, diagnosis.after, single)

    def share(c: Candidate) -> float:
        sigma = float(score(linear, c).sigma[0])
        return sigma / c.quantities[0].typical if np.isfinite(sigma) else 0.0

    unsettled = sorted(single, key=share, reverse=True)
    return tuple([*found[:OPEN], *(Question(c) for c in unsettled[: max(OPEN - len(found), 2)])])
