"""How the standard deviations of effects fall with the number of recordings that are diagnosed together.

    python -m disctrack.diagnosis.trials.together --recordings 50

Recordings are drawn as those of `trials.rates`, all of one disc on one surface, filmed by one rig with one calibration
error. They are fitted together without any effect; the derivatives by every effect there say how well it is known.
"""

import argparse
from dataclasses import replace

from disctrack.diagnosis.together.recordings import Item, Recorded, build, labels_of
from disctrack.diagnosis.trials.hidden_effects import Planted
from disctrack.diagnosis.trials.rates import FRAME_RATE, draw, trajectory_of
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.joint.crew import Crew
from disctrack.discrepancy.joint.joint_system import JointSystem
from disctrack.discrepancy.joint.sharing import Sharing
from disctrack.discrepancy.joint.together import sigmas_of_first
from disctrack.errors import DiscTrackError

NUMBERS = (1, 2, 5, 10, 20, 50, 100)
K_M = 0.381e-7  # [m s^2] of all: one disc on one surface
AIR = ("air_moffatt", "air_bildsten", "air_quadratic", "air_spin", "drag_rotation", "drag_linear")
OTHERS = ("kn", "rolling_power", "contour_viscous", "pivoting_contensou", "inertia_axial")


def table(n: int, rate: float = FRAME_RATE, processes: int = 1) -> list[str]:
    """Rows of the table."""
    recordings = []
    for seed in range(1, n + 1):
        drawn = replace(draw(seed, Planted({}), rate), k_m=K_M)
        recordings.append(Recorded(f"{seed}", trajectory_of(drawn, Planted({}), rig_seed=1)))
    items = [Item(r, label) for r, label in zip(recordings, labels_of(recordings), strict=True)]
    with Crew(build, items, processes) as crew:
        told = crew.call("told", [()] * n)
        usable = [i for i, t in enumerate(told) if not isinstance(t, DiscTrackError)]
        crew.keep(usable)
        sharing = Sharing([told[i][0] for i in usable])
        crew.call("share", [([q.name for q in own],) for own in sharing.own])
        system = JointSystem(sharing, crew)
        base = fit(system, system.base, sharing.start())
        numbers = sorted({k for k in NUMBERS if k < len(usable)} | {len(usable)})
        sigmas = sigmas_of_first(system, base, numbers)
    lines = [
        f"| effect | usual size | {' | '.join(f'sigma of {k}' for k in numbers)} |",
        "|---" * (len(numbers) + 2) + "|",
    ]
    for name in (*AIR, *OTHERS):
        c = next(c for c in system.candidates if c.name == name)
        q = c.quantities[0]
        cells = [f"{float(sigmas[k][name][0]):.2g}" for k in numbers]
        lines.append(f"| {name} | {q.typical:.3g} {q.unit if q.unit != '1' else ''} | {' | '.join(cells)} |")
    reduced = base.reduced_chi_square
    lines.append(f"reduced chi-square {reduced:.4f}, k_m {base.values['km.k_m']:.6g} +- {base.sigma('km.k_m'):.2g}")
    return lines


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m disctrack.diagnosis.trials.together", description=__doc__)
    parser.add_argument("--recordings", type=int, default=20, help="how many (%(default)s)")
    parser.add_argument("--frame-rate", type=float, default=FRAME_RATE, help="in Hz (%(default)s)")
    parser.add_argument("-j", "--jobs", type=int, default=1, help="processes (%(default)s)")
    arguments = parser.parse_args()
    print("\n".join(table(arguments.recordings, arguments.frame_rate, arguments.jobs)))


if __name__ == "__main__":
    main()
