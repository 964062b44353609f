"""The numbers of a validation, and the sentence that follows from them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array, Mask
from disctrack.validate.comparison import (
    QUANTITIES,
    Consistency,
    ErrorStatistics,
    PoseErrors,
    calibration_consistency,
    joined,
    noise_consistency,
    spread,
)
from disctrack.validate.controls import Control
from disctrack.validate.efficiency import Efficiency, law_constant
from disctrack.validate.poses import STRATA_DEG
from disctrack.validate.stress import CLAIM_POSITION, CLAIM_ROTATION, Stress
from disctrack.validate.trial import FINAL, ROLLING, MeasuredTwice, TrialRecording

CLAIM = dict(zip(QUANTITIES, 3 * [CLAIM_POSITION] + 4 * [CLAIM_ROTATION], strict=True))
REGULAR_DEG = 5.0  # psi and phi are summed up from here on; below, 1/sin(theta) is all there is to see
STATIC = "static poses"
CONSISTENT = (0.8, 1.25)


@dataclass(frozen=True)
class SummaryRow:
    """Errors of one quantity: everything, and its two shares measured on the same images."""

    quantity: str
    total: ErrorStatistics  # through the recordings' own calibrations
    noise: ErrorStatistics  # through the true cameras
    calibration: ErrorStatistics  # the difference of the two
    bound: float  # Cramer-Rao sigma from the dots, rms over the poses of the efficiency run; NaN where not computed
    claim: float

    @property
    def holds(self) -> bool:
        """95 % of the errors lie within the claim."""
        return self.total.within_95 <= self.claim


@dataclass(frozen=True)
class SightCount:
    """Static poses by the number of cameras that can see the upper face."""

    cameras: int
    n: int
    found: int
    gross: int  # found, but another pose altogether
    position: float  # [m] rms per axis
    rotation: float  # [rad] rms per axis


@dataclass(frozen=True)
class Stratum:
    """Static poses seen by both cameras, within a range of nutation."""

    theta_deg: tuple[float, float]
    n: int
    rms: dict[str, float]  # by quantity [m, rad]; "position": per axis
    noise: dict[str, float]  # the same through the true cameras


@dataclass(frozen=True)
class Summary:
    """All that a validation found."""

    recordings: int
    rows: dict[str, tuple[SummaryRow, ...]]  # by kind of motion
    sights: tuple[SightCount, ...]
    strata: tuple[Stratum, ...]
    noise_consistency: dict[str, Consistency]
    calibration_consistency: Consistency
    calibration_rms_px: tuple[float, ...]
    efficiency: Efficiency | None
    law: float  # [rad] c of sigma(psi) = c / sin(theta)
    stresses: tuple[Stress, ...]
    controls: tuple[Control, ...]
    warnings: tuple[str, ...]

    def law_limit_deg(self, sigmas: float) -> float:
        """Nutation [deg] below which so many sigmas of psi and of phi exceed the claim."""
        return float(np.degrees(np.arcsin(min(1.0, sigmas * self.law / CLAIM_ROTATION))))


def summarise(
    trials: Sequence[TrialRecording],
    efficiency: Efficiency | None = None,
    stresses: Sequence[Stress] = (),
    controls: Sequence[Control] = (),
) -> Summary:
    """Summary of the recordings and of what was done besides."""
    static = [_both(trial.static, trial.static.cameras == 2) for trial in trials]
    kinds = {STATIC: static}
    for name in (ROLLING, FINAL):
        stretches = [trial.rolling[name] for trial in trials if name in trial.rolling]
        if stretches:
            kinds[name] = [_both(stretch, stretch.cameras == 2) for stretch in stretches]
    strata = tuple(_stratum(static, limits) for limits in STRATA_DEG)
    return Summary(
        recordings=len(trials),
        rows={name: _rows(parts, efficiency if name == STATIC else None) for name, parts in kinds.items()},
        sights=tuple(_sight([trial.static for trial in trials], n) for n in (2, 1, 0)),
        strata=strata,
        noise_consistency={
            name: noise_consistency(joined([true for _, true in parts])) for name, parts in kinds.items()
        },
        calibration_consistency=calibration_consistency([own for own, _ in static], [true for _, true in static]),
        calibration_rms_px=tuple(trial.calibration.rms_px for trial in trials),
        efficiency=efficiency,
        law=law_constant(efficiency) if efficiency is not None else _law_from(static),
        stresses=tuple(stresses),
        controls=tuple(controls),
        warnings=tuple(
            sorted({w for t in trials for m in (t.static, *t.rolling.values()) for w in m.warnings})
        ),
    )  # fmt: skip


Pair = tuple[PoseErrors, PoseErrors]  # through the own calibration, through the true cameras


def _both(measured: MeasuredTwice, rows: Mask) -> Pair:
    return measured.own.part(rows), measured.true.part(rows)


def _law_from(static: Sequence[Pair]) -> float:
    true = joined([true for _, true in static])
    ok = true.usable & (true.q[:, 4] < np.radians(20))
    scaled = true.angles[ok][:, [0, 2]] * np.sin(true.q[ok, 4])[:, None]
    return float(np.sqrt(np.mean(scaled**2)))


def _rows(parts: Sequence[Pair], efficiency: Efficiency | None) -> tuple[SummaryRow, ...]:
    own, true = joined([a for a, _ in parts]), joined([b for _, b in parts])
    both = own.usable & true.usable
    own, true = own.part(both), true.part(both)
    rows = []
    for k, name in enumerate(QUANTITIES):
        at = np.ones(len(own.q), bool)
        label, bound = name, float("nan")
        if name in ("psi", "phi") and (own.q[:, 4] > np.radians(REGULAR_DEG)).any():
            at = own.q[:, 4] > np.radians(REGULAR_DEG)
            if not at.all():
                label = f"{name} (theta > {REGULAR_DEG:.0f} deg)"
        a, b = own.part(at), true.part(at)
        if efficiency is not None:
            seen = efficiency.q[:, 4] > (np.radians(REGULAR_DEG) if name in ("psi", "phi") else 0.0)
            bound = float(np.sqrt(np.mean(efficiency.bound[seen, k] ** 2)))
        e, f = a.of(name), b.of(name)
        difference = np.angle(np.exp(1j * (e - f))) if k >= 3 else e - f
        rows.append(SummaryRow(label, spread(e), spread(f), spread(difference), bound, CLAIM[name]))
    return tuple(rows)


def _sight(measured: Sequence[MeasuredTwice], cameras: int) -> SightCount:
    own = joined([m.own.part(m.cameras == cameras) for m in measured])
    ok = own.usable
    return SightCount(
        cameras, len(own.q), int(own.found.sum()), int(own.gross.sum()),
        _rms(own.error[ok, :3]), _rms(own.error[ok, 3:]),
    )  # fmt: skip


def _stratum(static: Sequence[Pair], limits: tuple[float, float]) -> Stratum:
    own, true = joined([a for a, _ in static]), joined([b for _, b in static])
    theta = np.degrees(own.q[:, 4])
    at = (theta >= limits[0]) & (theta < limits[1])
    rms = []
    for comparison in (own.part(at), true.part(at)):
        figures = {name: spread(comparison.of(name)).rms for name in QUANTITIES}
        figures["position"] = _rms(comparison.error[comparison.usable, :3])
        rms.append(figures)
    return Stratum(limits, int(at.sum()), rms[0], rms[1])


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")


def verdict(summary: Summary) -> str:
    """Where the claim holds, where it cannot, and by which factor it is beaten; all from the numbers."""
    rows = {row.quantity.split(" ")[0]: row for row in summary.rows[STATIC]}
    position = max(rows[name].total.within_95 for name in "xyz")
    rotation = rows["rotation"].total.within_95
    two = summary.sights[0]
    n, missed = two.n, two.n - two.found + two.gross
    held = [position <= CLAIM_POSITION, rotation <= CLAIM_ROTATION]
    name = {(True, True): "holds", (False, False): "does not hold"}.get((held[0], held[1]), "holds in part")
    factors = ", ".join(
        f"{what} is {'beaten' if factor >= 1 else 'missed'} by a factor of {max(factor, 1 / factor):.1f}"
        for what, factor in (
            ("0.005 mm", CLAIM_POSITION / position),
            ("0.05 deg for the rotation as a whole", CLAIM_ROTATION / rotation),
        )
    )
    text = (
        f"Where both cameras see the face, the claim of 0.005 mm / 0.05 deg {name}: 95 % of {n} poses lie within "
        f"{1e3 * position:.5f} mm per axis and {np.degrees(rotation):.4f} deg per rotation axis, calibration included "
        f"({factors}{f'; {missed} poses not found or wrong' if missed else ''})"
    )
    if np.isfinite(summary.law):
        text += (
            f"; it cannot hold for psi and phi alone at small nutation, because each scatters by "
            f"{np.degrees(summary.law) * 1e3:.2f} mdeg / sin(theta): beyond 0.05 deg below "
            f"{summary.law_limit_deg(1):.1f} deg (rms) or {summary.law_limit_deg(2):.1f} deg (95 %)"
        )
        if summary.efficiency is not None:
            text += ", as any method must that uses the dots (efficiency "
            text += (
                f"{summary.efficiency.efficiency:.2f} +- {summary.efficiency.efficiency_uncertainty:.2f} of the bound)"
            )
    one = summary.sights[1]
    if one.found:
        beyond = "beyond the claim" if one.position > CLAIM_POSITION else "within the claim"
        text += f"; seen by one camera only, positions are good to {1e3 * one.position:.4f} mm (rms), {beyond}"
    return text + "."


def complaints(summary: Summary) -> tuple[str, ...]:
    """What a validation must not show; empty when all is well."""
    found = [f"{s.gross} of {s.n} poses seen by {s.cameras} cameras are wrong" for s in summary.sights if s.gross]
    two = summary.sights[0]
    if two.found < two.n:
        found.append(f"{two.n - two.found} of {two.n} poses seen by both cameras were not found")
    for kind, rows in summary.rows.items():
        for row in rows:
            if not row.holds and row.quantity.split(" ")[0] not in ("psi", "phi"):
                found.append(f"{kind}: 95 % of {row.quantity} lie beyond the claim")
    for name, value in [*summary.noise_consistency.items(), ("calibration", summary.calibration_consistency)]:
        slack = 3 * value.uncertainty  # with few poses or rigs chance alone leaves the band
        if value.n and not CONSISTENT[0] - slack <= value.value <= CONSISTENT[1] + slack:
            found.append(
                f"{name}: squared error over predicted variance is {value.value:.2f} +- {value.uncertainty:.2f}"
            )
    found += [f"planted fault '{c.fault}' not as expected" for c in summary.controls if not c.as_expected]
    return tuple(found)
