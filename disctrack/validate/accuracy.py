"""Test of the claimed accuracy of 0.005 mm and 0.05 deg: the numbers, and a sentence that follows from them."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from calibration.kit.types import Array
from disctrack.analyse.declaration import CLAIM_POSITION
from disctrack.frames import COORDINATES, POSE_COMPONENTS
from disctrack.trajectory import joined, part
from disctrack.validate.rendered import EXPOSURE, STATIC, STRATA_DEG, PoseErrors, RenderedOutcome
from disctrack.validate.tables import Validation, grouped, table

PER_SI = {"µm": 1e6, "mdeg": 180e3 / np.pi}
CLAIM = {"µm": 1e6 * CLAIM_POSITION, "mdeg": 50.0}  # for 95 % of the errors: Ma et al. 2014, end of section 3
LAW_DEG = 20.0  # largest nutation for the fit of 1/sin(theta); above, errors depend more on the cameras' directions
CONSISTENT = (0.8, 1.25)
Row = dict[str, float]  # numbers by the heads of their columns; lengths and angles in the units named there


class Accuracy:
    """Summary of recordings, some with static poses."""

    def __init__(self, outcomes: Sequence[RenderedOutcome]) -> None:
        """Errors of the poses in which both cameras see the face; of the static poses, also of the others."""
        kinds = grouped(outcomes, lambda outcome: outcome.name)
        pairs = {name: [outcome.seen_by_both for outcome in alike] for name, alike in kinds.items()}
        both = {name: [joined(errors) for errors in zip(*some, strict=True)] for name, some in pairs.items()}
        self.rows = {name: dict(_rows(*pair)) for name, pair in both.items()}
        static, noise = both[STATIC]
        law = part(noise, noise.usable & (noise.q[:, 4] < np.radians(LAW_DEG)))
        # [mdeg] c of sigma(psi) = c / sin(theta)
        self.law = PER_SI["mdeg"] * _rms(law.angles[:, [0, 2]] * np.sin(law.q[:, 4])[:, None])
        # nutation [deg] below which two sigmas of psi and of phi exceed the claim
        self.law_limit_deg = float(np.degrees(np.arcsin(min(1.0, 2 * self.law / CLAIM["mdeg"]))))
        # by the number of cameras that see the upper face, and if both do, by nutation
        theta = np.degrees(static.q[:, 4])
        self.sights = {str(n): _size(joined(part(o.own, o.cameras == n) for o in kinds[STATIC])) for n in (2, 1, 0)}
        strata = {f"2, {a:g} to {b:g} deg": part(static, (a <= theta) & (theta < b)) for a, b in STRATA_DEG}
        self.sights |= {name: _size(some) for name, some in strata.items()}
        self.consistency = {f"noise, {name} (true cameras)": noise_consistency(e) for name, (_, e) in both.items()}
        of_calibration = calibration_consistency(pairs[STATIC])
        self.consistency["calibration, static poses (own - true cameras, same images)"] = of_calibration


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")


def _rows(own: PoseErrors, true: PoseErrors) -> Iterator[tuple[str, Row]]:
    """Errors of each quantity: in total, and from noise and calibration, from the same images."""
    both = own.usable & true.usable
    for name in (*COORDINATES, "rotation"):
        e, f = part(own, both).of(name), part(true, both).of(name)
        n, e, f = len(e), *(values if values.size else np.array([np.nan]) for values in (e, f))
        unit, d = ("µm", e - f) if name in "xyz" else ("mdeg", np.angle(np.exp(1j * (e - f))))
        # noise : with the true cameras
        errors = {"bias": e.mean(), "scatter": e.std(), "95 %": np.quantile(np.abs(e), 0.95), "noise": _rms(f)}
        errors = {column: float(PER_SI[unit] * x) for column, x in (errors | {"calibration": _rms(d)}).items()}
        yield f"{name} [{unit}]", {"n": n, **errors, "claim / 95 %": CLAIM[unit] / errors["95 %"]}


def _size(some: PoseErrors) -> Row:
    """Number of poses, and rms of their errors."""
    found, wrong = some.found.sum(), (some.found & ~some.usable).sum()
    counts = {"poses": len(some.q), "found": int(found), "wrong": int(wrong)}
    units = {"position": "µm", **dict.fromkeys(("rotation", "theta", "psi", "phi"), "mdeg")}
    return counts | {f"{name} [{unit}]": PER_SI[unit] * _rms(some.of(name)) for name, unit in units.items()}


def squared(error: Array, covariance: Array) -> Array:
    """(n,) e^T C^-1 e / 6 of errors (n, 6), on average 1 with the correct covariance C (n, 6, 6)."""
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 6


def consistency(values: Sequence[float] | Array) -> dict[str, float]:
    """Mean of `squared` over poses or rigs, and its standard error if the reported covariance is correct."""
    n = len(values)
    value = float(np.mean(values)) if n else float("nan")
    return {"value": value, "standard error": float(np.sqrt(2 / (6 * max(n, 1)))), "poses or rigs": n}


def noise_consistency(errors: PoseErrors) -> dict[str, float]:
    """Squared error over the reported variance of the noise; the errors must be free of calibration errors."""
    return consistency(squared(errors.error, errors.covariance)[errors.usable])


def calibration_consistency(pairs: Iterable[tuple[PoseErrors, PoseErrors]]) -> dict[str, float]:
    """Squared calibration error over its reported variance, from the same images measured with two rigs.

    pairs : poses of each recording with its own calibration and with the true cameras. Both have the same image noise,
    so their difference is the calibration error alone. It is common to a recording, which therefore counts once, with
    the mean over its poses.
    """
    of_rigs = (squared(a.error - b.error, a.calibration_covariance)[a.usable & b.usable] for a, b in pairs)
    return consistency([float(values.mean()) for values in of_rigs if len(values)])


def verdict(accuracy: Accuracy) -> str:
    """In which cases the claim holds and in which not, from the numbers."""
    rows, two, one = accuracy.rows[STATIC], accuracy.sights["2"], accuracy.sights["1"]
    position, rotation = max(rows[f"{axis} [µm]"]["95 %"] for axis in "xyz"), rows["rotation [mdeg]"]["95 %"]
    held = [position <= CLAIM["µm"], rotation <= CLAIM["mdeg"]].count(True)
    name = ("does not hold", "holds in part", "holds")[held]
    text = (
        f"Where both cameras see the face, the claim of 0.005 mm and 0.05 deg {name}: 95 % of {two['poses']} poses lie "
        f"within {1e-3 * position:.5f} mm per axis and {1e-3 * rotation:.4f} deg per rotation axis, calibration "
        f"included. psi and phi alone scatter by {accuracy.law:.2f} mdeg / sin(theta); 95 % lie within 0.05 deg above "
        f"{accuracy.law_limit_deg:.1f} deg"
    )
    if one["found"]:
        text += f". Frames seen by one camera only are good to {1e-3 * one['position [µm]']:.3f} mm (rms)"
    return text + "."


def complaints(accuracy: Accuracy) -> Iterator[str]:
    """Failures of the validation."""
    for seen_by, sight in accuracy.sights.items():
        if sight["wrong"]:
            yield f"{sight['wrong']} of {sight['poses']} static poses are wrong (cameras, theta: {seen_by})"
    two = accuracy.sights["2"]
    if two["found"] < two["poses"]:
        yield f"{two['poses'] - two['found']} of {two['poses']} poses seen by both cameras were not found"
    for kind, rows in accuracy.rows.items():
        for quantity, row in rows.items():
            if not row["claim / 95 %"] >= 1 and not quantity.startswith(("psi", "phi")):
                yield f"{kind}: 95 % of {quantity.split()[0]} lie beyond the claim"
    for name, c in accuracy.consistency.items():
        slack = 3 * c["standard error"]  # for the sampling error with few poses or rigs
        if c["poses or rigs"] and not CONSISTENT[0] - slack <= c["value"] <= CONSISTENT[1] + slack:
            yield f"{name}: squared error over predicted variance is {c['value']:.2f} +- {c['standard error']:.2f}"


def accuracy_validation(outcomes: Sequence[RenderedOutcome]) -> Validation:
    """All tables of recordings with static poses, and the verdict."""
    accuracy = Accuracy(outcomes)
    note = f"psi and phi: see nutation below. Rolling: {1e3 * EXPOSURE:g} ms exposed, corrected for by the dots' smear."
    tables = [table(name.capitalize(), "quantity", rows, note, ".2f") for name, rows in accuracy.rows.items()]
    note = "0 cameras: the dots are seen at a grazing angle. There a pose need not be found; none may be wrong."
    title, of = "Who sees the face, and nutation (static poses, rms)", "cameras, theta"
    tables.append(table(title, of, accuracy.sights, note, ".2f"))
    note = f"Target {CONSISTENT[0]} to {CONSISTENT[1]} within 3 standard errors."
    title, of = "Errors against stated uncertainty", "squared error over predicted variance"
    tables.append(table(title, of, accuracy.consistency, note, ".2f"))
    warnings = sorted({warning for outcome in outcomes for warning in outcome.warnings})
    return Validation("validation", verdict(accuracy), tables, [accuracy], [*complaints(accuracy)], warnings)


def imperfect_validation(outcomes: Sequence[RenderedOutcome]) -> Validation:
    """Mean errors of recordings in an imperfect laboratory, with their stated uncertainty."""
    rows: dict[str, dict[str, object]] = {}
    unit = np.repeat([PER_SI["µm"], PER_SI["mdeg"]], 3)
    means = [outcome.own.mean() for outcome in outcomes]
    for outcome, (mean, sigma) in zip(outcomes, means, strict=True):
        stated = [f"{e:.2f} +- {s:.2f}" for e, s in zip(mean * unit, sigma * unit, strict=True)]
        rows[str(outcome.seed)] = dict(zip(POSE_COMPONENTS, stated, strict=True)) | {
            "frame to frame, squared over stated": outcome.own.frame_to_frame(),
            "repeating, px": ", ".join(f"{rms:.4f}" for rms in outcome.systematic_px),
        }
    squared = np.mean([(mean / sigma) ** 2 for mean, sigma in means], axis=0)
    rows["squared error over variance"] = dict(zip(POSE_COMPONENTS, squared.tolist(), strict=True))
    note = (
        "Mean error +- what is stated for it, in µm and mdeg. Below 1: the stated sigmas, which hold what board and "
        "lens may be off by, are larger than these errors."
    )
    headline = f"Mean errors in {len(outcomes)} recordings."
    return Validation("imperfect", headline, [table("Imperfect laboratory", "seed", rows, note, ".2f")], outcomes)
