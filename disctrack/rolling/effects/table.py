"""Forces and motions of the table: springs, threads, magnets below it, vibration, settling."""

import numpy as np

from disctrack.rolling.effects.base import EffectParameter, effect
from disctrack.rolling.records import Record


@effect(
    "force towards the point (F_x, F_y) / k of the table, X = F - k (x, y)",
    "Hooke's law; a thread, a magnet below the table, and nearly a hollow of the table have this form",
    EffectParameter("k", "N/m", 0.05, "force per distance"),
    EffectParameter("F_x", "N", 1e-3, "force at the origin along i: k times the x of the point"),
    EffectParameter("F_y", "N", 1e-3, "force at the origin along j: k times the y of the point"),
    belongs_to=("rig", "surface"),
    airborne=True,
)
def spring(p: Record, s: Record, w: Record) -> None:
    """Force towards the point F / k of the table, proportional to the distance: X = F - k (x, y)."""
    X_x, X_y = p.F_x - p.k * s.x, p.F_y - p.k * s.y
    w.X_n += X_x * np.cos(s.psi) + X_y * np.sin(s.psi)
    w.X_m += X_y * np.cos(s.psi) - X_x * np.sin(s.psi)


@effect(
    "table and cameras vibrate: gravity g - a_cos cos 2 pi f t - a_sin sin 2 pi f t",
    "inertial force in an accelerated frame",
    *(EffectParameter(f"a_cos_{a}", "m/s^2", 0.1, f"acceleration of the table along {a} at t = 0") for a in "xyz"),
    *(EffectParameter(f"a_sin_{a}", "m/s^2", 0.1, f"along {a}, a quarter of a period later") for a in "xyz"),
    EffectParameter("frequency", "Hz", 50.0, "of the vibration", lower=0.1, upper=1e4, is_shape=True),
    belongs_to=(),
    airborne=True,
    candidate=False,
)
def table_vibration(p: Record, s: Record, w: Record) -> None:
    """Table and cameras vibrate together at one frequency: gravity oscillates in their axes.

    A diagnosis finds it as an oscillating force, with its frequency, although it is not among the candidates.
    """
    c, d = np.cos(2 * np.pi * p.frequency * s.time), np.sin(2 * np.pi * p.frequency * s.time)
    w.field_x -= p.a_cos_x * c + p.a_sin_x * d
    w.field_y -= p.a_cos_y * c + p.a_sin_y * d
    w.field_z -= p.a_cos_z * c + p.a_sin_z * d


@effect(
    "table shaken under cameras at rest: u = u_cos cos 2 pi f t + u_sin sin 2 pi f t",
    "kinematics: gravity g - u'' in the table's axes",
    *(EffectParameter(f"u_cos_{a}", "m", 1e-6, f"displacement of the table along {a} at t = 0") for a in "xyz"),
    *(EffectParameter(f"u_sin_{a}", "m", 1e-6, f"along {a}, a quarter of a period later") for a in "xyz"),
    EffectParameter("frequency", "Hz", 50.0, "of the vibration", lower=0.1, upper=1e4, is_shape=True),
    belongs_to=(),
    airborne=True,
    sought=True,
)
def table_shaken(p: Record, s: Record, w: Record) -> None:
    """The table vibrates at one frequency relative to the cameras, which are at rest."""
    rate = 2 * np.pi * p.frequency
    c, d = np.cos(rate * s.time), np.sin(rate * s.time)
    u_x, u_y, u_z = p.u_cos_x * c + p.u_sin_x * d, p.u_cos_y * c + p.u_sin_y * d, p.u_cos_z * c + p.u_sin_z * d
    w.table_x, w.table_y, w.table_z = w.table_x + u_x, w.table_y + u_y, w.table_z + u_z
    w.table_vx += rate * (p.u_sin_x * c - p.u_cos_x * d)
    w.table_vy += rate * (p.u_sin_y * c - p.u_cos_y * d)
    w.table_vz += rate * (p.u_sin_z * c - p.u_cos_z * d)
    w.table_ax -= rate * rate * u_x
    w.table_ay -= rate * rate * u_y
    w.table_az -= rate * rate * u_z


@effect(
    "table that sinks or rises slowly under the cameras, or a rim that wears: u_z = v_z t + a_z t^2 / 2",
    "kinematics: gravity g - u'' in the table's axes; a tripod that settles, a mat that gives, a rim ground off",
    EffectParameter("v_z", "m/s", 1e-5, "speed of the table upwards at t = 0"),
    EffectParameter("a_z", "m/s^2", 3e-5, "its acceleration"),
    belongs_to=(),
    airborne=True,
)
def table_settles(p: Record, s: Record, w: Record) -> None:
    """The height of the table in the axes of the cameras changes with time; only a_z causes a force."""
    w.table_z += (p.v_z + 0.5 * p.a_z * s.time) * s.time
    w.table_vz += p.v_z + p.a_z * s.time
    w.table_az += p.a_z
