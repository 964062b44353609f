"""One arm that swings freely for 55 s (Kaheman et al. 2022): what does viscous friction alone lack?

    python -m disctrack.examples.pendulum FOLDER [-o DIR]

FOLDER holds `single_free_swing.npz` (time_s, angle_rad from the upright position). As the authors do, the first
36.668 s are fitted, and the rest is for validation. A free swing determines only the ratios stiffness = a1 g m1 / (m1
a1^2 + I1) and viscous = k1 / (m1 a1^2 + I1) of their parameters.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from disctrack.discrepancy.equations import Equations, Run, Term, diagnose, terms
from disctrack.examples._command import Outcome, command
from disctrack.numbers import rounded
from disctrack.report.blocks import Listing, Section

FITTED_S = 36.668  # by the authors; the rest is their validation
STEP = 0.157e-3  # [rad] of the encoder
_INERTIA = 0.147585 * 0.147755**2 + 1.09119e-4  # m1 a1^2 + I1 [kg m^2]
PENDULUM = Equations(
    rates={"angle": "rate", "rate": "-stiffness*sin(angle) - viscous*rate"},
    parameters={"stiffness": 0.147755 * 9.81001 * 0.147585 / _INERTIA, "viscous": 2.2394e-4 / _INERTIA},
    units={"angle": "rad"},
    name="a pendulum with viscous friction",
)
MISSING = (
    terms.coulomb("rate"),
    terms.quadratic("rate"),
    terms.constant("rate"),
    terms.cubic_spring("rate", "angle"),
    terms.sensor_scale("angle"),
    terms.sensor_drift("angle"),
    Term("loaded_bearing", {"rate": "-c*sign(rate)*abs(cos(angle) + rate**2/stiffness)"}, parameters={"c": 0.0},
         title="dry friction in proportion to the bearing's load"),
    Term("eccentric_encoder", observed={"angle": "a*sin(angle) + b*(cos(angle) - 1)"},
         parameters={"a": 0.0, "b": 0.0}, title="encoder off its centre"),
)  # fmt: skip


def example(folder: Path) -> Outcome:
    """What does a pendulum with viscous friction lack, and do the effects found predict the rest of its swing?"""
    with np.load(folder / "single_free_swing.npz") as file:
        time, angle = file["time_s"], file["angle_rad"] - np.pi  # from hanging
    fitted = time <= FITTED_S
    answer = diagnose(PENDULUM, Run(time[fitted], {"angle": angle[fitted]}, name="swing"), MISSING)
    rms = dict[str, list[float]]()
    for side in ("before", "after"):
        left = angle - answer.forecast(Run(time, {"angle": angle}, name="swing"), by=side)["angle"]
        rms[side] = [float(np.sqrt(np.mean(left[rows] ** 2))) for rows in (fitted, ~fitted)]
    data = {**answer.document(), "kept_back_rms_rad": {side: kept_back for side, (_, kept_back) in rms.items()}}
    rms["quantisation of the encoder"] = [STEP / np.sqrt(12)] * 2
    rows = [(name, *(rounded(1e3 * x) for x in both)) for name, both in rms.items()]
    header = ("", f"fitted, 0 to {FITTED_S} s", "predicted, from there to 55 s")
    kept = Section("Rms of measured minus modelled (mrad)", [Listing(header, rows)])
    report = answer.report()
    return replace(report, blocks=[kept, *report.blocks], data=data), {"swing": answer}


if __name__ == "__main__":
    command(example, "single_free_swing.npz")
