"""Shared quantities of many recordings, and the joint system of all recordings.

For the search, many recordings are one system, whose samples are recordings. The own quantities of a recording (its
initial state) are eliminated; what remains is a least-squares problem in the shared quantities alone, a few dozen rows
however long the recording. The own quantities are re-optimised whenever the shared ones change.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calibration.kit.least_squares import eliminate
from calibration.kit.types import Array
from disctrack.discrepancy.elimination import is_linear, prior_rows, projection
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.joint.crew import Crew
from disctrack.discrepancy.system import Candidate, Quantity, System, Values

EACH = "each its own"  # mark of candidates with an amount for each group
Reduced = tuple[Array, Array]  # right side (m,) and matrix (m, s) of the problem in the shared quantities
LAWS = ("surface", "air")  # whose laws may have the same constant for another disc or surface


@dataclass(frozen=True)
class Member:
    """Description of one recording, without its data."""

    name: str
    base: tuple[Quantity, ...]
    candidates: tuple[Candidate, ...]
    start: Mapping[str, float]  # base quantities, as fitted to this recording alone
    n_data: int
    labels: Mapping[str, str]  # "disc", "surface", "rig", "air" -> its name
    covariates: Mapping[str, float] = field(default_factory=dict)  # declared: "mass", "radius", ... in SI


class Sharing:
    """Shared quantities of recordings, their candidates, and the corresponding quantities of each member."""

    def __init__(self, members: Sequence[Member]) -> None:
        """Members : in the order of the recordings."""
        self.members = tuple(members)
        self.base: dict[str, Quantity] = {}
        self._groups: dict[str, dict[str, str]] = {}  # quantity of a law -> group -> shared name
        self._nulls: dict[str, float] = {}
        # of each member: shared name -> its quantity, whose difference from null is the sum of theirs
        self.local: list[dict[str, str]] = [{} for _ in members]
        for i, member in enumerate(members):
            for q in member.base:
                if not q.belongs_to or (is_linear(q) and self._alone(member, q)):
                    continue
                group = self.group(member, q)
                shared = self._share(i, q, group)
                self.base.setdefault(shared.name, shared)
                if not np.isfinite(q.prior_sigma):
                    self._groups.setdefault(q.name, {})[group] = shared.name
        self.candidates = self._all_candidates()

    def all_groups(self) -> dict[str, dict[str, str]]:
        """Quantities of laws that differ from group to group: name -> group -> shared name."""
        return {local: groups for local, groups in self._groups.items() if len(groups) > 1}

    def covariates_of(self, local: str) -> dict[str, list[float]]:
        """Declared covariates by name, a value for each group of this quantity, if it is the same within the group."""
        declared = self._by_group(local, [m.covariates for m in self.members])
        return {name: numbers for name, numbers in sorted(declared.items()) if None not in numbers}

    def kinds_of(self, local: str) -> dict[str, list[str]]:
        """Disc, surface, ... of each group of this quantity, for kinds that some but not all groups have in common."""
        found = self._by_group(local, [m.labels for m in self.members])
        named = {kind: [label or f"no {kind} declared" for label in labels] for kind, labels in found.items()}
        return {kind: labels for kind, labels in named.items() if 1 < len(set(labels)) < len(labels)}

    def _by_group(self, local: str, of_members: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
        """Properties that are the same in all members of each group of a quantity: name -> value for each group."""
        each = list(zip(of_members, self.local, strict=True))
        groups = [[known for known, parts in each if shared in parts] for shared in self._groups[local].values()]
        found = {}
        for name in dict.fromkeys(name for group in groups for known in group for name in known):
            found_in = [{known.get(name) for known in group} for group in groups]
            if all(len(one) == 1 for one in found_in):
                found[name] = [one.pop() for one in found_in]
        return found

    def group(self, member: Member, q: Quantity) -> str:
        """Name of the member's group, among those that share this quantity; empty where there is a single one."""
        return ", ".join(member.labels.get(k, "") or f"no {k} declared" for k in self.differing(q))

    def differing(self, q: Quantity) -> list[str]:
        """Kinds in which the groups of this quantity differ: "disc", "surface", ..."""
        return [k for k in q.belongs_to if len({m.labels.get(k, "") for m in self.members}) > 1]

    def _alone(self, member: Member, q: Quantity) -> bool:
        own = self.group(member, q)
        return sum(self.group(m, q) == own for m in self.members) == 1

    def _share(self, i: int, local: Quantity, group: str) -> Quantity:
        # shared quantities are not projected out beforehand: rows of the joint system are not rows of data
        shared = replace(local, name=f"{local.name}[{group}]" if group else local.name, linear=False)
        self._nulls[shared.name] = shared.null
        self.local[i][shared.name] = local.name
        return shared

    def _all_candidates(self) -> tuple[Candidate, ...]:
        by_name: dict[str, dict[int, Candidate]] = {}
        for i, member in enumerate(self.members):
            for c in member.candidates:
                if not (c.threshold or c.sought) and all(q.belongs_to for q in c.quantities):
                    by_name.setdefault(c.name, {})[i] = c
        return tuple(variant for having in by_name.values() for variant in self._variants(having))

    def _variants(self, having: Mapping[int, Candidate]) -> list[Candidate]:
        """The candidate with one amount for all groups, or with an amount for each, or both."""
        first = next(iter(having.values()))
        groups = {self.group(self.members[i], c.quantities[0]) for i, c in having.items()}
        each, variants = [(i, q) for i, c in having.items() for q in c.quantities], []
        is_law = any(k in LAWS for q in first.quantities for k in q.belongs_to)
        one_for_all = len(groups) == 1 or (is_law and first.kind == "motion")
        if one_for_all:
            quantities = [self._share(i, q, "") for i, q in each][: len(first.quantities)]
            title = first.title + (", one value for all" if len(groups) > 1 else "")
            variants.append(replace(first, quantities=tuple(quantities), title=title))
        if len(groups) > 1:
            new: dict[str, Quantity] = {}
            for i, q in each:
                group = self.group(self.members[i], q)
                shared = self._share(i, q, group)
                new[shared.name] = shared
                self._groups.setdefault(q.name, {})[group] = shared.name
            name = f"{first.name} ({EACH})" if one_for_all else first.name
            title = f"{first.title}, with a value for each group" if one_for_all else first.title
            variants.append(replace(first, name=name, quantities=tuple(new.values()), title=title))
        return variants

    def own(self, i: int, base: Sequence[Quantity]) -> list[Quantity]:
        """Those of a member's base quantities that it does not share."""
        return [q for q in base if q.name not in self.local[i].values()]

    def local_names(self, i: int, names: Sequence[str]) -> tuple[str, ...]:
        """The member's quantities to which these shared ones contribute."""
        return tuple(dict.fromkeys(self.local[i][name] for name in names if name in self.local[i]))

    def local_values(self, i: int, shared: Values) -> dict[str, float]:
        """Values of the member's shared quantities; those at null are omitted, unless they belong to the base."""
        values: dict[str, float] = {}
        for name, local in self.local[i].items():
            null = self._nulls[name]
            away = shared.get(name, null) - null
            if away or name in self.base:
                values[local] = values.get(local, null) + away
        return values

    def placed(self, i: int, matrix: Array, names: Sequence[str]) -> Array:
        """(m, k) derivatives by shared quantities of a member's rows, from those by its own ones (`local_names`)."""
        local = [*self.local_names(i, names), None]  # the last column: those that the member does not have
        with_none = np.column_stack([matrix, np.zeros(len(matrix))])
        return with_none[:, [local.index(self.local[i].get(name)) for name in names]]

    def start(self) -> dict[str, float]:
        """Initial values of the shared base quantities: the median over the recordings fitted alone.

        What has a tolerance in one recording may be exact in another, and a candidate there.
        """
        found: dict[str, list[float]] = {name: [] for name in self.base}
        for member, parts in zip(self.members, self.local, strict=True):
            for name, local in parts.items():
                if name in found:
                    found[name].append(member.start.get(local, self._nulls[name]))
        return {name: float(np.median(alone)) for name, alone in found.items()}


class Reduction:
    """A system with some base quantities profiled out: they always have their best values."""

    def __init__(self, system: System, own: Sequence[Quantity], start: Values) -> None:
        """Own : quantities without bounds.   start : their initial values."""
        self.system, self.own = system, tuple(own)
        self.moved = [q for q in own if not is_linear(q)]
        self._first = self.own_values = {q.name: start.get(q.name, q.null) for q in self.moved}

    def reduce(self, shared: Values, names: Sequence[str]) -> Reduced | None:
        """The problem in the shared quantities `names`, at the values `shared`; None where there is no prediction."""
        for start in (self.own_values, self._first):  # from the latest values, or else from the first ones
            found = fit(self.system, self.own, {**shared, **start})
            if found.converged:
                self.own_values = {name: found.values[name] for name in start}
                return self._eliminated(shared, names)
        return None

    def _eliminated(self, shared: Values, names: Sequence[str]) -> Reduced | None:
        values = {**shared, **self.own_values}
        common = projection(self.system, self.own, values)
        values |= dict(zip(common.names, common.null.tolist(), strict=True))
        residual, derivative = self.system.linearise(values, [*self.own_values, *names])
        stacked = np.column_stack([derivative.reshape(residual.size, -1), residual.reshape(-1)])
        if not np.isfinite(stacked).all():
            return None
        prior, matrix = prior_rows(self.moved, values)
        known = np.column_stack([matrix, np.zeros((len(prior), len(names))), prior])
        _, left = eliminate(np.concatenate([common.cleared(stacked), known]), len(self.moved))
        return left[:, -1], left[:, :-1]


class JointSystem(System):
    """Recordings that share quantities. A row is the reduced least-squares problem of a recording."""

    def __init__(self, sharing: Sharing, crew: Crew) -> None:
        """Crew : of the members of the sharing, each with the methods `share` and `reduce` (`Reduction`)."""
        self.sharing, self._crew = sharing, crew
        self.time: Array = np.arange(len(sharing.members), dtype=float)
        own = [sharing.own(i, m.base) for i, m in enumerate(sharing.members)]
        crew.call("share", [(quantities,) for quantities in own])
        free = [sum(not np.isfinite(q.prior_sigma) for q in quantities) for quantities in own]
        self.weights: Array = np.array([m.n_data - k for m, k in zip(sharing.members, free, strict=True)], float)
        self.base: tuple[Quantity, ...] = tuple(sharing.base.values())
        self.candidates: tuple[Candidate, ...] = sharing.candidates

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Rows (n, w) of the reduced problems, padded with zeros, and their derivatives (n, w, k)."""
        sharing, n = self.sharing, len(self.time)
        at = [(sharing.local_values(i, values), sharing.local_names(i, names)) for i in range(n)]
        found = self._crew.call("reduce", at)
        reduced = {i: each for i, each in enumerate(found) if isinstance(each, tuple)}
        width = max([1, *(len(right) for right, _ in reduced.values())])
        residual, derivative = np.full((n, width), np.nan), np.zeros((n, width, len(names)))
        for i, (right, matrix) in reduced.items():
            residual[i] = np.pad(right, (0, width - len(right)))
            derivative[i, : len(right)] = sharing.placed(i, matrix, names)
        return residual, derivative
