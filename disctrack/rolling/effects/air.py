"""The air: its density, the layer squeezed between disc and table, and drag on the disc as a whole."""

import numpy as np

from disctrack.rolling.effects.base import EffectParameter, effect, magnitude
from disctrack.rolling.records import Record

AIR_VISCOSITY = 1.81e-5  # [Pa s] at 20 degC; it does not depend on the density


@effect(
    "air of another density than declared",
    "kinetic theory of gases: the drag of boundary layers goes with its root, that of a wake with itself",
    EffectParameter("density", "1", 0.1, "over the declared one", null=1.0, lower=0.0, upper=1e3),
    belongs_to=("air",),
    candidate=False,  # one recording knows the product of density and coefficient only
)
def air(body: Record, p: Record) -> None:
    """The density of the air, which all laws of the air use, differs from the declared one."""
    body.air_density = body.air_density * p.density


@effect(
    "viscous air layer, M_m = -f (pi mu r^3 / 4) psidot / sin^2 theta",
    "Moffatt 2000, Nature 404:833; mu = 1.81e-5 Pa s",
    EffectParameter("f", "1", 1.0, "factor on the lubrication layer", lower=0.0),
    belongs_to=("air",),
)
def air_moffatt(p: Record, s: Record, w: Record) -> None:
    """Viscous air layer under the disc: power pi mu g r^2 / theta^2 on the adiabatic manifold."""
    layer = 0.25 * np.pi * AIR_VISCOSITY * s.radius * s.radius * s.radius
    w.M_m -= p.f * layer * s.psidot / (s.sin_theta * s.sin_theta)


@effect(
    "boundary-layer air drag, M_m = -beta rho sqrt(nu) r^4 |psidot|^(3/2) sgn psidot / sin theta",
    "Bildsten 2002, Phys. Rev. E 66:056309; rho as declared",
    EffectParameter("beta", "1", 1.0, "factor of order one", lower=0.0),
    belongs_to=("air",),
)
def air_bildsten(p: Record, s: Record, w: Record) -> None:
    """Boundary layers on disc and table, thinner than the gap: valid for theta above about 0.5 deg."""
    r2 = s.radius * s.radius
    layer = np.sqrt(s.air_density * AIR_VISCOSITY) * r2 * r2  # rho sqrt(nu) = sqrt(rho mu)
    w.M_m -= p.beta * layer * s.psidot * np.sqrt(magnitude(s.psidot)) / s.sin_theta


@effect(
    "quadratic air drag on the rotation, M = -a rho r^5 |Omega| Omega",
    "dimensional analysis; a about 0.1, rho as declared",
    EffectParameter("a", "1", 0.1, "drag coefficient", lower=0.0),
    belongs_to=("air",),
    airborne=True,
)
def air_quadratic(p: Record, s: Record, w: Record) -> None:
    """Free-air drag on the rotation, M = -a rho r^5 |Omega| Omega."""
    r2 = s.radius * s.radius
    rolling_m = -s.phidot * s.sin_theta
    rate = np.sqrt(s.thetadot * s.thetadot + rolling_m * rolling_m + s.omega_z * s.omega_z + 1e-12)
    drag = p.a * s.air_density * r2 * r2 * s.radius * rate
    w.M_n -= drag * s.thetadot
    w.M_m -= drag * rolling_m
    w.M_z -= drag * s.omega_z


@effect(
    "viscous air drag on the spin, M = -a omega3 e3",
    "Jalali, Sarebangholi and Alam 2015, Phys. Rev. E 92:032913",
    EffectParameter("a", "N m s", 1e-7, "moment per spin rate", lower=0.0),
    belongs_to=("air", "disc"),
    airborne=True,
)
def air_spin(p: Record, s: Record, w: Record) -> None:
    """Moment -a omega3 e3."""
    w.M_m += p.a * s.omega3 * s.sin_theta  # e3 = -sin(theta) m0 + cos(theta) k
    w.M_z -= p.a * s.omega3 * s.cos_theta


@effect(
    "linear drag on the rotation of the whole disc, M = -c Omega",
    "viscous drag of a fluid at rest, Stokes' law for rotation",
    EffectParameter("c", "N m s", 1e-6, "moment per angular velocity", lower=0.0),
    belongs_to=("air", "disc"),
    airborne=True,
)
def drag_rotation(p: Record, s: Record, w: Record) -> None:
    """Moment -c Omega on the whole disc."""
    w.M_n -= p.c * s.thetadot
    w.M_m += p.c * s.phidot * s.sin_theta
    w.M_z -= p.c * s.omega_z


@effect(
    "linear drag of the whole disc, X = -c v_O",
    "Stokes' law; an eddy-current brake or a draught at rest has the same form",
    EffectParameter("c", "N s/m", 1e-4, "force per velocity of the centre", lower=0.0),
    belongs_to=("air", "disc"),
    airborne=True,
)
def drag_linear(p: Record, s: Record, w: Record) -> None:
    """Force -c v_O on the whole disc."""
    w.X_n -= p.c * s.v_n
    w.X_m -= p.c * s.v_m
    w.X_z -= p.c * s.v_z
