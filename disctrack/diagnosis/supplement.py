"""What a report shows in addition to the answer: rates and forces without a model, the missing moment, free runs."""

from dataclasses import dataclass

import numpy as np

from calibration.kit.types import Array
from disctrack.analyse.derivatives import K, differentiate
from disctrack.analyse.quantities import COLUMN, energy_of, from_to, propagate
from disctrack.diagnosis.answer import DiscDiagnosis
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import HALF_WINDOW, Ahead, energy_balance, free_run, simulated
from disctrack.diagnosis.missing_force import Course, missing_moment, probe
from disctrack.diagnosis.stretch import MIN_FRAMES
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import held_out
from disctrack.errors import AnalysisError
from disctrack.frames import nodal_axes_world
from disctrack.numbers import Measured
from disctrack.trajectory import part

HORIZONS = (0.1, 0.3, 0.5)  # [s] after the last fitted frame


@dataclass(frozen=True)
class Supplement:
    """Results in addition to the answer; None where they cannot be computed."""

    psidot: Array | None  # (n,) [rad/s] derivative of the poses, without a model; NaN where it is not determined
    energy_lost: Measured | None  # likewise
    force: Course | None  # [N] from the accelerations of the poses, minus that of the model before
    moment: Course | None  # [N m] that is missing from the model before
    moment_of_law: Course | None  # that the effects found add, estimated in the same way
    energy_before: dict[str, float]  # [J]
    ahead: tuple[tuple[Ahead, Ahead], ...]  # errors of free runs of the models before and after


def supplement(result: DiscDiagnosis) -> Supplement:
    """Results in addition to a diagnosis whose base fit converged."""
    system, before = result.system, result.diagnosis.before
    moment, of_law = None, None
    # a motion that is off by whole turns is not in the range of a linear response
    if before.converged and not any(f.candidate.name == "slip_start" for f in result.diagnosis.found):
        blocks = probe(system, before)
        added = probe(system, before, result.diagnosis.after.values) if result.has_more else None
        if blocks is not None:
            moment, scale = missing_moment(blocks)
            of_law = None if added is None else missing_moment(added, scale)[0]
    energy = energy_balance(system, before.values) if before.converged else {}
    return Supplement(*_measured(system, before), moment, of_law, energy, _ahead(result))


def _measured(system: DiscSystem, before: Fit) -> tuple[Array | None, Measured | None, Course | None]:
    """The rate of precession, the energy lost and the missing force, from derivatives of the poses."""
    try:
        motion = differentiate(part(system.trajectory, system.rows))
    except AnalysisError:
        return None, None, None
    found, force = propagate(motion), from_to("force_n", "force_z")
    variance = np.diagonal(found.covariance(np.arange(len(motion)), force), axis1=1, axis2=2)
    missing = Course(system.time, found.value[:, force] - force_of(system, before), np.sqrt(variance))
    energy = energy_of(found)
    lost = Measured(energy.loss, float(np.hypot(energy.loss_sigma, energy.loss_sigma_calibration)), "J")
    return found.value[:, COLUMN["psidot"]], lost, missing


def force_of(system: DiscSystem, fit: Fit) -> Array:
    """(n, 3) contact force of the fitted motion along n0, m0, k [N], from the acceleration; NaN after its end."""
    motion = simulated(system, fit.values)
    n0, _, _ = nodal_axes_world(motion.q[:, 3], motion.q[:, 4])
    total = system.disc.mass * (motion.acceleration_world + system.model.gravity * K)
    found = np.full((len(system.time), 3), np.nan)
    for i, axis in enumerate((n0, np.cross(K, n0), K)):
        found[: len(motion), i] = np.sum(total * axis, axis=1)
    return found


def _ahead(result: DiscDiagnosis) -> tuple[tuple[Ahead, Ahead], ...]:
    """Errors at each horizon: of the free run over the held-out data, or beyond it of a run after a shorter fit."""
    system, d, found = result.system, result.diagnosis, []
    last = system.time[system.weights > 0].max()
    for horizon in HORIZONS:
        rows, runs = np.asarray(system.time <= last - horizon - HALF_WINDOW, bool), list[Ahead]()
        for fit, held in ((d.before, d.held_out_before), (d.after, d.held_out_after)):
            run = None if held is None else free_run(system, held, horizon)
            if run is None and rows.sum() >= MIN_FRAMES:
                run = free_run(system, held_out(system, fit.quantities, fit.values, rows), horizon)
            runs += [] if run is None else [run]
        if len(runs) == 2:
            found.append((runs[0], runs[1]))
    return tuple(found)
