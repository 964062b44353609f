"""The accuracy claim of 0.005 mm and 0.05 deg put to the test: the numbers, and the sentence that follows from them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array
from disctrack.frames import POSE_COMPONENTS
from disctrack.validate.errors import (
    QUANTITIES,
    Consistency,
    PoseErrors,
    calibration_consistency,
    joined,
    mean_errors,
    noise_consistency,
)
from disctrack.validate.rendered import EXPOSURE, IMPERFECT, STATIC, STRATA_DEG, RenderedOutcome
from disctrack.validate.tables import Table, Validation

CLAIM_POSITION = 5e-6  # [m] and
CLAIM_ROTATION = np.radians(0.05)  # Ma et al. 2014, end of section 3
REGULAR_DEG = 5.0  # psi and phi are summed up from here on; below, 1/sin(theta) is all there is to see
LAW_DEG = 20.0  # at larger nutation the cameras' directions matter more than 1/sin(theta)
CONSISTENT = (0.8, 1.25)
_UM, _MDEG = 1e6, 180e3 / np.pi

Pair = tuple[PoseErrors, PoseErrors]  # through the own calibration, through the true cameras


@dataclass(frozen=True)
class AccuracyRow:
    """Errors of one quantity [m or rad]: everything, and its two shares measured on the same images."""

    quantity: str
    n: int
    bias: float
    scatter: float  # about the bias
    within_95: float  # 95 % of |error| lie within
    largest: float
    noise_rms: float  # through the true cameras
    calibration_rms: float  # difference of the recordings' own and the true cameras

    @property
    def claim(self) -> float:
        """What 95 % of the errors should lie within [m or rad]."""
        return CLAIM_POSITION if self.quantity in "xyz" else CLAIM_ROTATION

    @property
    def holds(self) -> bool:
        """95 % of the errors lie within the claim."""
        return self.within_95 <= self.claim


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
class Accuracy:
    """All that recordings with static poses showed."""

    recordings: int
    corners_px: tuple[float, ...]
    rows: dict[str, tuple[AccuracyRow, ...]]  # by part of the recordings
    sights: tuple[SightCount, ...]
    consistency: dict[str, Consistency]  # of the noise in each part, and of the calibration
    law: float  # [rad] c of sigma(psi) = c / sin(theta)
    warnings: tuple[str, ...]

    def law_limit_deg(self, sigmas: float) -> float:
        """Nutation [deg] below which so many sigmas of psi and of phi exceed the claim."""
        return float(np.degrees(np.arcsin(min(1.0, sigmas * self.law / CLAIM_ROTATION))))


def sum_up(outcomes: Sequence[RenderedOutcome]) -> Accuracy:
    """Of recordings that have static poses; errors count where both cameras see the face."""
    parts = _parts(outcomes)
    static = [outcome.parts[STATIC] for outcome in outcomes]
    law = joined([true for _, true in parts[STATIC]])
    law = law.part(law.usable & (law.q[:, 4] < np.radians(LAW_DEG)))
    consistency = {
        f"noise, {name} (true cameras)": noise_consistency(joined([true for _, true in pairs]))
        for name, pairs in parts.items()
    }
    by_calibration = {"calibration (own - true cameras, same images)": calibration_consistency(parts[STATIC])}
    return Accuracy(
        len(outcomes),
        tuple(outcome.corners_px for outcome in outcomes),
        {name: _rows(pairs) for name, pairs in parts.items()},
        tuple(_sight(joined([m.own.part(m.cameras == n) for m in static]), n) for n in (2, 1, 0)),
        consistency | by_calibration,
        _rms(law.angles[:, [0, 2]] * np.sin(law.q[:, 4])[:, None]),
        tuple(sorted({w for outcome in outcomes for m in outcome.parts.values() for w in m.warnings})),
    )


def _parts(outcomes: Sequence[RenderedOutcome]) -> dict[str, list[Pair]]:
    return {name: [outcome.parts[name].seen_by_both for outcome in outcomes] for name in outcomes[0].parts}


def _rows(pairs: Sequence[Pair]) -> tuple[AccuracyRow, ...]:
    own, true = (joined(errors) for errors in zip(*pairs, strict=True))
    both = own.usable & true.usable
    regular = both & (own.q[:, 4] > np.radians(REGULAR_DEG))
    rows = []
    for name in QUANTITIES:
        at = regular if name in ("psi", "phi") and regular.any() else both
        e, f = own.part(at).of(name), true.part(at).of(name)
        difference = e - f if name in "xyz" else np.angle(np.exp(1j * (e - f)))
        rows.append(AccuracyRow(name, len(e), *_spread(e), _rms(f), _rms(difference)))
    return tuple(rows)


def _spread(errors: Array) -> tuple[float, float, float, float]:
    """Mean, standard deviation, 95 % and largest of the sizes; NaN where there is no error."""
    if not errors.size:
        return float("nan"), float("nan"), float("nan"), float("nan")
    size = np.abs(errors)
    return float(errors.mean()), float(errors.std()), float(np.quantile(size, 0.95)), float(size.max())


def _sight(own: PoseErrors, cameras: int) -> SightCount:
    error = own.error[own.usable]
    found, gross = int(own.found.sum()), int(own.gross.sum())
    return SightCount(cameras, len(own.q), found, gross, _rms(error[:, :3]), _rms(error[:, 3:]))


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")


def verdict(accuracy: Accuracy) -> str:
    """Where the claim holds and where it cannot, from the numbers."""
    rows = {row.quantity: row for row in accuracy.rows[STATIC]}
    position = max(rows[name].within_95 for name in "xyz")
    rotation = rows["rotation"].within_95
    two, one, _ = accuracy.sights
    missed = two.n - two.found + two.gross
    held = {position <= CLAIM_POSITION, rotation <= CLAIM_ROTATION}
    name = "holds" if held == {True} else "does not hold" if held == {False} else "holds in part"
    text = (
        f"Where both cameras see the face, the claim of 0.005 mm and 0.05 deg {name}: 95 % of {two.n} poses lie within "
        f"{1e3 * position:.4f} mm per axis and {np.degrees(rotation):.4f} deg per rotation axis, calibration included"
        f"{f'; {missed} poses were not found or wrong' if missed else ''}. psi and phi alone scatter by "
        f"{_MDEG * accuracy.law:.2f} mdeg / sin(theta): beyond 0.05 deg below {accuracy.law_limit_deg(1):.1f} deg "
        f"(rms) or {accuracy.law_limit_deg(2):.1f} deg (95 %)"
    )
    if one.found:
        beyond = "beyond the claim" if one.position > CLAIM_POSITION else "within the claim"
        text += f". Frames seen by one camera only are good to {1e3 * one.position:.3f} mm (rms), {beyond}"
    return text + "."


def complaints(accuracy: Accuracy) -> tuple[str, ...]:
    """What a validation must not show; empty when all is well."""
    found = [f"{s.gross} of {s.n} poses seen by {s.cameras} cameras are wrong" for s in accuracy.sights if s.gross]
    two = accuracy.sights[0]
    if two.found < two.n:
        found.append(f"{two.n - two.found} of {two.n} poses seen by both cameras were not found")
    for kind, rows in accuracy.rows.items():
        for row in rows:
            if not row.holds and row.quantity not in ("psi", "phi"):
                found.append(f"{kind}: 95 % of {row.quantity} lie beyond the claim")
    for name, value in accuracy.consistency.items():
        slack = 3 * value.uncertainty  # with few poses or rigs chance alone leaves the band
        if value.n and not CONSISTENT[0] - slack <= value.value <= CONSISTENT[1] + slack:
            found.append(
                f"{name}: squared error over predicted variance is {value.value:.2f} +- {value.uncertainty:.2f}"
            )
    return tuple(found)


def accuracy_validation(outcomes: Sequence[RenderedOutcome]) -> Validation:
    """All tables of recordings with static poses, with the verdict on top."""
    accuracy, parts = sum_up(outcomes), _parts(outcomes)
    tables = [_accuracy_table(kind, rows) for kind, rows in accuracy.rows.items()]
    tables += [_strata_table(accuracy.law, parts[STATIC]), _sight_table(accuracy), _consistency_table(accuracy)]
    return Validation("validation", verdict(accuracy), tables, [accuracy], complaints(accuracy), accuracy.warnings)


def _cells(*values: float) -> list[str]:
    return [f"{value:.2f}" if np.isfinite(value) else "-" for value in values]


def _accuracy_table(kind: str, rows: Sequence[AccuracyRow]) -> Table:
    head = ["quantity", "unit", "n", "bias", "scatter", "95 %", "noise", "calibration", "claim / 95 %"]
    lines = []
    for row in rows:
        k, unit = (_UM, "um") if row.quantity in "xyz" else (_MDEG, "mdeg")
        errors = (row.bias, row.scatter, row.within_95, row.noise_rms, row.calibration_rms)
        cells = _cells(*(k * error for error in errors))
        lines.append([row.quantity, unit, str(row.n), *cells, f"{row.claim / row.within_95:.1f}"])
    note = "Rotation: the rotation vector between measured and true attitude."
    by_name = {row.quantity: row for row in rows}
    if by_name["psi"].n < by_name["theta"].n:
        note += f" psi and phi from {REGULAR_DEG:.0f} deg of nutation on."
    if kind != STATIC:
        note = f"Exposure {1e3 * EXPOSURE:g} ms, corrected for by the smear of the dots."
    return Table(f"{kind[0].upper()}{kind[1:]}", head, lines, note)


def _strata_table(law: float, static: Sequence[Pair]) -> Table:
    own, true = (joined(errors) for errors in zip(*static, strict=True))
    theta, angles = np.degrees(own.q[:, 4]), ("rotation", "theta", "psi", "phi")
    lines = []
    for low, high in STRATA_DEG:
        at = (theta >= low) & (theta < high)
        if not at.any():
            continue
        seen = own.part(at)
        position = _UM * _rms(seen.error[seen.usable, :3])
        rms = [_MDEG * _rms(seen.of(name)) for name in angles]
        expected = _MDEG * law / np.sin(np.radians(np.sqrt(low * high)))
        cells = _cells(position, *rms, _MDEG * _rms(true.part(at).of("psi")), expected)
        lines.append([f"{low:g}-{high:g}", str(int(at.sum())), *cells])
    head = ["theta [deg]", "n", "position [um]", *(f"{name} [mdeg]" for name in angles),
            "psi noise [mdeg]", f"{_MDEG * law:.2f} / sin(theta)"]  # fmt: skip
    return Table("As a function of nutation (static poses)", head, lines, "Root mean squares.")


def _sight_table(accuracy: Accuracy) -> Table:
    lines = [
        [*map(str, (s.cameras, s.n, s.found, s.gross)), *_cells(_UM * s.position, _MDEG * s.rotation)]
        for s in accuracy.sights
    ]
    head = ["cameras", "poses", "found", "wrong", "position rms [um]", "rotation rms [mdeg]"]
    note = "A pose that no camera can see rightly has no answer."
    return Table("Who sees the face (static poses)", head, lines, note)


def _consistency_table(accuracy: Accuracy) -> Table:
    lines = [[name, *_cells(c.value, c.uncertainty), str(c.n)] for name, c in accuracy.consistency.items()]
    head = ["squared error over predicted variance", "value", "standard error", "poses or rigs"]
    corners = ", ".join(f"{rms:.4f}" for rms in accuracy.corners_px)
    note = f"Target {CONSISTENT[0]} to {CONSISTENT[1]}. Corner residuals of the calibrations: {corners} px."
    return Table("Honesty of the reported covariance", head, lines, note)


def imperfect_validation(outcomes: Sequence[RenderedOutcome]) -> Validation:
    """Mean errors of recordings of an imperfect laboratory, with what is stated for them."""
    unit = np.array(3 * [_UM] + 3 * [_MDEG])
    found = [mean_errors(outcome.parts[IMPERFECT].own) for outcome in outcomes]
    lines = []
    for outcome, m in zip(outcomes, found, strict=True):
        means = [f"{e:.2f} +- {s:.2f}" for e, s in zip(m.error * unit, m.sigma * unit, strict=True)]
        left, right = outcome.parts[IMPERFECT].systematic_px
        lines.append([str(outcome.seed), *means, f"{m.noise_ratio:.2f}", f"{left:.4f}, {right:.4f}"])
    honest = np.mean([(m.error / m.sigma) ** 2 for m in found], axis=0)
    lines.append(["squared error over variance", *_cells(*honest), "", ""])
    head = ["seed", *POSE_COMPONENTS, "frame to frame, squared over stated", "repeating, px"]
    note = "Mean error +- what is stated for it, in um and mdeg."
    headline = f"Mean errors in {len(outcomes)} recordings."
    return Validation("imperfect", headline, [Table("Imperfect laboratory", head, lines, note)], found)
