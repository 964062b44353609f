"""Compiled projection of one point, for the loops of both packages."""

from calibration.cameras._brown import distorted
from calibration.kit.compiled import part

_distorted = part(distorted)


@part
def project_point(camera, X, Y, Z, J):  # type: ignore[no-untyped-def]
    """Pixel of one point in camera axes and J (2, 3) = d pixel / d point; camera = the nine INTRINSIC_PARAMETERS."""
    iz = 1.0 / Z
    a, b = X * iz, Y * iz
    xd, yd, xd_a, xd_b, yd_b = _distorted(a, b, camera[4], camera[5], camera[6], camera[7], camera[8])
    J[0, 0], J[0, 1], J[0, 2] = camera[0] * xd_a * iz, camera[0] * xd_b * iz, -camera[0] * (xd_a * a + xd_b * b) * iz
    J[1, 0], J[1, 1], J[1, 2] = camera[1] * xd_b * iz, camera[1] * yd_b * iz, -camera[1] * (xd_b * a + yd_b * b) * iz
    return camera[0] * xd + camera[2], camera[1] * yd + camera[3]
