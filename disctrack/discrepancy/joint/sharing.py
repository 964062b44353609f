"""Who shares what: quantities of single recordings, and those of many of which they are made.

For the search, many recordings are one system: its samples are recordings, its rows what each says of the shared. An
initial state matters to nobody else: once it is eliminated, what is left is the least-squares problem in the shared
quantities alone, a few dozen rows, however long the recording. Its minimum is followed as the shared quantities move.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.least_squares import eliminate
from disctrack.discrepancy.elimination import is_linear, prior_rows, projection
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.joint.crew import Crew
from disctrack.discrepancy.system import Candidate, Quantity, System, Values

EACH = "each its own"  # of the candidates whose amounts differ from group to group
Reduced = tuple[Array, Array]  # right side (m,) and matrix (m, s) of the problem in the shared quantities
LAWS = ("surface", "air")  # whose laws may well have the same constant with another disc, or on another surface


@dataclass(frozen=True)
class Member:
    """What is to be known of one recording to combine it with others; light, as its data stay where they are."""

    name: str
    base: tuple[Quantity, ...]
    candidates: tuple[Candidate, ...]
    start: Mapping[str, float]  # of the base quantities, fitted alone
    n_data: int
    labels: Mapping[str, str]  # "disc", "surface", "rig", "air" -> which one it was
    covariates: Mapping[str, float] = field(default_factory=dict)  # declared: "mass", "radius", ... in SI


class Sharing:
    """The shared quantities of some recordings, their candidates, and every member's part in them."""

    def __init__(self, members: Sequence[Member]) -> None:
        """Members : in the order of the recordings."""
        self.members = tuple(members)
        self.base: dict[str, Quantity] = {}
        self._groups: dict[str, dict[str, str]] = {}  # quantity of a law -> group -> shared name
        self._nulls: dict[str, float] = {}
        self._own: list[list[Quantity]] = [[] for _ in members]
        # of each member: what it shares -> its own quantity, which is off its null by the sum of what these are off
        self.local: list[dict[str, str]] = [{} for _ in members]
        for i, member in enumerate(members):
            for q in member.base:
                self._base_quantity(i, q)
        self.candidates = self._all_candidates()
        self.own = tuple(tuple(own) for own in self._own)  # of each member, the base quantities that it does not share

    def all_groups(self) -> dict[str, dict[str, str]]:
        """Quantities of laws that differ from group to group: name -> group -> shared name."""
        return {local: groups for local, groups in self._groups.items() if len(groups) > 1}

    def covariates_of(self, local: str) -> dict[str, list[float]]:
        """Declared numbers by name, one for each group of this quantity.

        Those that differ within a group are left out.
        """
        declared = self._by_group(local, [m.covariates for m in self.members])
        return {name: numbers for name, numbers in sorted(declared.items()) if None not in numbers}

    def kinds_of(self, local: str) -> dict[str, list[str]]:
        """Which disc, surface, ... each group of this quantity has, for those kinds that two groups have in common."""
        found = self._by_group(local, [m.labels for m in self.members])
        named = {kind: [label or f"no {kind} declared" for label in labels] for kind, labels in found.items()}
        return {kind: labels for kind, labels in named.items() if 1 < len(set(labels)) < len(labels)}

    def _by_group(self, local: str, of_members: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
        """What is the same in all members of each group of a quantity: name -> one for each group."""
        each = list(zip(of_members, self.local, strict=True))
        groups = [[known for known, parts in each if shared in parts] for shared in self._groups[local].values()]
        found = {}
        for name in dict.fromkeys(name for group in groups for known in group for name in known):
            found_in = [{known.get(name) for known in group} for group in groups]
            if all(len(one) == 1 for one in found_in):
                found[name] = [one.pop() for one in found_in]
        return found

    def group(self, member: Member, q: Quantity) -> str:
        """Which of the groups that share a quantity like this the member belongs to; empty where there is one only."""
        return ", ".join(member.labels.get(k, "") or f"no {k} declared" for k in self.differing(q))

    def differing(self, q: Quantity) -> list[str]:
        """What sets apart the groups that share a quantity like this: "disc", "surface", ..."""
        return [k for k in q.belongs_to if len({m.labels.get(k, "") for m in self.members}) > 1]

    def _alone(self, member: Member, q: Quantity) -> bool:
        own = self.group(member, q)
        return sum(self.group(m, q) == own for m in self.members) == 1

    def _base_quantity(self, i: int, q: Quantity) -> None:
        member = self.members[i]
        if not q.belongs_to or (is_linear(q) and self._alone(member, q)):
            self._own[i].append(q)
            return
        group = self.group(member, q)
        shared = self._share(i, q, group)
        self.base.setdefault(shared.name, shared)
        if not np.isfinite(q.prior_sigma):
            self._groups.setdefault(q.name, {})[group] = shared.name

    def _share(self, i: int, local: Quantity, group: str) -> Quantity:
        # among many recordings none of the shared ones is taken out beforehand: their rows are no longer those of data
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
        """The candidate with one number for all, and with one for each group, as far as that makes sense."""
        first = next(iter(having.values()))
        groups = {self.group(self.members[i], q) for i, c in having.items() for q in c.quantities[:1]}
        variants = []
        is_law = any(k in LAWS for q in first.quantities for k in q.belongs_to)
        one_for_all = len(groups) == 1 or (is_law and first.kind == "motion")
        if one_for_all:
            for i, c in having.items():
                for q in c.quantities:
                    self._share(i, q, "")
            quantities = tuple(replace(q, linear=False) for q in first.quantities)
            title = first.title + (", one value for all" if len(groups) > 1 else "")
            variants.append(replace(first, quantities=quantities, title=title))
        if len(groups) > 1:
            new: dict[str, Quantity] = {}
            for i, c in having.items():
                for q in c.quantities:
                    group = self.group(self.members[i], q)
                    shared = self._share(i, q, group)
                    new[shared.name] = shared
                    self._groups.setdefault(q.name, {})[group] = shared.name
            name = f"{first.name} ({EACH})" if one_for_all else first.name
            title = f"{first.title}, with a value for each group" if one_for_all else first.title
            start = first.start * len(groups)
            variants.append(replace(first, name=name, quantities=tuple(new.values()), title=title, start=start))
        return variants

    def local_names(self, i: int, names: Sequence[str]) -> tuple[str, ...]:
        """The member's quantities that these shared ones are part of."""
        return tuple(dict.fromkeys(self.local[i][name] for name in names if name in self.local[i]))

    def local_values(self, i: int, shared: Values) -> dict[str, float]:
        """The member's shared quantities, those at null among them only where the base has them."""
        values: dict[str, float] = {}
        for name, local in self.local[i].items():
            null = self._nulls[name]
            away = shared.get(name, null) - null
            if away or name in self.base:
                values[local] = values.get(local, null) + away
        return values

    def start(self) -> dict[str, float]:
        """Shared base quantities: the median of what their recordings give alone."""
        found: dict[str, list[float]] = {name: [] for name in self.base}
        for member, parts in zip(self.members, self.local, strict=True):
            for name, local in parts.items():
                if name in found:
                    found[name].append(member.start[local])
        return {name: float(np.median(alone)) for name, alone in found.items()}


class Reduction:
    """A system in which some quantities of the base always take their best values."""

    def __init__(self, system: System, own: Sequence[Quantity], start: Values) -> None:
        """Own : quantities that have no bounds.   start : their values, from which their first fit begins."""
        self.system, self.own = system, tuple(own)
        self.moved = [q for q in own if not is_linear(q)]
        self._first = self.own_values = {q.name: start.get(q.name, q.null) for q in self.moved}

    def reduce(self, shared: Values, names: Sequence[str]) -> Reduced | None:
        """The problem in the shared quantities `names`, at the values `shared`; None where there is no prediction."""
        for start in (self.own_values, self._first):  # where the point that was followed leads nowhere, from the first
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
    """Recordings that share quantities. A row is a recording's least-squares problem in them, its own ones at best."""

    def __init__(self, sharing: Sharing, crew: Crew) -> None:
        """Crew : of the members of the sharing, each with a method `reduce` (`Reduction`)."""
        self.sharing, self._crew = sharing, crew
        n = len(sharing.members)
        self.time: Array = np.arange(n, dtype=float)
        free = [sum(not np.isfinite(q.prior_sigma) for q in own) for own in sharing.own]
        self.weights: Array = np.array([m.n_data - k for m, k in zip(sharing.members, free, strict=True)], float)
        self.base: tuple[Quantity, ...] = tuple(sharing.base.values())
        self.candidates: tuple[Candidate, ...] = sharing.candidates

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Rows (n, w) of the recordings' reduced problems, filled up with zeros, and their derivatives (n, w, k)."""
        sharing, n = self.sharing, len(self.time)
        local = [sharing.local_names(i, names) for i in range(n)]
        found = self._crew.call("reduce", [(sharing.local_values(i, values), local[i]) for i in range(n)])
        reduced = {i: each for i, each in enumerate(found) if isinstance(each, tuple)}
        width = max([1, *(len(right) for right, _ in reduced.values())])
        residual, derivative = np.full((n, width), np.nan), np.zeros((n, width, len(names)))
        for i, (right, matrix) in reduced.items():
            residual[i] = 0.0
            residual[i, : len(right)] = right
            for column, name in enumerate(names):
                if name in sharing.local[i]:
                    derivative[i, : len(right), column] = matrix[:, local[i].index(sharing.local[i][name])]
        return residual, derivative
