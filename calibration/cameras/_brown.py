"""Brown's distortion, in a form for both NumPy arrays and compiled loops."""

from calibration.kit.types import Array


def distorted(
    a: Array, b: Array, k1: float, k2: float, p1: float, p2: float, k3: float
) -> tuple[Array, Array, Array, Array, Array]:
    """Distorted normalised coordinates and derivatives: xd, yd, dxd/da, dxd/db (= dyd/da), dyd/db."""
    r2 = a * a + b * b
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)  # d radial / d r2
    xd = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    yd = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    xd_a = radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
    xd_b = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
    yd_b = radial + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a
    return xd, yd, xd_a, xd_b, yd_b
