"""Who shares what: quantities of single recordings, and those of many of which they are made.

For the search, many recordings are one system: its samples are recordings, its rows what each says of the shared.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.elimination import is_linear
from disctrack.discrepancy.joint.crew import Crew
from disctrack.discrepancy.system import Candidate, Quantity, System, Values

EACH = "each its own"  # of the candidates whose amounts differ from group to group
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
    # Base quantities that are sums of common ones, e.g. of directions in which a rig may err: name -> common -> factor
    links: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    linked: Mapping[str, Quantity] = field(default_factory=dict)  # the common ones


class Sharing:
    """The shared quantities of some recordings, their candidates, and every member's part in them."""

    def __init__(self, members: Sequence[Member]) -> None:
        """Members : in the order of the recordings."""
        self.members = tuple(members)
        self.base: dict[str, Quantity] = {}
        self._groups: dict[str, dict[str, str]] = {}  # quantity of a law -> group -> shared name
        self._nulls: dict[str, float] = {}
        self._own: list[list[Quantity]] = [[] for _ in members]
        self._local_nulls: list[dict[str, float]] = [{} for _ in members]
        self._terms: list[dict[str, dict[str, float]]] = [{} for _ in members]
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
        each = list(zip(of_members, self._terms, strict=True))
        groups = [
            [known for known, terms in each if shared in terms.get(local, ())]
            for shared in self._groups[local].values()
        ]
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
        links = member.links.get(q.name)
        if not q.belongs_to or (is_linear(q) and self._alone(member, q)):
            self._own[i].append(q)
        elif links is not None:
            for stem, factor in links.items():
                common = member.linked[stem]
                self._share(i, q, replace(common, name=_named(stem, self.group(member, common))), factor)
        else:
            group = self.group(member, q)
            shared = replace(q, name=_named(q.name, group))
            self._share(i, q, shared, 1.0)
            if not np.isfinite(q.prior_sigma):
                self._groups.setdefault(q.name, {})[group] = shared.name

    def _share(self, i: int, local: Quantity, shared: Quantity, factor: float, base: bool = True) -> Quantity:
        # among many recordings none of the shared ones is taken out beforehand: their rows are no longer those of data
        shared = replace(shared, linear=False)
        if base:
            self.base.setdefault(shared.name, shared)
        self._nulls[shared.name] = shared.null
        self._local_nulls[i][local.name] = local.null
        self._terms[i].setdefault(local.name, {})[shared.name] = factor
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
                    self._share(i, q, q, 1.0, base=False)
            quantities = tuple(replace(q, linear=False) for q in first.quantities)
            title = first.title + (", one value for all" if len(groups) > 1 else "")
            variants.append(replace(first, quantities=quantities, title=title))
        if len(groups) > 1:
            new: dict[str, Quantity] = {}
            for i, c in having.items():
                for q in c.quantities:
                    group = self.group(self.members[i], q)
                    name = _named(q.name, group)
                    new[name] = self._share(i, q, replace(q, name=name), 1.0, base=False)
                    self._groups.setdefault(q.name, {})[group] = name
            name = f"{first.name} ({EACH})" if one_for_all else first.name
            title = f"{first.title}, with a value for each group" if one_for_all else first.title
            start = first.start * len(groups)
            variants.append(replace(first, name=name, quantities=tuple(new.values()), title=title, start=start))
        return variants

    def local_names(self, i: int, names: Sequence[str]) -> tuple[str, ...]:
        """The member's quantities that these shared ones are part of."""
        wanted = set(names)
        return tuple(local for local, terms in self._terms[i].items() if wanted & terms.keys())

    def local_values(self, i: int, shared: Values) -> dict[str, float]:
        """The member's shared quantities, those at null among them only where the base has them."""
        values = {}
        for local, terms in self._terms[i].items():
            amount = sum(f * (shared[n] - self._nulls[n]) for n, f in terms.items() if n in shared)
            if amount or any(n in self.base for n in terms):
                values[local] = self._local_nulls[i][local] + amount
        return values

    def shared_names(self, i: int) -> dict[str, str]:
        """The member's quantities that are shared as they are, and its rig's common ones: name there -> shared name."""
        member = self.members[i]
        found = {stem: _named(stem, self.group(member, q)) for stem, q in member.linked.items()}
        for local, terms in self._terms[i].items():
            same = [n for n, factor in terms.items() if factor == 1.0]
            if local not in member.links and same:
                found[local] = same[0]
        return found

    def mixing(self, i: int, local: Sequence[str], names: Sequence[str]) -> np.ndarray:
        """(local, names) derivative of the member's quantities by the shared ones."""
        column = {n: j for j, n in enumerate(names)}
        matrix = np.zeros((len(local), len(names)))
        for row, name in enumerate(local):
            for shared, factor in self._terms[i][name].items():
                if shared in column:
                    matrix[row, column[shared]] = factor
        return matrix

    def start(self) -> dict[str, float]:
        """Shared base quantities: the median of what their recordings give alone; linked ones at null."""
        found: dict[str, list[float]] = {}
        for member, terms in zip(self.members, self._terms, strict=True):
            for local, shared in terms.items():
                if local in member.start and local not in member.links:
                    for name in shared:
                        found.setdefault(name, []).append(member.start[local])
        return {n: float(np.median(found[n])) if n in found else q.null for n, q in self.base.items()}


def _named(name: str, group: str) -> str:
    return f"{name}[{group}]" if group else name


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
            derivative[i, : len(right)] = matrix @ sharing.mixing(i, local[i], names)
        return residual, derivative
