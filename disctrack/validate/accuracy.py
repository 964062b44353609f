"""Test of the claimed accuracy of 0.005 mm and 0.05 deg: the numbers, and a sentence that follows from them."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from calibration.kit.arrays import Array
from disctrack.analyse.declaration import CLAIM_POSITION
from disctrack.frames import COORDINATES, POSE_COMPONENTS
from disctrack.validate.errors import PoseErrors, calibration_consistency, joined, noise_consistency
from disctrack.validate.rendered import EXPOSURE, STATIC, STRATA_DEG, RenderedOutcome
from disctrack.validate.tables import Validation, table

PER_SI = {"µm": 1e6, "mdeg": 180e3 / np.pi}
CLAIM = {"µm": 1e6 * CLAIM_POSITION, "mdeg": 50.0}  # for 95 % of the errors: Ma et al. 2014, end of section 3
LAW_DEG = 20.0  # largest nutation for the fit of 1/sin(theta); above, errors depend more on the cameras' directions
CONSISTENT = (0.8, 1.25)
Row = dict[str, float]  # numbers by the heads of their columns; lengths and angles in the units named there


class Accuracy:
    """Summary of recordings, some with static poses."""

    def __init__(self, outcomes: Sequence[RenderedOutcome]) -> None:
        """Errors of the poses in which both cameras see the face; of the static poses, also of the others."""
        names = dict.fromkeys(outcome.name for outcome in outcomes)
        pairs = {name: [outcome.seen_by_both for outcome in outcomes if outcome.name == name] for name in names}
        both = {name: [joined(errors) for errors in zip(*some, strict=True)] for name, some in pairs.items()}
        self.rows = {name: dict(_rows(*pair)) for name, pair in both.items()}
        static, noise = both[STATIC]
        law = noise.part(noise.usable & (noise.q[:, 4] < np.radians(LAW_DEG)))
        # [mdeg] c of sigma(psi) = c / sin(theta)
        self.law = PER_SI["mdeg"] * _rms(law.angles[:, [0, 2]] * np.sin(law.q[:, 4])[:, None])
        self.strata = dict(_strata(static, self.law))
        # by the number of cameras that see the upper face
        at_rest = [outcome for outcome in outcomes if outcome.name == STATIC]
        self.sights = {n: _sight(joined(o.own.part(o.cameras == n) for o in at_rest)) for n in (2, 1, 0)}
        of_calibration = calibration_consistency(pairs[STATIC])
        self.consistency = {
            f"noise, {name} (true cameras)": noise_consistency(true) for name, (_, true) in both.items()
        }
        self.consistency["calibration, static poses (own - true cameras, same images)"] = of_calibration

    @property
    def law_limit_deg(self) -> float:
        """Nutation [deg] below which two sigmas of psi and of phi exceed the claim."""
        return float(np.degrees(np.arcsin(min(1.0, 2 * self.law / CLAIM["mdeg"]))))


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")


def _rows(own: PoseErrors, true: PoseErrors) -> Iterator[tuple[str, Row]]:
    """Errors of each quantity: in total, and from noise and calibration, from the same images."""
    both = own.usable & true.usable
    for name in (*COORDINATES, "rotation"):
        e, f = own.part(both).of(name), true.part(both).of(name)
        n, e, f = len(e), *(values if values.size else np.array([np.nan]) for values in (e, f))
        unit, d = ("µm", e - f) if name in "xyz" else ("mdeg", np.angle(np.exp(1j * (e - f))))
        # noise : with the true cameras
        errors = {"bias": e.mean(), "scatter": e.std(), "95 %": np.quantile(np.abs(e), 0.95), "noise": _rms(f)}
        errors = {column: float(PER_SI[unit] * x) for column, x in (errors | {"calibration": _rms(d)}).items()}
        yield f"{name} [{unit}]", {"n": n, **errors, "claim / 95 %": CLAIM[unit] / errors["95 %"]}


def _rms_of(errors: PoseErrors, *quantities: str) -> Row:
    units = {name: "µm" if name == "position" else "mdeg" for name in quantities}
    return {f"{name} [{unit}]": PER_SI[unit] * _rms(errors.of(name)) for name, unit in units.items()}


def _strata(own: PoseErrors, law: float) -> Iterator[tuple[str, Row]]:
    """Errors of the poses in each stratum of nutation."""
    theta = np.degrees(own.q[:, 4])
    for low, high in STRATA_DEG:
        some = own.part((theta >= low) & (theta < high))
        by_law = {f"{law:.2f} / sin(theta)": law / np.sin(np.radians(np.sqrt(low * high)))}
        if len(some.q):
            found = _rms_of(some, "position", "rotation", "theta", "psi", "phi")
            yield f"{low:g}-{high:g}", {"n": len(some.q), **found, **by_law}


def _sight(some: PoseErrors) -> Row:
    counts = {"poses": len(some.q), "found": int(some.found.sum()), "wrong": int(some.gross.sum())}
    return counts | _rms_of(some, "position", "rotation")


def verdict(accuracy: Accuracy) -> str:
    """In which cases the claim holds and in which not, from the numbers."""
    rows, two, one = accuracy.rows[STATIC], accuracy.sights[2], accuracy.sights[1]
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
        by_one = one["position [µm]"]
        beyond = "worse than the claim" if by_one > CLAIM["µm"] else "within the claim"
        text += f". Frames seen by one camera only are good to {1e-3 * by_one:.3f} mm (rms), {beyond}"
    return text + "."


def complaints(accuracy: Accuracy) -> Iterator[str]:
    """Failures of the validation."""
    for cameras, sight in accuracy.sights.items():
        if sight["wrong"]:
            yield f"{sight['wrong']} of {sight['poses']} poses seen by {cameras} cameras are wrong"
    two = accuracy.sights[2]
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


def _table(title: str, of: str, rows: Mapping[str, Row] | Mapping[int, Row], note: str) -> str:
    """Rows with the same columns below what they are of."""
    return table(
        title, [of, *next(iter(rows.values()))], [[name, *row.values()] for name, row in rows.items()], note, ".2f"
    )


def accuracy_validation(outcomes: Sequence[RenderedOutcome]) -> Validation:
    """All tables of recordings with static poses, and the verdict."""
    accuracy, tables = Accuracy(outcomes), []
    for name, rows in accuracy.rows.items():
        note = "Rotation: the rotation vector between measured and true attitude. psi and phi: see below, by nutation."
        if name != STATIC:
            note = f"Exposure {1e3 * EXPOSURE:g} ms, corrected for by the smear of the dots."
        tables.append(_table(f"{name[0].upper()}{name[1:]}", "quantity", rows, note))
    tables.append(_table("As a function of nutation (static poses, rms)", "theta [deg]", accuracy.strata, ""))
    note = "0 cameras: the dots are seen at a grazing angle. There a pose need not be found; none may be wrong."
    tables.append(_table("Who sees the face (static poses, rms)", "cameras", accuracy.sights, note))
    corners = ", ".join(f"{outcome.corners_px:.4f}" for outcome in outcomes)
    note = f"Target {CONSISTENT[0]} to {CONSISTENT[1]} within 3 standard errors. Corner rms by recording: {corners} px."
    title, of = "Errors against stated uncertainty", "squared error over predicted variance"
    tables.append(_table(title, of, accuracy.consistency, note))
    warnings = sorted({warning for outcome in outcomes for warning in outcome.warnings})
    return Validation("validation", verdict(accuracy), tables, [accuracy], [*complaints(accuracy)], warnings)


def imperfect_validation(outcomes: Sequence[RenderedOutcome]) -> Validation:
    """Mean errors of recordings in an imperfect laboratory, with their stated uncertainty."""
    lines, squared = [], []
    unit = np.repeat([PER_SI["µm"], PER_SI["mdeg"]], 3)
    for outcome in outcomes:
        mean, sigma = outcome.own.mean()
        squared.append((mean / sigma) ** 2)
        means = [f"{e:.2f} +- {s:.2f}" for e, s in zip(mean * unit, sigma * unit, strict=True)]
        repeating = ", ".join(f"{rms:.4f}" for rms in outcome.systematic_px)
        lines.append([outcome.seed, *means, outcome.own.frame_to_frame(), repeating])
    lines.append(["squared error over variance", *np.mean(squared, axis=0), "", ""])
    head = ["seed", *POSE_COMPONENTS, "frame to frame, squared over stated", "repeating, px"]
    note = (
        "Mean error +- what is stated for it, in µm and mdeg. Below 1: the stated sigmas, which hold what board and "
        "lens may be off by, are larger than these errors."
    )
    headline = f"Mean errors in {len(outcomes)} recordings."
    return Validation("imperfect", headline, [table("Imperfect laboratory", head, lines, note, ".2f")], outcomes)
