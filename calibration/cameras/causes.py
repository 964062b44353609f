"""What the uncertainty of a quantity comes from: the views of the board, its sizes, the disc's."""

from collections.abc import Mapping

import numpy as np

from calibration.cameras.camera import StereoRig
from calibration.kit.arrays import Array


def causes(rig: StereoRig, shift: Array, further: Mapping[str, Array] | None = None) -> tuple[Array, list[str]]:
    """Standard deviation (k,) of quantities by the rig, and for each what contributes most.

    shift : (n, k, 30) their derivative by RIG_PARAMETERS at n places, over which variances are averaged
    further : variances (k,) by other causes
    """

    def variance(C: Array) -> Array:
        found: Array = np.einsum("nkp,nkp->k", shift @ C, shift) / len(shift)
        return found

    parts: dict[str, Array] = {}
    for a in rig.allowances:
        parts[a.cause] = parts.get(a.cause, 0.0) + variance(np.outer(a.shift, a.shift))
    parts = {"the views": np.maximum(variance(rig.covariance) - sum(parts.values()), 0.0), **parts}
    for cause, own in (further or {}).items():
        parts[cause] = parts.get(cause, 0.0) + own
    table = np.array(list(parts.values()))
    return np.sqrt(table.sum(axis=0)), [list(parts)[i] for i in table.argmax(axis=0)]
