"""One arm that swings freely for 55 s (Kaheman et al. 2022): what does viscous friction alone lack?

    python -m disctrack.examples.pendulum FOLDER [-o DIR]

FOLDER holds `single_free_swing.npz` (time_s, angle_rad from the upright position). The authors fit the first 36.668 s
and keep the rest for validation; so is it done here. Only the ratios stiffness = a1 g m1 / (m1 a1^2 + I1) and viscous =
k1 / (m1 a1^2 + I1) of their numbers can be told from a free swing.
"""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from disctrack.discrepancy.equations import Answer, Equations, Run, Term, diagnose, terms
from disctrack.examples._command import Outcome, command, needed
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


def swing(folder: Path) -> Run:
    """Angle [rad] from hanging. Raises AnalysisError."""
    with np.load(needed(folder, "single_free_swing.npz")) as data:
        return Run(data["time_s"], {"angle": data["angle_rad"] - np.pi}, name="swing")


def asked(run: Run) -> Answer:
    """The diagnosis of the swing as far as the authors fit it."""
    time, angle = np.asarray(run.time), np.asarray(run.data["angle"])
    rows = time <= FITTED_S
    return diagnose(PENDULUM, Run(time[rows], {"angle": angle[rows]}, name=run.name), MISSING)


def rms_left(answer: Answer, run: Run) -> dict[str, tuple[float, float]]:
    """Rms [rad] of measured minus modelled angle, by model: of what was fitted, and of what was kept back."""
    kept = np.asarray(run.time) > FITTED_S
    found = {}
    for side in ("before", "after"):
        left = np.asarray(run.data["angle"]) - answer.forecast(run, by=side)["angle"]
        found[side] = float(np.sqrt(np.mean(left[~kept] ** 2))), float(np.sqrt(np.mean(left[kept] ** 2)))
    return found


def example(folder: Path) -> Outcome:
    """What does a pendulum with viscous friction lack, and does what is found predict the rest of its swing?"""
    run = swing(folder)
    answer = asked(run)
    left, encoder = rms_left(answer, run), STEP / np.sqrt(12)
    parts = ("fitted, 0 to 36.668 s", "kept back, 36.668 to 55 s, predicted")
    rows = [(name, *(rounded(1e3 * rms[i]) for rms in left.values())) for i, name in enumerate(parts)]
    rows.append(("the step of the encoder allows", rounded(1e3 * encoder), rounded(1e3 * encoder)))
    kept = Section("Rms of measured minus modelled (mrad)", [Listing(("", "before", "after"), rows)])
    told = answer.report()
    data = {**answer.document(), "kept_back_rms_rad": {side: rms[1] for side, rms in left.items()}}
    return replace(told, blocks=[kept, *told.blocks], data=data), {"swing": answer}


main = partial(command, "pendulum", "single_free_swing.npz", example)


if __name__ == "__main__":
    sys.exit(main())
