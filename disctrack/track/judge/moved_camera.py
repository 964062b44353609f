"""A camera that was moved or turned after its calibration, from images in which no disc is found for that reason.

Each camera alone still sees the dots as declared. From blobs in some pairs, one pose for each pair and one turn and
shift of the right camera for all are fitted (`self_calibration.fit_shared`): to a tenth of a
degree and a millimetre or two, as the two make up for each other; enough to say what happened.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.camera import N_RIG, PAIR_SHIFT, PAIR_TURN, StereoRig
from disctrack.disc import Disc
from disctrack.findings import NONSENSE, Finding, Kind, Number, Remedy, Severity, Subject
from disctrack.frames import vector_from_rotation
from disctrack.track.dots.acquisition import BLOB_PX, MIN_EXPLAINED, expected_diameter_px, seen_by_one_camera
from disctrack.track.pose import fit_poses
from disctrack.track.refine.self_calibration import MIN_FRAMES, DotsInFrames, fit_shared

TURN, SHIFT = np.radians(1.0), 2e-3  # [rad], [m] what cameras suffer without anybody's notice: prior sigmas
MOST_SIGMAS = 4.0  # beyond, it is something else
FITS_PX = 1.0  # rms of blobs about the fit
BETTER = 3.0  # times, than with the camera where it was


def moved_camera(pairs: NDArray, rig: StereoRig, disc: Disc) -> Iterator[Finding]:
    """How the right camera moved against the left one, where that explains what is seen.

    pairs : (n, 2, height, width), from all over the recording; fewer than MIN_FRAMES with dots tell nothing
    """
    diameters = expected_diameter_px(rig, disc)
    seen = [[seen_by_one_camera(pair[c], c, diameters[c], rig, disc) for c in (0, 1)] for pair in pairs]
    pixels = np.array([[side[0][:, :2] for side in pair] for pair in seen]).reshape(-1, 2, disc.n_markers, 2)
    good = np.isfinite(pixels).all(-1).sum(axis=2).min(axis=1, initial=disc.n_markers) >= MIN_EXPLAINED
    if good.sum() < MIN_FRAMES:
        return
    pixels = pixels[good]
    R, t = (np.array([pair[0][k] for pair in seen])[good] for k in (1, 2))
    covariance = np.broadcast_to(BLOB_PX**2 * np.eye(2), (*pixels.shape, 2))
    left_alone = np.where(np.arange(2)[:, None, None] == 0, pixels, np.nan)
    began = fit_poses(
        left_alone, covariance, rig, disc.marker_centres_body, R, t, reject_outliers=False, with_sensitivity=False
    )
    free = np.zeros(N_RIG + 2 * disc.n_markers, bool)
    free[PAIR_TURN] = free[PAIR_SHIFT] = True
    information = np.diag(np.repeat([TURN**-2, SHIFT**-2], 3))
    dots = DotsInFrames(rig, disc, pixels, covariance, began.R_world_body, began.t_world_body)
    found = fit_shared(dots, free, information)
    rms = BLOB_PX * np.sqrt(found.reduced_chi_square)
    moved = rig.perturbed(found.shift[:N_RIG])
    turn = np.linalg.norm(vector_from_rotation(moved.R_right_left @ rig.R_right_left.T))
    shift = np.linalg.norm(moved.t_right_left - rig.t_right_left)
    if rms[-1] < FITS_PX and rms[0] > BETTER * rms[-1] and max(turn / TURN, shift / SHIFT) < MOST_SIGMAS:
        text = (
            f"the right camera was turned by about {np.degrees(turn):.1f} deg and shifted by {1e3 * shift:.0f} mm "
            f"against the left one since the calibration (what both see of the dots fits to {rms[-1]:.1f} px then, to "
            f"{rms[0]:.1f} as calibrated)"
        )
        sizes = {"turn": Number(float(np.degrees(turn)), "deg"), "shift": Number(1e3 * float(shift), "mm")}
        advice = (Remedy(action="calibrate again"),)
        yield Finding(Kind.CAMERA_MOVED, Severity.DOUBT, text, Subject("track", "right"), sizes, advice, NONSENSE)
