"""A simulated motion: what the model predicts at the given times, and why it ended."""

from dataclasses import dataclass
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from calibration.kit.arrays import Array
from calibration.kit.brief import Outline
from disctrack.frames import nodal_axes_world, rotation_from_euler
from disctrack.rolling import equations
from disctrack.rolling.model import Model
from disctrack.rolling.records import ROLLING_COMPONENTS, Numbers, Records


class Regime(IntEnum):
    """State of the contact."""

    ROLLING = equations.ROLLING
    SLIPPING = equations.SLIPPING
    FLYING = equations.FLYING


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


def coordinates(kinematics: Records) -> tuple[Numbers, Numbers]:
    """Q and qdot (n, 6), real or complex, from records of kinematic quantities (n,)."""
    k = kinematics
    cp, sp = np.cos(k["psi"]), np.sin(k["psi"])
    v_x, v_y = k["v_n"] * cp - k["v_m"] * sp, k["v_n"] * sp + k["v_m"] * cp
    q = np.stack([k["x"], k["y"], k["z"], k["psi"], k["theta"], k["phi"]], axis=-1)
    qdot = np.stack([v_x, v_y, k["v_z"], k["psidot"], k["thetadot"], k["phidot"]], axis=-1)
    return q, qdot


def as_seen(kinematics: Records, wrench: Records) -> tuple[Numbers, Numbers]:
    """Q and qdot (n, 6) in the axes of cameras at rest, from records (n,): the table may move in them."""
    q, qdot = coordinates(kinematics)
    for i, axis in enumerate("xyz"):
        q[..., i] += wrench[f"table_{axis}"]
        qdot[..., i] += wrench[f"table_v{axis}"]
    return q, qdot


@dataclass(frozen=True)
class MotionSamples:
    """Raw answers of the compiled equations at n times."""

    time: Array  # (n,)
    kinematics: Records  # (n,) records
    wrench: Records  # (n,) records
    rates: Numbers  # (n, 8) of the rolling components
    regime: NDArray[np.uint8]  # (n,)


def motion_from_samples(
    model: Model,
    body: Records,
    samples: MotionSamples,
    switches: list[Switch],
    end: EndReason,
    end_time: float,
    end_state: Array,
) -> Motion:
    """All quantities of a `Motion` from the solution's samples; `body` is a record (1,) of records.BODY."""
    k, w, b = samples.kinematics, samples.wrench, body[0]
    q, qdot = (x.real for x in as_seen(k, w))
    omega_nodal = np.stack([k["thetadot"], k["omega2"], k["omega3"]], axis=-1)
    frame_nodal = np.stack([k["thetadot"], k["omega2"], k["psidot"] * k["cos_theta"]], axis=-1)
    omegadot_nodal = samples.rates[:, 5:8] + np.cross(frame_nodal, omega_nodal)
    axes = np.stack(nodal_axes_world(k["psi"], k["theta"]), axis=-1)  # nodal -> world
    omega = np.einsum("nij,nj->ni", axes, omega_nodal)
    omegadot = np.einsum("nij,nj->ni", axes, omegadot_nodal)
    R = rotation_from_euler(k["psi"], k["theta"], k["phi"])
    com = R @ np.array([b["com_1"], b["com_2"], b["com_3"]])
    J = np.array(
        [[b["J_11"], b["J_12"], b["J_13"]], [b["J_12"], b["J_22"], b["J_23"]], [b["J_13"], b["J_23"], b["J_33"]]]
    )
    omega_body = np.einsum("nji,nj->ni", R, omega)
    v_G = qdot[:, :3] + np.cross(omega, com)
    gravity = np.array([b["g_x"], b["g_y"], b["g_z"]])
    load = w["N"]
    force = np.stack([w[f"F_{a}"] for a in "nmz"], axis=-1)
    moment = np.stack([w[f"M_{a}"] + w[f"load_{a}"] * load for a in "nmz"], axis=-1)
    external = np.stack([w["X_n"], w["X_m"], w["X_z"]], axis=-1)
    contact_axes = np.stack(
        [axes[:, :, 0], np.cross([0, 0, 1], axes[:, :, 0]), np.tile([0.0, 0, 1], (len(k), 1))], axis=-1
    )
    pull = b["mass"] * np.stack([w[f"field_{a}"] for a in "xyz"], axis=-1)
    external += np.einsum("nij,ni->nj", contact_axes, pull)
    a_G = np.einsum("nij,nj->ni", contact_axes, force + external) / b["mass"] + gravity
    slip = np.stack([k["slip_n"], k["slip_m"]], axis=-1)
    slip[samples.regime == Regime.ROLLING] = 0.0
    slip_power = np.where(samples.regime == Regime.SLIPPING, w["F_n"] * k["slip_n"] + w["F_m"] * k["slip_m"], 0.0)
    to_contact = np.swapaxes(contact_axes, 1, 2)
    external_power = np.sum(external * np.einsum("nij,nj->ni", to_contact, qdot[:, :3]), axis=-1)
    external_power += np.sum(pull * np.cross(omega, com), axis=-1)  # at the centre of mass, and not at O
    table_velocity = np.stack([w[f"table_v{a}"] for a in "xyz"], axis=-1)
    table_power = np.sum(force * np.einsum("nij,nj->ni", to_contact, table_velocity), axis=-1)
    return Motion(
        model=model,
        time=samples.time,
        q=q,
        qdot=qdot,
        state=np.stack([k[name] for name in ROLLING_COMPONENTS], axis=-1),
        omega_world=omega,
        acceleration_world=a_G - np.cross(omegadot, com) - np.cross(omega, np.cross(omega, com)),
        angular_acceleration_world=omegadot,
        energy_translation=0.5 * b["mass"] * np.sum(v_G**2, axis=-1),
        energy_rotation=0.5 * np.einsum("ni,ij,nj->n", omega_body, J, omega_body),
        energy_potential=-b["mass"] * (q[:, :3] + com - [0, 0, b["half_thickness"] + b["com_3"]]) @ gravity,
        contact_force=force,
        contact_moment=moment,
        external_force=external,
        slip_velocity=slip,
        power=moment_power(k, moment) + external_power + slip_power + table_power,
        regime=samples.regime,
        switches=tuple(switches),
        end=end,
        end_time=end_time,
        end_state=end_state,
    )


def moment_power(kinematics: Records, moment: Array) -> Array:
    """M . Omega [W]; Omega = thetadot n0 - phidot sin(theta) m0 + omega_z k."""
    k = kinematics
    return (
        moment[..., 0] * k["thetadot"] - moment[..., 1] * k["phidot"] * k["sin_theta"] + moment[..., 2] * k["omega_z"]
    )
