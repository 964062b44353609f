"""A validation's numbers as Markdown for people and as JSON for programs."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from disctrack.files.json_text import plain
from disctrack.validate.comparison import QUANTITIES, Consistency
from disctrack.validate.efficiency import Efficiency
from disctrack.validate.summary import CONSISTENT, Summary, SummaryRow, complaints, verdict
from disctrack.validate.trial import EXPOSURE

_UM, _MDEG = 1e6, 180e3 / np.pi
_LENGTHS = ("x", "y", "z", "position")


def _unit(quantity: str) -> tuple[float, str]:
    return (_UM, "um") if quantity.split(" ")[0] in _LENGTHS else (_MDEG, "mdeg")


def _figure(value: float, digits: int = 2) -> str:
    return "-" if not np.isfinite(value) else f"{value:.{digits}f}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def markdown(summary: Summary) -> str:
    """All tables with the verdict on top."""
    parts = ["# Validation", verdict(summary)]
    bad = complaints(summary)
    parts.append("Not as it should be:\n\n" + "\n".join(f"- {line}" for line in bad) if bad else "No check has failed.")
    parts.append(
        f"{summary.recordings} recording(s), each with its own cameras and its own rendered chessboards, calibrated "
        "from these (corner residuals "
        + ", ".join(f"{rms:.4f}" for rms in summary.calibration_rms_px)
        + " px), never with the true cameras unless a column says so. Lengths in um, angles in mdeg; the claim is "
        "5 um and 50 mdeg. Rotation: the rotation vector between measured and true attitude, per axis."
    )
    for kind, rows in summary.rows.items():
        parts += [f"## {kind[0].upper()}{kind[1:]}, face seen by both cameras", accuracy_table(rows)]
    if len(summary.rows) > 1:
        parts.append(
            f"Exposure while rolling: {1e3 * EXPOSURE:g} ms. An image shows the mean attitude of the exposure, "
            "not the attitude at its middle: theta appears smaller by sin(theta) (psidot exposure)^2 / 24, which no "
            "covariance of the noise contains."
        )
    parts += ["## As a function of nutation (static poses, both cameras)", _strata_table(summary)]
    parts += ["## Who sees the face (static poses)", _sight_table(summary)]
    if summary.efficiency is not None:
        parts += ["## Beside the Cramer-Rao bound", _efficiency_table(summary.efficiency)]
    parts += ["## Honesty of the reported covariance", _consistency_table(summary)]
    if summary.stresses:
        parts += ["## Raised until the claim fails", _stress_table(summary)]
    if summary.controls:
        parts += ["## Planted faults", _control_table(summary)]
    if summary.warnings:
        parts += ["## Warnings of the measurement", "\n".join(f"- {line}" for line in summary.warnings)]
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


def accuracy_table(rows: Sequence[SummaryRow]) -> str:
    """Bias, scatter, 95 %, maximum, both shares, bound and claim of each quantity."""
    head = ["quantity", "unit", "n", "bias", "scatter", "95 %", "max", "noise rms (true cameras)",
            "calibration rms", "bound", "claim", "claim / 95 %"]  # fmt: skip
    lines = []
    for row in rows:
        k, unit = _unit(row.quantity)
        t = row.total
        figures = [t.bias, t.scatter, t.within_95, t.largest, row.noise.rms, row.calibration.rms, row.bound]
        lines.append([row.quantity, unit, str(t.n), *(_figure(k * v) for v in figures),
                      _figure(k * row.claim, 0), _figure(row.claim / t.within_95, 1)])  # fmt: skip
    return _table(head, lines)


def _strata_table(summary: Summary) -> str:
    names = ("position", "rotation", "theta", "psi", "phi")
    head = ["theta [deg]", "n", *(f"{name} rms [{_unit(name)[1]}]" for name in names), "psi noise rms [mdeg]",
            f"law {_MDEG * summary.law:.2f} / sin(theta) [mdeg]"]  # fmt: skip
    lines = []
    for s in summary.strata:
        law = summary.law / np.sin(np.radians(np.sqrt(s.theta_deg[0] * s.theta_deg[1])))
        lines.append([f"{s.theta_deg[0]:g}-{s.theta_deg[1]:g}", str(s.n),
                      *(_figure(_unit(name)[0] * s.rms[name]) for name in names),
                      _figure(_MDEG * s.noise["psi"]), _figure(_MDEG * law)])  # fmt: skip
    return _table(head, lines)


def _sight_table(summary: Summary) -> str:
    lines = [
        [str(s.cameras), str(s.n), str(s.found), str(s.gross), _figure(_UM * s.position), _figure(_MDEG * s.rotation)]
        for s in summary.sights
    ]
    head = ["cameras", "poses", "found", "wrong", "position rms [um]", "rotation rms [mdeg]"]
    note = "A pose that no camera can see is rightly without an answer; it does not count as a failure.\n"
    return _table(head, lines) + "\n" + note


def _efficiency_table(e: Efficiency) -> str:
    head = ["theta [deg]", "", *(f"{name} [{_unit(name)[1]}]" for name in QUANTITIES), "excess"]
    lines = []
    for k, q in enumerate(e.q):
        for label, values in (("bound, dots", e.bound), ("bound, whole image", e.bound_image),
                              ("scatter", e.scatter), ("reported sigma", e.reported), ("bias", e.bias)):  # fmt: skip
            first = label.startswith("bound, d")
            lines.append([
                f"{np.degrees(q[4]):.2f}" if first else "", label,
                *(_figure(_unit(name)[0] * values[k, i]) for i, name in enumerate(QUANTITIES)),
                _figure(e.excess[k]) if first else "",
            ])  # fmt: skip
    note = (
        f"{e.copies} noisy copies of each pose, true cameras. Efficiency (bound over scatter, all components, the "
        f"{int(e.judged.sum())} of {len(e.q)} poses in which every dot was used) "
        f"{e.efficiency:.3f} +- {e.efficiency_uncertainty:.3f}. The bound takes light, blur and the dots' size as "
        "known; the method fits them for each dot.\n"
    )
    return _table(head, lines) + "\n" + note


def _consistency_table(summary: Summary) -> str:
    def line(name: str, c: Consistency) -> list[str]:
        return [name, _figure(c.value), _figure(c.uncertainty), str(c.n)]

    rows = [line(f"noise, {name} (true cameras)", c) for name, c in summary.noise_consistency.items()]
    rows.append(line("calibration (own - true cameras, same images)", summary.calibration_consistency))
    head = ["squared error over predicted variance", "value", "standard error by chance", "poses or rigs"]
    return _table(head, rows) + f"\nTarget {CONSISTENT[0]} to {CONSISTENT[1]}.\n"


def _stress_table(summary: Summary) -> str:
    lines = []
    for s in summary.stresses:
        low, high = s.fails_between
        where = f"between {low:.3g} and {high:.3g}" if np.isfinite(high) else f"not up to {low:.3g}"
        lines.append([s.name, s.unit, where, s.broken])
    return _table(["disturbance", "unit", "claim fails", "what fails"], lines)


def _control_table(summary: Summary) -> str:
    lines = [
        [
            c.fault,
            "yes" if c.must_be_noticed else "no",
            "; ".join([*c.alarms, *(["errors beyond the claim"] if c.claim_fails else [])]) or "nothing",
            _figure(_UM * c.position),
            _figure(_MDEG * c.rotation),
            "yes" if c.as_expected else "NO",
        ]
        for c in summary.controls
    ]
    head = ["fault", "must be noticed", "what is seen", "position rms [um]", "rotation rms [mdeg]", "as expected"]
    return _table(head, lines)


def as_json(summary: Summary) -> dict[str, Any]:
    """The summary in JSON's types, SI and radians, with verdict and complaints."""
    tree = asdict(summary)
    for stress, table in zip(summary.stresses, tree["stresses"], strict=True):
        table["broken"] = stress.broken
    for control, table in zip(summary.controls, tree["controls"], strict=True):
        table["as_expected"] = control.as_expected
    if summary.efficiency is not None:
        tree["efficiency"]["value"] = summary.efficiency.efficiency
        tree["efficiency"]["uncertainty"] = summary.efficiency.efficiency_uncertainty
        tree["efficiency"]["quantities"] = list(QUANTITIES)
    head = {"units": "SI, radians", "verdict": verdict(summary), "complaints": list(complaints(summary))}
    return {
        **head,
        "psi_phi_limit_deg": {"rms": summary.law_limit_deg(1), "95 %": summary.law_limit_deg(2)},
        **plain(tree),
    }
