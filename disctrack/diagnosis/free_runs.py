"""What a report shows beside the answer: rates and forces from the poses alone, the missing moment, free runs."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calibration.kit.arrays import Array
from disctrack.analyse.contact import K
from disctrack.analyse.derivatives import MeasuredMotion, differentiate
from disctrack.analyse.energy import analyse_energy
from disctrack.analyse.propagation import RATES, MotionState, propagate, rates
from disctrack.diagnosis.answer import DiscDiagnosis
from disctrack.diagnosis.disc_system import DiscSystem
from disctrack.diagnosis.errors import HALF_WINDOW, HORIZONS, Ahead, energy_balance, free_run, simulated
from disctrack.diagnosis.missing_force import MissingMoment, missing_moment, probe
from disctrack.discrepancy.fit import Fit
from disctrack.discrepancy.held_out import held_out
from disctrack.errors import AnalysisError
from disctrack.trajectory import part

SHORTEST = 0.05  # [s] of frames from which a longer free run may start


@dataclass(frozen=True)
class ModelFreeForces:
    """What the poses say without any model of the motion; n frames of the system, NaN where they say nothing."""

    psidot: Array  # (n,) [rad/s]
    psidot_sigma: Array
    force: Array  # (n, 3) on the disc's centre, gravity taken off: m (a + g k), along n0, m0, k [N]
    force_sigma: Array
    energy_lost: float  # [J]
    energy_lost_sigma: float


@dataclass(frozen=True)
class ModelFreeEvidence:
    """Beside the answer; None where it cannot be had."""

    measured: ModelFreeForces | None
    moment: MissingMoment | None  # that the model before fails to supply
    moment_of_law: MissingMoment | None  # that the effects found add, read in the same way
    energy_before: dict[str, float] = field(default_factory=dict)  # [J]
    ahead: tuple[tuple[Ahead, Ahead], ...] = ()  # before, after; of free runs after shorter fits


def evidence(result: DiscDiagnosis) -> ModelFreeEvidence:
    """All that a report shows beside a diagnosis whose base fit converged."""
    system, before = result.system, result.diagnosis.before
    moment, of_law = None, None
    # a fit that fails by whole turns has no linear response to ask for
    if before.converged and not any(f.candidate.name == "slip_start" for f in result.diagnosis.found):
        blocks = probe(system, before)
        moment = missing_moment(blocks) if blocks is not None else None
        blocks = probe(system, before, result.after_fit.values) if result.after_fit is not before else None
        if moment is not None and blocks is not None:
            of_law = missing_moment(blocks, moment.scale)
    energy = energy_balance(system, before.values) if before.converged else {}
    return ModelFreeEvidence(_measured(system), moment, of_law, energy, _longer(result))


def _measured(system: DiscSystem) -> ModelFreeForces | None:
    disc, gravity = system.disc, system.model.gravity
    try:
        motion = differentiate(part(system.trajectory, system.rows))
        energy = analyse_energy(motion)
    except AnalysisError:
        return None

    def force(state: MotionState) -> Array:
        n0, _, _ = state.axes()
        total = disc.mass * (state.acceleration + gravity * K)
        return np.stack(
            [np.sum(total * axis, axis=1) for axis in (n0, np.cross(K, n0), np.broadcast_to(K, n0.shape))], 1
        )

    return ModelFreeForces(
        *_column(motion, [name for name, _, _ in RATES].index("psidot")),
        *_values(motion, force),
        energy.loss,
        float(np.hypot(energy.loss_sigma, energy.loss_sigma_calibration)),
    )


def _values(motion: MeasuredMotion, function: Callable[[MotionState], Array]) -> tuple[Array, Array]:
    found = propagate(motion, function)
    return found.value, np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))


def _column(motion: MeasuredMotion, i: int) -> tuple[Array, Array]:
    value, sigma = _values(motion, rates)
    return value[:, i], sigma[:, i]


def force_of(system: DiscSystem, fit: Fit) -> Array:
    """(n, 3) the same force in the fitted motion [N]; NaN after its end."""
    motion = simulated(system, fit.values)
    n0 = np.stack([np.cos(motion.q[:, 3]), np.sin(motion.q[:, 3]), np.zeros(len(motion))], axis=1)
    total = system.disc.mass * (motion.acceleration_world + system.model.gravity * K)
    along = [np.sum(total * axis, axis=1) for axis in (n0, np.cross(K, n0), np.broadcast_to(K, n0.shape))]
    found = np.full((len(system.time), 3), np.nan)
    found[: len(motion)] = np.stack(along, axis=1)
    return found


def _longer(result: DiscDiagnosis) -> tuple[tuple[Ahead, Ahead], ...]:
    """Free runs over the horizons that the part held out does not reach, each after a fit that ends in time for it."""
    system = result.system
    reached = {a.horizon_s for a in result.after.ahead} if result.after else set()
    seen = system.time[system.weights > 0]
    found = []
    for horizon in HORIZONS:
        until = seen[-1] - horizon - HALF_WINDOW
        if horizon in reached or until < seen[0] + SHORTEST:
            continue
        rows = np.asarray(system.time <= until, bool)
        runs: list[Ahead] = []
        for fit_ in (result.diagnosis.before, result.after_fit):
            held = held_out(system, fit_.quantities, fit_.values, rows)
            runs += free_run(system, held, (horizon,))
        if len(runs) == 2:
            found.append((runs[0], runs[1]))
    return tuple(found)
