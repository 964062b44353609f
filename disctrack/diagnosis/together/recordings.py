"""Recordings of the rolling disc as members of a joint diagnosis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.kit.arrays import Array
from disctrack.analyse.declaration import contradictions, density
from disctrack.diagnosis.declared_dots import with_declared_dots
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.large_faults import find_large
from disctrack.diagnosis.model_file import PAPER, Declared, declared_model
from disctrack.diagnosis.plan import Plan, Question, plan
from disctrack.diagnosis.stretch import Stretch, free_stretch
from disctrack.diagnosis.systematic import (
    Systematic,
    find_systematic,
    noise_over_stated,
    smooth_field,
    with_noise,
)
from disctrack.disc import Disc
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.joint.reduction import Reduced, Reduction
from disctrack.discrepancy.joint.sharing import Member
from disctrack.discrepancy.joint.together import Alone
from disctrack.discrepancy.noise import THIRD, inflation
from disctrack.discrepancy.system import Quantity, Values
from disctrack.errors import AnalysisError, DiscTrackError
from disctrack.trajectory import MarkerStatus, Trajectory
from disctrack.trajectory.file import read_details, read_provenance, read_trajectory

SURE = 4.0  # sigmas of the noise that frames show, from which it is not the one stated
SEEN_PLACES = 60  # frames of a recording whose dots tell where the lenses' fields are needed


@dataclass(frozen=True)
class Recorded:
    """A measured trajectory with what was declared beside it."""

    name: str
    trajectory: Trajectory
    surface: str = ""
    disc: str = ""  # name of the disc, where sizes and mass do not tell it from others


def read_recorded(path: Path) -> Recorded:
    """From a trajectory file. Raises TrajectoryFileError."""
    provenance = read_provenance(path)
    declared = provenance.settings.get("recording", {})
    return Recorded(
        provenance.recording,
        with_declared_dots(read_trajectory(path), read_details(path)),
        str(declared.get("surface", "")),
        str(declared.get("disc", {}).get("name", "")),
    )


def rig_key(trajectory: Trajectory) -> bytes:
    """Equal for recordings that were calibrated together."""
    rig = trajectory.rig
    cameras = [(c.fx, c.fy, c.cx, c.cy, *c.distortion) for c in rig.cameras]
    parts = [np.ravel(cameras), rig.R_right_left, rig.t_right_left, rig.R_left_world, rig.t_left_world, rig.covariance]
    return b"".join(np.ascontiguousarray(np.ravel(part), float).tobytes() for part in parts)


def labels_of(recordings: Sequence[Recorded]) -> list[dict[str, str]]:
    """Disc, surface, rig and air of every recording, in words that tell them apart."""
    rigs = {key: i + 1 for i, key in enumerate(dict.fromkeys(rig_key(r.trajectory) for r in recordings))}
    return [
        {
            "disc": r.disc or _disc_words(r.trajectory.disc),
            "surface": r.surface,
            "rig": f"rig {rigs[rig_key(r.trajectory)]}",
            "air": f"{_density(r.trajectory):g} kg/m^3",
        }
        for r in recordings
    ]


def _density(trajectory: Trajectory) -> float:
    """Of the air [kg/m^3], as far as it is known: what differs by less is one air."""
    return float(f"{trajectory.air_density:.3g}")


def _disc_words(disc: Disc) -> str:
    return f"{2e3 * disc.radius:g} x {2e3 * disc.half_thickness:g} mm, {1e3 * disc.mass:g} g"


@dataclass(frozen=True)
class Item:
    """What a process needs to know of one recording."""

    recorded: Recorded
    labels: Mapping[str, str] = field(default_factory=dict)
    model: str = PAPER


@dataclass(frozen=True)
class Say:
    """What all recordings say of some quantities, whatever the others are: rows of a least-squares problem."""

    names: tuple[str, ...]
    rows: Array  # (m, k)

    def __call__(self, names: Sequence[str]) -> Array:
        """(m, names) rows with columns for these; zero for those that nothing is known of."""
        column = {n: j for j, n in enumerate(self.names)}
        found = np.zeros((len(self.rows), len(names)))
        for j, name in enumerate(names):
            if name in column:
                found[:, j] = self.rows[:, column[name]]
        return found


class DiscMember:
    """One recording of the disc: prepared, fitted alone, and then asked for what it says of the shared quantities."""

    def __init__(self, item: Item) -> None:
        """Raises AnalysisError where it cannot be fitted with the others."""
        recorded = item.recorded
        self.item = item
        as_tracked = recorded.trajectory
        self.noise = _noise(as_tracked)
        trajectory = with_noise(as_tracked, self.noise)  # recordings are weighed by it
        self.declared: Declared = declared_model(trajectory, item.model)
        self.stretch: Stretch = free_stretch(trajectory)
        self.trajectory = trajectory
        system = DiscSystem(trajectory, self.declared.model, stretch=self.stretch, known=self.declared.faults)
        systematic = find_systematic(system, self.noise)
        assumed = find_large(as_tracked, self.declared.model, systematic, self.declared.faults)
        if assumed is not None:
            names = ", ".join(c.title for c in assumed.candidates)
            raise AnalysisError(f"its dots show a large fault of the measurement ({names}): diagnose it alone")
        self.system = system
        self._prepare(systematic)

    def _prepare(self, systematic: Systematic) -> None:
        self.systematic = systematic
        if systematic != self.system.systematic:
            self.system = self.system.again(systematic=systematic)
        system = self.system
        self.base = fit(system, system.base, system.start())
        if not self.base.converged:
            raise AnalysisError(
                f"the rolling model cannot be fitted to it alone (chi-square {self.base.reduced_chi_square:.3g})"
            )
        self.member = self._member()
        known = [q for q in system.base if q.belongs_to] + [q for c in system.candidates for q in c.quantities]
        self._scales = {q.name: q.scale for q in known}

    def told(self) -> tuple[Member, Systematic, list[Array]]:
        """What the others need of it: itself as a member, its systematic errors, and places of dots per camera [px]."""
        rows = np.unique(np.linspace(0, len(self.system.time) - 1, SEEN_PLACES).astype(int))
        used, places = self.system.used[rows], self.system.observed[rows]
        return self.member, self.systematic, [places[:, c][used[:, c]] for c in range(2)]

    def with_common(self, systematic: Systematic) -> Member:
        """The member with systematic errors that it has in common with others."""
        if systematic != self.systematic:
            self._prepare(systematic)
        return self.member

    def share(self, own: Sequence[str]) -> None:
        """These quantities are its own, all others of the base are shared."""
        mine = [q for q in self.system.base if q.name in set(own)]
        self._reduction = Reduction(self.system, mine, self.base.values, self._scales)

    def reduce(self, values: Values, names: Sequence[str]) -> Reduced | None:
        """What it says of shared quantities."""
        return self._reduction.reduce(self._with_faults(values), names)

    def _with_faults(self, values: Values) -> dict[str, float]:
        return {**self.declared.faults, **values}

    def alone(self, values: Values, names: Sequence[str]) -> Alone:
        """The recording fitted alone with these of its candidates' quantities free, from the shared solution on."""
        system = self.system
        known = {q.name: q for c in system.candidates for q in c.quantities}
        extra = [known[n] for n in names if n in known]
        start = {**self.base.values, **self._reduction.own_values(values), **self._with_faults(values)}
        found = fit(system, (*system.base, *extra), start)
        factors = dict(zip(found.names, inflation(system, found), strict=True))
        kept = [q.name for q in found.quantities if q.belongs_to and not np.isfinite(q.prior_sigma)]
        return Alone(
            found.values,
            {n: found.sigma(n) for n in kept},
            {n: float(factors[n]) for n in kept},
            found.chi_square,
            found.degrees_of_freedom,
            found.converged,
        )

    def planned(self, values: Values, names: Sequence[str], questions: Sequence[Question], said: Say) -> Plan:
        """Recordings that would answer questions; `said` is what all recordings together know of quantities.

        values : of the shared quantities.   names : of those that are no part of the base
        """
        known = {q.name: q for c in self.system.candidates for q in c.quantities}
        quantities = (*self.system.base, *(known[n] for n in names))
        everything = {**self.base.values, **self._reduction.own_values(values), **self._with_faults(values)}
        zero = np.zeros((len(quantities),) * 2)
        fitted = Fit(quantities, everything, zero, 0.0, 0.0, 1, True, 0)
        return plan(self.system, fitted, questions, said=said)

    def _member(self) -> Member:
        system, disc = self.system, self.system.disc
        directions = system.rig_directions
        links = {
            f"rig.{i}": {f"rig.common_{j}": float(x) for j, x in enumerate(row)} for i, row in enumerate(directions)
        }
        known = {q.name: q for q in system.base}
        first = known.get("rig.0")
        linked: dict[str, Quantity] = {}
        if first is not None:
            linked = {f"rig.common_{j}": replace(first, name=f"rig.common_{j}") for j in range(directions.shape[1])}
        covariates = {"mass": disc.mass, "radius": disc.radius, "thickness": 2 * disc.half_thickness}
        covariates["density of the air"] = _density(self.trajectory)
        start = {n: v for n, v in self.base.values.items() if n in known}
        return Member(
            self.item.recorded.name,
            system.base,
            system.candidates,
            start,
            int(np.sum(system.weights)),
            self.item.labels,
            covariates,
            links,
            linked,
        )

    @property
    def before(self) -> Fit:
        """The declared model fitted to this recording alone."""
        return self.base


def _noise(trajectory: Trajectory) -> float:
    """Variance of the dots from frame to frame over that stated; 1 where it differs by no more than its own scatter."""
    ratio = noise_over_stated(trajectory)
    if not 0 < ratio < np.inf:
        return 1.0
    numbers = 2.0 * np.sum(trajectory.marker_status == MarkerStatus.MEASURED) - 6.0 * np.sum(trajectory.measured)
    return ratio if abs(ratio - 1.0) > SURE * np.sqrt(2 * (1 + THIRD) / max(numbers, 1.0)) else 1.0


def in_common(told: Sequence[tuple[Member, Systematic, list[Array]]]) -> list[Systematic]:
    """The systematic errors as recordings of one rig, or of one disc, have them in common: the largest that one shows.

    What one recording is too short to show is there in it all the same.
    """
    common: list[Systematic] = []
    for member, mine, _ in told:
        rigs = [(s, p) for m, s, p in told if m.labels["rig"] == member.labels["rig"]]
        discs = [s for m, s, _ in told if m.labels["disc"] == member.labels["disc"]]
        lens = max((s for s, _ in rigs), key=lambda s: s.lens_px)
        dots = max((s for s, _ in rigs), key=lambda s: s.dot_px)
        prints = max(s.print_m for s in discs)
        fields: tuple[Any, ...] = ()
        if lens.lens_px:
            # modes are kept down to where a field of ten sigmas of a single dot cannot be seen
            fields = tuple(
                smooth_field(np.concatenate([p[c] for _, p in rigs]), lens.lens_length_px, 10.0) for c in range(2)
            )
        common.append(
            replace(
                mine, lens_px=lens.lens_px, lens_length_px=lens.lens_length_px, lens_fields=fields,
                dot_px=dots.dot_px, dot_length_px=dots.dot_length_px, print_m=prints,
            )
        )  # fmt: skip
    return common


def build(item: Item) -> DiscMember:
    """For a crew. Raises AnalysisError where it cannot be used, with what was declared that may be why."""
    trajectory = item.recorded.trajectory
    heavy = density(trajectory.disc)
    if heavy:  # laws in proportion to the load would fit it all the same
        raise AnalysisError(heavy[0].sentence)
    try:
        return DiscMember(item)
    except Exception as error:
        try:
            wrong = contradictions(trajectory)
        except Exception:  # nothing can be said of it, and that is not why it could not be used
            wrong = ()
        if not wrong:
            raise
        reason = str(error) if isinstance(error, DiscTrackError) else "the rolling model cannot be fitted to it alone"
        raise AnalysisError("; ".join([reason, *(w.sentence for w in wrong)])) from error
