"""A simulated motion: what the model predicts at the given times, and why it ended."""

from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from calibration.kit.brief import Outline
from disctrack.frames import COORDINATES, nodal_axes_world, rotation_from_euler
from disctrack.rolling.model import Model
from disctrack.rolling.records import ROLLING_COMPONENTS, Records, Regime

Parts: TypeAlias = Any  # numbers of records: real in a motion, complex where derivatives are carried


class EndReason(Enum):
    """Why a simulation ended; the value is the sentence a report prints."""

    TIME = "the requested time was reached"
    NUTATION = "the nutation angle reached its end"
    UPRIGHT = "the disc stands upright on its rim: beyond 90 deg the other edge would touch"
    LANDED = "after losing contact the disc hit the table: the impact is outside the model"
    FAILED = "the integration failed: the step became too small, or a number not finite"
    CHATTER = "slip and rolling alternate without end: the friction law has no solution here"


@dataclass(frozen=True)
class Switch:
    """Change of the regime."""

    time: float
    before: Regime
    after: Regime


@dataclass(frozen=True, repr=False)
class Motion(Outline):
    """Motion of the disc at n times. Forces and moments are those of the table on the disc, in (n0, m0, k)."""

    model: Model
    time: Array  # (n,) [s]
    q: Array  # (n, 6) x, y, z [m], psi, theta, phi [rad], not wrapped
    qdot: Array  # (n, 6)
    state: Array  # (n, 8) records.ROLLING_COMPONENTS
    omega_world: Array  # (n, 3) [rad/s]
    acceleration_world: Array  # (n, 3) of the geometric centre O [m/s^2]
    angular_acceleration_world: Array  # (n, 3) [rad/s^2]
    energy_translation: Array  # (n,) [J] kinetic, of the centre of mass
    energy_rotation: Array  # (n,) [J] kinetic, about the centre of mass
    energy_potential: Array  # (n,) [J] zero where the disc lies flat at the origin
    contact_force: Array  # (n, 3) F_n, F_m, F_z [N]
    contact_moment: Array  # (n, 3) M_n, M_m, M_z [N m]
    external_force: Array  # (n, 3) X_n, X_m, X_z at O, and a field's at the centre of mass [N]; no gravity
    slip_velocity: Array  # (n, 2) of the disc's material point at the contact, along n0, m0 [m/s]; zero when rolling
    power: Array  # (n,) [W] of contact force, moments and external force: dE/dt
    regime: NDArray[np.uint8]  # (n,) Regime
    switches: tuple[Switch, ...]
    end: EndReason
    end_time: float  # [s]; not necessarily one of `time`
    end_state: Array  # (8,), (10,) or (12,) records.STATE_COMPONENTS at end_time

    def __len__(self) -> int:
        return len(self.time)

    @property
    def energy(self) -> Array:
        """(n,) total mechanical energy [J]."""
        return self.energy_translation + self.energy_rotation + self.energy_potential

    @property
    def friction_needed(self) -> Array:
        """(n,) |F_t| / F_z."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.hypot(self.contact_force[:, 0], self.contact_force[:, 1]) / self.contact_force[:, 2]


@dataclass(frozen=True)
class Path:
    """Solution over all regimes, at n times; numbers are complex where imaginary parts carry derivatives."""

    now: Records  # (n,) records.INSTANT
    regime: NDArray[np.uint8]  # (n,)
    switches: list[Switch]
    end: EndReason
    end_time: complex
    end_state: Parts  # (8,), (10,) or (12,)
    slip_steps: int  # of the integrator in slip, which is stiff where it creeps
    n_steps: int  # of it in all

    @property
    def as_seen(self) -> tuple[Parts, Parts]:
        """Q and qdot (n, 6) in the axes of cameras at rest: the table may move in them."""
        q, qdot = coordinates(self.now)
        for i, axis in enumerate("xyz"):
            q[:, i] += self.now[f"table_{axis}"]
            qdot[:, i] += self.now[f"table_v{axis}"]
        return q, qdot


def coordinates(now: Records) -> tuple[Parts, Parts]:
    """Q and qdot (n, 6) in axes of the table, real or complex, from records.INSTANT (n,)."""
    cp, sp = np.cos(now["psi"]), np.sin(now["psi"])
    v_x, v_y = now["v_n"] * cp - now["v_m"] * sp, now["v_n"] * sp + now["v_m"] * cp
    q = columns(now, *COORDINATES)
    qdot = np.stack([v_x, v_y, now["v_z"], now["psidot"], now["thetadot"], now["phidot"]], axis=-1)
    return q, qdot


def columns(now: Records, *names: str) -> Parts:
    """Fields of records (n,) beside each other (n, k)."""
    return np.stack([now[name] for name in names], axis=-1)


def moment_power(now: Records, moment: Array) -> Array:
    """M . Omega [W]; Omega = thetadot n0 - phidot sin(theta) m0 + omega_z k."""
    rates = np.stack([now["thetadot"], -now["phidot"] * now["sin_theta"], now["omega_z"]], axis=-1)
    return np.sum(moment * rates, axis=-1)


def motion_of(model: Model, body: Records, path: Path) -> Motion:
    """All quantities of a `Motion` from its path; `body` is a record (1,) of records.BODY."""
    now, b = path.now, body[0]
    q, qdot = path.as_seen
    nodal = np.stack(nodal_axes_world(now["psi"], now["theta"]), axis=-1)  # nodal -> world
    n0, k = nodal[:, :, 0], np.tile([0.0, 0.0, 1.0], (len(now), 1))
    contact = np.stack([n0, np.cross(k, n0), k], axis=-1)  # contact axes -> world
    omega = _turned(nodal, columns(now, "thetadot", "omega2", "omega3"))
    R = rotation_from_euler(now["psi"], now["theta"], now["phi"])
    com = R @ np.array([b["com_1"], b["com_2"], b["com_3"]])
    J = np.array([[b[f"J_{min(i, j)}{max(i, j)}"] for j in (1, 2, 3)] for i in (1, 2, 3)])
    omega_body = np.einsum("nji,nj->ni", R, omega)
    v_G = qdot[:, :3] + np.cross(omega, com)
    gravity = np.array([b["g_x"], b["g_y"], b["g_z"]])
    force, slip = columns(now, "F_n", "F_m", "F_z"), columns(now, "slip_n", "slip_m")
    moment = columns(now, "M_n", "M_m", "M_z") + columns(now, "load_n", "load_m", "load_z") * now["N"][:, None]
    pull = b["mass"] * columns(now, "field_x", "field_y", "field_z")  # at the centre of mass, and not at O
    at_O = columns(now, "X_n", "X_m", "X_z")
    table_velocity, table_acceleration = (columns(now, *(f"table_{d}{a}" for a in "xyz")) for d in "va")
    slip[path.regime == Regime.ROLLING] = 0.0
    slips = path.regime == Regime.SLIPPING
    power = moment_power(now, moment) + np.where(slips, np.sum(force[:, :2] * slip, axis=-1), 0.0)
    power += np.sum(_turned(contact, at_O) * qdot[:, :3], axis=-1) + np.sum(pull * v_G, axis=-1)
    return Motion(
        model=model,
        time=now["time"],
        q=q,
        qdot=qdot,
        state=columns(now, *ROLLING_COMPONENTS),
        omega_world=omega,
        acceleration_world=_turned(contact, columns(now, "a_n", "a_m", "a_z")) + table_acceleration,
        angular_acceleration_world=_turned(nodal, columns(now, "alpha_1", "alpha_2", "alpha_3")),
        energy_translation=0.5 * b["mass"] * np.sum(v_G**2, axis=-1),
        energy_rotation=0.5 * np.einsum("ni,ij,nj->n", omega_body, J, omega_body),
        energy_potential=-b["mass"] * (q[:, :3] + com - [0, 0, b["half_thickness"] + b["com_3"]]) @ gravity,
        contact_force=force,
        contact_moment=moment,
        external_force=at_O + _turned(np.swapaxes(contact, 1, 2), pull),
        slip_velocity=slip,
        power=power + np.sum(_turned(contact, force) * table_velocity, axis=-1),
        regime=path.regime,
        switches=tuple(path.switches),
        end=path.end,
        end_time=path.end_time.real,
        end_state=path.end_state,
    )


def _turned(axes: Array, vectors: Array) -> Array:
    """Vectors (n, 3) by matrices (n, 3, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", axes, vectors))
