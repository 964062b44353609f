"""A simulated motion: the prediction of the model at the given times, and the reason for its end."""

from dataclasses import dataclass
from enum import Enum
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.kit.brief import Brief
from calibration.kit.types import Array
from disctrack.frames import COORDINATES, nodal_axes_world, rotation_from_euler
from disctrack.rolling.effects.base import Effect
from disctrack.rolling.model import Model
from disctrack.rolling.records import ROLLING_COMPONENTS, WRENCH, Record, Records, Regime

Parts: TypeAlias = Any  # numbers of records: real in a motion, complex for derivatives


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
    """Change of regime."""

    time: float
    before: Regime
    after: Regime


@dataclass(frozen=True)
class Path:
    """Solution over all regimes, at n times; complex if imaginary parts carry derivatives."""

    now: Records  # (n,) records.INSTANT
    regime: NDArray[np.uint8]  # (n,)
    switches: list[Switch]
    end: EndReason
    end_time: complex
    end_state: Parts  # (8,), (10,) or (12,)
    n_steps: int  # of the integrator; slip is stiff at low slip speeds

    @property
    def as_seen(self) -> tuple[Parts, Parts]:
        """Q and qdot (n, 6) in axes of the cameras, relative to which the table may move."""
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
    """Fields of records (n,) as columns (n, k)."""
    return np.stack([now[name] for name in names], axis=-1)


def moment_power(now: Records, moment: Array) -> Array:
    """M . Omega [W]; Omega = thetadot n0 - phidot sin(theta) m0 + omega_z k."""
    rates = np.stack([now["thetadot"], -now["phidot"] * now["sin_theta"], now["omega_z"]], axis=-1)
    return np.sum(moment * rates, axis=-1)


def effect_wrench(effect: Effect, now: Record, load: ArrayLike) -> tuple[Array, Array]:
    """Contact moment and force of one effect from its law in NumPy, each (..., 3) in (n0, m0, k) [N m, N].

    now : (...) records.INSTANT, whose KINEMATICS are used.   load : (...) normal force F_z [N]
    """
    load = np.asarray(load, float)
    w = SimpleNamespace(**{name: np.zeros(load.shape) for name in WRENCH})
    if effect.law is not None:
        effect.law(SimpleNamespace(**effect.values), now, w)
    moment = [getattr(w, f"M_{a}") + load * getattr(w, f"load_{a}") for a in "nmz"]
    c, s, m = np.cos(now.psi), np.sin(now.psi), now.mass
    field_n, field_m = w.field_x * c + w.field_y * s, w.field_y * c - w.field_x * s
    force = [w.X_n + m * field_n, w.X_m + m * field_m, w.X_z + m * w.field_z]
    return np.stack(moment, axis=-1), np.stack(force, axis=-1)


def effect_power(effect: Effect, now: Record, load: ArrayLike) -> Array:
    """Power (...) of the moment of an effect and of its force at O [W]; never positive for a passive effect."""
    moment, force = effect_wrench(effect, now, load)
    return moment_power(now, moment) + np.sum(force * columns(now, "v_n", "v_m", "v_z"), axis=-1)


class Motion(Brief):
    """Motion of the disc at n times. Forces and moments are those of the table on the disc, in (n0, m0, k)."""

    def __init__(self, model: Model, body: Records, path: Path) -> None:
        """Path : the solution.   body : (1,) records.BODY"""
        now, b = path.now, body[0]
        nodal = np.stack(nodal_axes_world(now["psi"], now["theta"]), axis=-1)  # nodal -> world
        n0, k = nodal[:, :, 0], np.tile([0.0, 0.0, 1.0], (len(now), 1))
        contact = np.stack([n0, np.cross(k, n0), k], axis=-1)  # contact axes -> world
        table_velocity, table_acceleration = (columns(now, *(f"table_{d}{a}" for a in "xyz")) for d in "va")
        self.model = model
        self.instants: Record = now.view(np.recarray)  # (n,) records.INSTANT, in axes of the table
        self.time: Array = now["time"]  # (n,) [s]
        self.q: Array
        self.qdot: Array
        self.q, self.qdot = path.as_seen  # (n, 6) x, y, z [m], psi, theta, phi [rad], not wrapped; and their rates
        self.state: Array = columns(now, *ROLLING_COMPONENTS)  # (n, 8)
        self.omega_world = _transformed(nodal, columns(now, "thetadot", "omega2", "omega3"))  # (n, 3) [rad/s]
        # (n, 3) of the geometric centre O [m/s^2]
        self.acceleration_world = _transformed(contact, columns(now, "a_n", "a_m", "a_z")) + table_acceleration
        # (n, 3) [rad/s^2]
        self.angular_acceleration_world = _transformed(nodal, columns(now, "alpha_1", "alpha_2", "alpha_3"))
        R = rotation_from_euler(now["psi"], now["theta"], now["phi"])
        com = R @ np.array([b["com_1"], b["com_2"], b["com_3"]])
        J = np.array([[b[f"J_{min(i, j)}{max(i, j)}"] for j in (1, 2, 3)] for i in (1, 2, 3)])
        omega_body = np.einsum("nji,nj->ni", R, self.omega_world)
        v_G = self.qdot[:, :3] + np.cross(self.omega_world, com)
        gravity = np.array([b["g_x"], b["g_y"], b["g_z"]])
        rise = self.q[:, :3] + com - [0, 0, b["half_thickness"] + b["com_3"]]
        # (n,) [J] kinetic, of the centre of mass and about it; potential, zero if the disc lies flat at the origin
        self.energy_translation: Array = 0.5 * b["mass"] * np.sum(v_G**2, axis=-1)
        self.energy_rotation: Array = 0.5 * np.einsum("ni,ij,nj->n", omega_body, J, omega_body)
        self.energy_potential: Array = -b["mass"] * rise @ gravity
        self.contact_force: Array = columns(now, "F_n", "F_m", "F_z")  # (n, 3) [N]
        by_load = columns(now, "load_n", "load_m", "load_z") * now["N"][:, None]
        self.contact_moment: Array = columns(now, "M_n", "M_m", "M_z") + by_load  # (n, 3) [N m]
        at_O, pull = columns(now, "X_n", "X_m", "X_z"), b["mass"] * columns(now, "field_x", "field_y", "field_z")
        # (n, 3) [N] at O, plus that of a field at the centre of mass; without gravity
        self.external_force: Array = at_O + _transformed(np.swapaxes(contact, 1, 2), pull)
        slip = columns(now, "slip_n", "slip_m")
        slip[path.regime == Regime.ROLLING] = 0.0
        self.slip_velocity: Array = slip  # (n, 2) of the disc's material point at the contact, along n0, m0 [m/s]
        # in rolling there is no slip, in flight no force
        power = moment_power(now, self.contact_moment) + np.sum(self.contact_force[:, :2] * slip, axis=-1)
        power += np.sum(_transformed(contact, at_O) * self.qdot[:, :3], axis=-1) + np.sum(pull * v_G, axis=-1)
        # (n,) [W] power of contact force, moments and external force: dE/dt
        self.power: Array = power + np.sum(_transformed(contact, self.contact_force) * table_velocity, axis=-1)
        self.regime = path.regime  # (n,) Regime
        self.switches = tuple(path.switches)
        self.end = path.end
        self.end_time = float(path.end_time.real)  # [s]; not necessarily one of `time`
        self.end_state: Array = path.end_state  # (8,), (10,) or (12,) records.STATE_COMPONENTS at end_time

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


def _transformed(axes: Array, vectors: Array) -> Array:
    """Products of matrices (n, 3, 3) and vectors (n, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", axes, vectors))
