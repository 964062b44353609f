"""Test of the claimed accuracy of 0.005 mm and 0.05 deg: the numbers, and a sentence that follows from them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.kit.arrays import Array
from disctrack.analyse.declaration import CLAIM_POSITION
from disctrack.frames import COORDINATES, POSE_COMPONENTS
from disctrack.validate.errors import Consistency, PoseErrors, calibration_consistency, joined, noise_consistency
from disctrack.validate.rendered import EXPOSURE, STATIC, STRATA_DEG, RenderedOutcome
from disctrack.validate.tables import Validation, table

CLAIM_ROTATION = np.radians(0.05)  # Ma et al. 2014, end of section 3
REGULAR_DEG = 5.0  # smallest nutation for statistics of psi and phi; below, their errors grow as 1/sin(theta)
LAW_DEG = 20.0  # largest nutation for the fit of 1/sin(theta); above, errors depend more on the cameras' directions
CONSISTENT = (0.8, 1.25)
_UM, _MDEG = 1e6, 180e3 / np.pi


@dataclass(frozen=True)
class AccuracyRow:
    """Errors of one quantity [m or rad]: in total, and from noise and calibration, from the same images."""

    quantity: str
    n: int
    bias: float
    scatter: float  # standard deviation
    within_95: float  # 95 % quantile of |error|
    noise_rms: float  # with the true cameras
    calibration_rms: float  # of the difference between calibrated and true cameras
    claim: float  # for the 95 % quantile


@dataclass(frozen=True)
class SightCount:
    """Static poses by the number of cameras that see the upper face."""

    cameras: int
    n: int
    found: int
    gross: int  # found, but a wrong pose
    position: float  # [m] rms per axis
    rotation: float  # [rad] rms per axis


@dataclass(frozen=True)
class Accuracy:
    """Summary of recordings, some with static poses."""

    rows: dict[str, tuple[AccuracyRow, ...]]  # by name of the recordings
    sights: tuple[SightCount, ...]
    consistency: dict[str, Consistency]  # of the noise for each name, and of the calibration
    law: float  # [rad] c of sigma(psi) = c / sin(theta)

    @property
    def law_limit_deg(self) -> float:
        """Nutation [deg] below which two sigmas of psi and of phi exceed the claim."""
        return float(np.degrees(np.arcsin(min(1.0, 2 * self.law / CLAIM_ROTATION))))


def sum_up(outcomes: Sequence[RenderedOutcome]) -> Accuracy:
    """Errors of the poses in which both cameras see the face."""
    names = dict.fromkeys(outcome.name for outcome in outcomes)
    pairs = {name: [outcome.seen_by_both for outcome in outcomes if outcome.name == name] for name in names}
    both = {name: [joined(errors) for errors in zip(*some, strict=True)] for name, some in pairs.items()}
    _, noise = both[STATIC]
    law = noise.part(noise.usable & (noise.q[:, 4] < np.radians(LAW_DEG)))
    c = _rms(law.angles[:, [0, 2]] * np.sin(law.q[:, 4])[:, None])
    consistency = {f"noise, {name} (true cameras)": noise_consistency(true) for name, (_, true) in both.items()}
    by_calibration = calibration_consistency(pairs[STATIC])
    return Accuracy(
        {name: _rows(*pair) for name, pair in both.items()},
        tuple(_sight(joined(o.own.part(o.cameras == n) for o in outcomes if o.name == STATIC), n) for n in (2, 1, 0)),
        consistency | {"calibration, static poses (own - true cameras, same images)": by_calibration},
        c,
    )


def _rows(own: PoseErrors, true: PoseErrors) -> tuple[AccuracyRow, ...]:
    both = own.usable & true.usable
    regular = both & (own.q[:, 4] > np.radians(REGULAR_DEG))
    rows = []
    for name in (*COORDINATES, "rotation"):
        at = regular if name in ("psi", "phi") and regular.any() else both
        e, f = own.part(at).of(name), true.part(at).of(name)
        difference = e - f if name in "xyz" else np.angle(np.exp(1j * (e - f)))
        size = np.abs(e) if e.size else np.array([np.nan])
        bias, scatter = (float(e.mean()), float(e.std())) if e.size else (np.nan, np.nan)
        within_95 = float(np.quantile(size, 0.95))
        claim = CLAIM_POSITION if name in "xyz" else CLAIM_ROTATION
        rows.append(AccuracyRow(name, len(e), bias, scatter, within_95, _rms(f), _rms(difference), claim))
    return tuple(rows)


def _strata_table(own: PoseErrors, law: float) -> str:
    """Rms errors of the poses in each stratum of nutation."""
    theta, rows = np.degrees(own.q[:, 4]), []
    for low, high in STRATA_DEG:
        some = own.part((theta >= low) & (theta < high))
        if len(some.q):
            angles = [_MDEG * _rms(some.of(name)) for name in ("rotation", "theta", "psi", "phi")]
            by_law = _MDEG * law / np.sin(np.radians(np.sqrt(low * high)))
            rows.append([f"{low:g}-{high:g}", len(some.q), _UM * _rms(some.of("position")), *angles, by_law])
    head = ["theta [deg]", "n", "position [µm]", "rotation [mdeg]", "theta [mdeg]", "psi [mdeg]", "phi [mdeg]"]
    law_column = f"{_MDEG * law:.2f} / sin(theta)"
    return table("As a function of nutation (static poses)", [*head, law_column], rows, "Root mean squares.", ".2f")


def _sight(own: PoseErrors, cameras: int) -> SightCount:
    found, gross = int(own.found.sum()), int(own.gross.sum())
    return SightCount(cameras, len(own.q), found, gross, _rms(own.of("position")), _rms(own.of("rotation")))


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")


def verdict(accuracy: Accuracy) -> str:
    """In which cases the claim holds and in which not, from the numbers."""
    rows = {row.quantity: row for row in accuracy.rows[STATIC]}
    position = max(rows[name].within_95 for name in "xyz")
    rotation = rows["rotation"].within_95
    two, one, _ = accuracy.sights
    held = [position <= CLAIM_POSITION, rotation <= CLAIM_ROTATION].count(True)
    name = ("does not hold", "holds in part", "holds")[held]
    text = (
        f"Where both cameras see the face, the claim of 0.005 mm and 0.05 deg {name}: 95 % of {two.n} poses lie within "
        f"{1e3 * position:.5f} mm per axis and {np.degrees(rotation):.4f} deg per rotation axis, calibration included. "
        "psi and phi alone scatter by "
        f"{_MDEG * accuracy.law:.2f} mdeg / sin(theta); 95 % lie within 0.05 deg above {accuracy.law_limit_deg:.1f} deg"
    )
    if one.found:
        beyond = "worse than the claim" if one.position > CLAIM_POSITION else "within the claim"
        text += f". Frames seen by one camera only are good to {1e3 * one.position:.3f} mm (rms), {beyond}"
    return text + "."


def complaints(accuracy: Accuracy) -> tuple[str, ...]:
    """Failures of the validation; empty if there are none."""
    found = [f"{s.gross} of {s.n} poses seen by {s.cameras} cameras are wrong" for s in accuracy.sights if s.gross]
    two = accuracy.sights[0]
    if two.found < two.n:
        found.append(f"{two.n - two.found} of {two.n} poses seen by both cameras were not found")
    for kind, rows in accuracy.rows.items():
        beyond = [r.quantity for r in rows if not r.within_95 <= r.claim and r.quantity not in ("psi", "phi")]
        found += [f"{kind}: 95 % of {quantity} lie beyond the claim" for quantity in beyond]
    for name, value in accuracy.consistency.items():
        slack = 3 * value.uncertainty  # for the sampling error with few poses or rigs
        if value.n and not CONSISTENT[0] - slack <= value.value <= CONSISTENT[1] + slack:
            found.append(
                f"{name}: squared error over predicted variance is {value.value:.2f} +- {value.uncertainty:.2f}"
            )
    return tuple(found)


def accuracy_validation(outcomes: Sequence[RenderedOutcome]) -> Validation:
    """All tables of recordings with static poses, and the verdict."""
    accuracy = sum_up(outcomes)
    tables = [_accuracy_table(name, rows) for name, rows in accuracy.rows.items()]
    static = joined(outcome.seen_by_both[0] for outcome in outcomes if outcome.name == STATIC)
    tables.append(_strata_table(static, accuracy.law))
    sights = [[s.cameras, s.n, s.found, s.gross, _UM * s.position, _MDEG * s.rotation] for s in accuracy.sights]
    head = ["cameras", "poses", "found", "wrong", "position rms [µm]", "rotation rms [mdeg]"]
    note = "0 cameras: the dots are seen at a grazing angle. There a pose need not be found; none may be wrong."
    tables.append(table("Who sees the face (static poses)", head, sights, note, ".2f"))
    consistency_rows = [[name, c.value, c.uncertainty, c.n] for name, c in accuracy.consistency.items()]
    head = ["squared error over predicted variance", "value", "standard error", "poses or rigs"]
    corners = ", ".join(f"{outcome.corners_px:.4f}" for outcome in outcomes)
    note = f"Target {CONSISTENT[0]} to {CONSISTENT[1]} within 3 standard errors. Corner rms by recording: {corners} px."
    tables.append(table("Errors against stated uncertainty", head, consistency_rows, note, ".2f"))
    warnings = sorted({warning for outcome in outcomes for warning in outcome.warnings})
    return Validation("validation", verdict(accuracy), tables, [accuracy], complaints(accuracy), warnings)


def _accuracy_table(name: str, rows: Sequence[AccuracyRow]) -> str:
    head = ["quantity", "unit", "n", "bias", "scatter", "95 %", "noise", "calibration", "claim / 95 %"]
    lines = []
    for row in rows:
        k, unit = (_UM, "µm") if row.quantity in "xyz" else (_MDEG, "mdeg")
        errors = (row.bias, row.scatter, row.within_95, row.noise_rms, row.calibration_rms)
        lines.append([row.quantity, unit, row.n, *(k * e for e in errors), f"{row.claim / row.within_95:.1f}"])
    note = "Rotation: the rotation vector between measured and true attitude."
    by_name = {row.quantity: row for row in rows}
    if by_name["psi"].n < by_name["theta"].n:
        note += f" psi and phi from {REGULAR_DEG:.0f} deg of nutation on."
    if name != STATIC:
        note = f"Exposure {1e3 * EXPOSURE:g} ms, corrected for by the smear of the dots."
    return table(f"{name[0].upper()}{name[1:]}", head, lines, note, ".2f")


def imperfect_validation(outcomes: Sequence[RenderedOutcome]) -> Validation:
    """Mean errors of recordings in an imperfect laboratory, with their stated uncertainty."""
    lines, consistency_rows = [], []
    unit = np.array(3 * [_UM] + 3 * [_MDEG])
    for outcome in outcomes:
        mean, sigma = outcome.own.mean()
        consistency_rows.append((mean / sigma) ** 2)
        means = [f"{e:.2f} +- {s:.2f}" for e, s in zip(mean * unit, sigma * unit, strict=True)]
        repeating = ", ".join(f"{rms:.4f}" for rms in outcome.systematic_px)
        lines.append([outcome.seed, *means, outcome.own.frame_to_frame(), repeating])
    lines.append(["squared error over variance", *np.mean(consistency_rows, axis=0), "", ""])
    head = ["seed", *POSE_COMPONENTS, "frame to frame, squared over stated", "repeating, px"]
    note = (
        "Mean error +- what is stated for it, in µm and mdeg. Below 1: the stated sigmas, which hold what board and "
        "lens may be off by, are larger than these errors."
    )
    headline = f"Mean errors in {len(outcomes)} recordings."
    return Validation("imperfect", headline, [table("Imperfect laboratory", head, lines, note, ".2f")], outcomes)
