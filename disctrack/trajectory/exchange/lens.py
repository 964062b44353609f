"""Approximation of a lens field, or of coefficients that a format lacks, by Brown's coefficients that it stores."""

from dataclasses import replace

import numpy as np

from calibration.cameras.camera import INTRINSIC_PARAMETERS, Camera, StereoRig, normalise, project_with_jacobians
from calibration.kit.arrays import Array

BROWN = ("k1", "k2", "p1", "p2", "k3")


def within_brown(rig: StereoRig, terms: tuple[str, ...]) -> tuple[StereoRig, str]:
    """The rig without a lens field and with these coefficients only, and the error of this in words.

    Of each camera fx, fy, cx, cy and the coefficients are fitted to the images of rays through the whole image. If the
    rig needs only these coefficients, it is returned unchanged, with "".
    """
    lost = [name for name in BROWN if name not in terms and any(c.distortion[BROWN.index(name)] for c in rig.cameras)]
    if rig.lens_field is None and not lost:
        return rig, ""
    cameras, moved = zip(*(_refitted(rig, number, terms) for number in (0, 1)), strict=True)
    beyond = ["the lens field"] * (rig.lens_field is not None) + lost
    rms, most = np.sqrt(np.mean(np.concatenate(moved) ** 2)), np.abs(np.concatenate(moved)).max()
    words = f"{' and '.join(beyond)} fitted by fx fy cx cy {' '.join(terms)}: images differ by {rms:.2g} px rms"
    words += f", {most:.2g} at most"
    return replace(rig, left=cameras[0], right=cameras[1], lens_field=None), words


def _refitted(rig: StereoRig, number: int, terms: tuple[str, ...]) -> tuple[Camera, Array]:
    """The fitted camera, and the shifts (n, 2) [px] of the images of rays."""
    camera, field = rig.cameras[number], rig.lens_field
    free = np.array([name not in BROWN or name in terms for name in INTRINSIC_PARAMETERS])
    x, y = (np.linspace(0, size - 1, 40) for size in camera.image_size)
    seen = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    flat = normalise(seen if field is None else seen - field.displacement(seen, number), camera)
    good = np.isfinite(flat).all(axis=1)
    rays, seen = np.column_stack([flat, np.ones(len(flat))])[good], seen[good]
    values = np.where(free, camera.parameters, 0.0)
    for _ in range(20):  # Gauss-Newton steps
        found, _, slopes = project_with_jacobians(rays, Camera.from_parameters(values, camera.image_size))
        J = slopes[..., free].reshape(found.size, -1)
        values[free] += np.linalg.lstsq(J, (seen - found).ravel(), rcond=None)[0]
    fitted = Camera.from_parameters(values, camera.image_size)
    return fitted, project_with_jacobians(rays, fitted)[0] - seen
