"""A start for the fit of a rolling motion: from the first poses, then over longer and longer stretches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calibration.kit.arrays import Array
from disctrack.diagnosis.motion import SLIP, SLIP_VELOCITY, model_quantities, state_quantities
from disctrack.diagnosis.stretch import FIRST_WINDOW
from disctrack.disc import Disc
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.system import Values
from disctrack.frames import nodal_axes_world, rotation_from_euler, vector_from_rotation

if TYPE_CHECKING:
    from disctrack.diagnosis.disc_system import DiscSystem


STRETCHES = (0.03, 0.08, 0.2, 0.5)  # [s] a linear step from one stretch's fit stays in the next one's basin
FRICTIONS = (0.03, 1.0)  # coefficients to begin with are sought between these


def first_state(time: Array, q: Array) -> dict[str, float]:
    """Initial state from poses (n, 6), some of them NaN, by a cubic in time through the first ones.

    A quarter turn of nutation at 12 Hz is a cubic. Returns state.x ... state.omega3, and the centre's velocity as
    state.v_x, state.v_y, which a rolling disc does not need.
    """
    coefficients, first = _cubic(time, q)
    psi, theta, phi = first
    omega = coefficients[1, 3:]
    e1, e2, e3 = nodal_axes_world(psi, theta)
    numbers = (coefficients[0, 0], coefficients[0, 1], psi, theta, phi, omega @ e1, omega @ e2, omega @ e3)
    names = (*(q.name for q in state_quantities()), *SLIP_VELOCITY)
    return dict(zip(names, map(float, (*numbers, *coefficients[1, :2])), strict=True))


def first_friction(time: Array, q: Array, gravity: float) -> float:
    """Horizontal over vertical contact force at the first instant, from the centre's acceleration: mu in slip."""
    x, y, z = 2 * _cubic(time, q)[0][2, :3]
    return float(np.clip(np.hypot(x, y) / max(gravity + z, 0.1 * gravity), *FRICTIONS))


def first_slip(time: Array, q: Array, disc: Disc) -> float:
    """Horizontal speed [m/s] of the disc's point at the contact at the first instant; rolling has none."""
    coefficients, (psi, theta, _) = _cubic(time, q)
    _, e2, e3 = nodal_axes_world(psi, theta)
    arm = disc.arm_to_contact(e2, e3)
    slip = coefficients[1, :3] + np.cross(coefficients[1, 3:], arm)
    return float(np.hypot(*slip[:2]))


def _cubic(time: Array, q: Array) -> tuple[Array, Array]:
    """Coefficients (4, 6) of the first poses' displacement and turn by powers of time [s], and the first angles."""
    interval = float(np.median(np.diff(time)))
    good = np.flatnonzero(np.isfinite(q).all(axis=1) & (time <= time[0] + max(FIRST_WINDOW, 10 * interval)))
    t, poses = time[good] - time[0], q[good]
    R = rotation_from_euler(*poses[:, 3:].T)
    turned = vector_from_rotation(R @ R[0].T)
    span = max(float(t[-1]), interval)
    terms = np.vander(t / span, min(4, max(2, len(t) // 3)), increasing=True)
    coefficients = np.linalg.lstsq(terms, np.column_stack([poses[:, :3], turned]), rcond=None)[0]
    found = np.zeros((4, 6))
    found[: len(coefficients)] = coefficients / span ** np.arange(len(coefficients))[:, None]
    return found, poses[0, 3:]


def start_values(system: DiscSystem, known: Values) -> dict[str, float]:
    """Values of state and declared effects from which the fit of the whole recording converges; `known` are kept."""
    q = system.trajectory.q[system.rows]
    names = {quantity.name for quantity in system.base}
    times = system.instants(known)
    values = dict(known) | {k: v for k, v in first_state(times, q).items() if k in names}
    laws = model_quantities(system.model)
    values |= {law.name: system.model.values[law.name] for law in laws}
    if SLIP in names:
        values[SLIP] = 1.0 / first_friction(times, q, system.model.gravity)
    state = tuple(quantity for quantity in system.base if quantity.is_initial or quantity.name == SLIP)
    for stretch, part in zip(STRETCHES, system.beginnings(), strict=False):
        # a law of friction shows only over several turns: held until the stretch is long enough
        moved = state if stretch < 0.1 else (*state, *laws)
        values = fit(part, moved, values).values
    return values
