"""A start for the fit of a rolling motion: from the first poses, then over longer and longer stretches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from disctrack.diagnosis.disc_motion import model_quantities, state_quantities
from disctrack.diagnosis.fit import fit
from disctrack.diagnosis.system import Subset, Values
from disctrack.frames import nodal_axes_world, rotation_from_euler, vector_from_rotation

if TYPE_CHECKING:
    from disctrack.diagnosis.disc_system import DiscSystem

Array = NDArray[np.float64]

FIRST = 0.02  # [s] over which the motion is a cubic in time: a quarter turn of nutation at 12 Hz
STRETCHES = (0.03, 0.08, 0.2, 0.5)  # [s] a linear step from one stretch's fit stays in the next one's basin


def first_state(time: Array, q: Array) -> dict[str, float]:
    """Initial state of rolling from poses (n, 6), some of them NaN, by a cubic through the first ones.

    returns : state.x ... state.omega3
    """
    interval = float(np.median(np.diff(time)))
    good = np.flatnonzero(np.isfinite(q).all(axis=1) & (time <= time[0] + max(FIRST, 10 * interval)))
    t, poses = time[good] - time[0], q[good]
    R = rotation_from_euler(*poses[:, 3:].T)
    turned = vector_from_rotation(R @ R[0].T)
    span = max(float(t[-1]), interval)
    terms = np.vander(t / span, min(4, max(2, len(t) // 3)), increasing=True)
    coefficients = np.linalg.lstsq(terms, np.column_stack([poses[:, :3], turned]), rcond=None)[0]
    psi, theta, phi = poses[0, 3:]
    omega = coefficients[1, 3:] / span
    e1, e2, e3 = nodal_axes_world(psi, theta)
    numbers = (coefficients[0, 0], coefficients[0, 1], psi, theta, phi, omega @ e1, omega @ e2, omega @ e3)
    return {q.name: float(v) for q, v in zip(state_quantities(), numbers, strict=True)}


def start_values(system: DiscSystem, known: Values) -> dict[str, float]:
    """Values of state and declared effects from which the fit of the whole recording converges; `known` are kept."""
    q = system.trajectory.q[system.rows]
    values = dict(known) | first_state(system.time, q)
    laws = model_quantities(system.model)
    values |= {q.name: system.model.values[q.name] for q in laws}
    duration = system.time[-1] - system.time[0]
    for stretch in STRETCHES:
        if stretch >= duration:
            break
        rows = system.time <= system.time[0] + stretch
        # a law of friction shows only over several turns: held until the stretch is long enough
        moved = state_quantities() if stretch < 0.1 else (*state_quantities(), *laws)
        values = fit(Subset(system, rows), moved, values).values
    return values
