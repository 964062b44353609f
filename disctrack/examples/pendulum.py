"""One arm that swings freely for 55 s (Kaheman et al. 2022): what does viscous friction alone lack?

    python -m disctrack.examples.pendulum FOLDER [-o DIR]

FOLDER holds `single_free_swing.npz` (time_s, angle_rad from the upright position). The authors fit the first 36.668 s
and keep the rest for validation; so is it done here. Only the ratios stiffness = a1 g m1 / (m1 a1^2 + I1) and viscous =
k1 / (m1 a1^2 + I1) of their numbers can be told from a free swing.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from calibration.kit.arrays import Array, Mask
from disctrack.discrepancy.equations import Answer, Equations, Run, Term, diagnose, terms
from disctrack.errors import AnalysisError
from disctrack.examples._command import Outcome, command
from disctrack.report.figures import panels
from disctrack.report.palette import BLUE, MUTED, RED

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


def swing(folder: Path) -> tuple[Array, Array]:
    """Time [s] and angle [rad] from hanging. Raises AnalysisError."""
    path = Path(folder) / "single_free_swing.npz"
    if not path.is_file():
        raise AnalysisError(f"{path}: not there. Name the folder that holds single_free_swing.npz.")
    with np.load(path) as data:
        return data["time_s"], data["angle_rad"] - np.pi


def asked(time: Array, angle: Array, last: float) -> Answer:
    """The diagnosis of the swing up to an instant [s]."""
    rows = time <= last
    return diagnose(PENDULUM, Run(time[rows], {"angle": angle[rows]}, name="swing"), MISSING)


def forecasts(answer: Answer, time: Array, angle: Array) -> dict[str, Array]:
    """Measured minus modelled angle [rad] over the whole swing, by model: what was kept back is foretold."""
    run = Run(time, {"angle": angle}, name="swing")
    return {side: angle - answer.forecast(run, before=side == "before")["angle"] for side in ("before", "after")}


def table(answer: Answer, left: dict[str, Array], kept: Mask) -> str:
    """Before and after, for people."""
    best = 1e3 * STEP / np.sqrt(12)
    lines = [str(answer), "", f"{'rms [mrad]':<38}{'before':>10}{'after':>10}"]
    for name, rows in (("fitted, 0 to 36.668 s", ~kept), ("kept back, 36.668 to 55 s, foretold", kept)):
        lines.append(f"{name:<38}" + "".join(f"{1e3 * _rms(x[rows]):10.3g}" for x in left.values()))
    lines.append(f"{'the step of the encoder allows':<38}{best:10.3g}{best:10.3g}")
    return "\n".join(lines)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))


def example(folder: Path) -> Outcome:
    """What does a pendulum with viscous friction lack, and does what is found foretell the rest of its swing?"""
    time, angle = swing(folder)
    answer = asked(time, angle, FITTED_S)
    left, kept = forecasts(answer, time, angle), time > FITTED_S
    document = answer.document() | {
        "kept_back_rms_rad": {side: _rms(x[kept]) for side, x in left.items()},
        "encoder_rms_rad": STEP / np.sqrt(12),
    }
    return Outcome(table(answer, left, kept), document, figure(time, angle, left))


def figure(time: Array, angle: Array, left: dict[str, Array]) -> Figure:
    """The swing, and what the models leave of it: fitted up to the line, foretold after it."""
    picture, (top, bottom) = panels(9, 6, 2, sharex=True)
    thin = slice(None, None, 10)
    top.plot(time[thin], angle[thin], lw=0.7, color=MUTED)
    for (side, x), colour in zip(left.items(), (RED, BLUE), strict=True):
        bottom.plot(time[thin], 1e3 * x[thin], lw=0.7, color=colour, label=side)
    for axes in (top, bottom):
        axes.axvline(FITTED_S, color=MUTED, lw=1, ls="--")
    top.set(ylabel="angle [rad]")
    bottom.set(ylabel="measured - model [mrad]", xlabel="time [s]")
    bottom.legend(frameon=False)
    return picture


main = partial(command, "pendulum", "single_free_swing.npz", example)


if __name__ == "__main__":
    sys.exit(main())
