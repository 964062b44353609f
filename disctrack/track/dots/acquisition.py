"""Find and identify the dots without a prior: blobs in both images, then the rigid motion that explains most of them.

Stereo first: pairs of blobs are triangulated, and triples of points with the mutual distances of three dots give
candidate poses. If one camera sees too few dots, three blobs of the other give candidate poses (perspective three-point
problem). Of mirror-image solutions the one that touches the table is chosen.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations

import cv2
import numpy as np

from calibration.cameras.camera import StereoRig, normalise, triangulate
from calibration.kit.grey_levels import level_step
from calibration.kit.types import AnyArray, Array
from disctrack.analyse.declaration import SIDE_TOLERANCE
from disctrack.disc import Disc
from disctrack.faults.dots import marker_pixels
from disctrack.frames import CAMERAS, euler_from_rotation, rotation_from_vector
from disctrack.track.pose import MIN_DOTS, DotsInFrames

MAX_BLOBS = 24
EPIPOLAR_PX = 4.0  # centroids of blobs err by up to 1 px under glare, the rig by much less
INLIER_DIAMETERS = 0.35  # largest distance between a blob and its dot, in diameters of the dot
BLOB_PX = 0.5  # standard deviation of a blob's centroid under uneven light
CANDIDATES = 40  # poses that are refined

Pose = tuple[Array, Array]  # R_world_body (3, 3), t_world_body (3,) [m]
# Pose to a fraction of a pixel, or None; dot images explained by blobs, in both cameras together; why there is no pose
Found = tuple[Pose | None, int, str]


def dot_blobs(image: AnyArray, expected_diameter_px: float) -> Array:
    """Centroids and areas (k, 3) of elliptical blobs, dark on light and light on dark, most elliptical first.

    x, y [px], area [px^2]. The threshold is relative to the local mean, so uneven light does not matter. The area of a
    blob must be that of the ellipse with the same second moments.
    """
    grey = np.asarray(image, np.float32) / np.float32(level_step(image))  # same result for any bit depth
    block = 2 * int(1.25 * expected_diameter_px) + 1
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    mean = cv2.blur(smooth, (block, block), borderType=cv2.BORDER_REPLICATE)
    spread = np.median(np.abs(smooth - mean))
    # relative to the local mean, against gradients of glare; three spreads at least, for dim images
    threshold = np.maximum(0.12 * mean, 3.0 * spread)
    masks = smooth < mean - threshold, smooth > mean + threshold
    found = sorted(blob for mask in masks for blob in _elliptical_components(mask, expected_diameter_px))
    return np.array([blob[1:] for blob in found[:MAX_BLOBS]], float).reshape(-1, 3)


def _elliptical_components(mask: AnyArray, diameter: float) -> Iterator[tuple[float, float, float, float]]:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        if len(contour) < 8:
            continue
        moments = cv2.moments(contour)
        area = moments["m00"]
        if not 0.02 * diameter**2 < area < 4.0 * diameter**2:
            continue
        a, b, c = moments["mu20"] / area, moments["mu11"] / area, moments["mu02"] / area
        root = np.hypot(0.5 * (a - c), b)
        major, minor = 0.5 * (a + c) + root, 0.5 * (a + c) - root
        if minor <= 0.2:
            continue
        misfit = abs(area / (4 * np.pi * np.sqrt(major * minor)) - 1.0)
        if misfit < 0.08 and 2 * np.sqrt(major) < 1.3 * diameter:
            yield misfit, moments["m10"] / area, moments["m01"] / area, area


def expected_diameter_px(rig: StereoRig, disc: Disc) -> list[float]:
    """Diameter of a dot's image in each camera, at the point of its axis on the table, or at 0.5 m without a table."""
    result = []
    for camera, (R, t) in zip(rig.cameras, rig.camera_poses(), strict=True):
        distance = (R.T @ t)[2] / R[2, 2] if rig.world_is_table and R[2, 2] < -0.05 else 0.5
        result.append(camera.fx * disc.marker_diameter / distance)
    return result


def acquire(pair: Sequence[AnyArray] | AnyArray, rig: StereoRig, disc: Disc, by_one: bool = True) -> Found:
    """Find the disc in the images of both cameras, at any position and attitude.

    by_one : use the dots of a single camera, too, if both together show too few; that takes four times as long
    """
    blobs = [dot_blobs(*each)[:, :2] for each in zip(pair, expected_diameter_px(rig, disc), strict=True)]
    return acquire_from_blobs(blobs, rig, disc, by_one)


def acquire_from_blobs(blobs: list[Array], rig: StereoRig, disc: Disc, by_one: bool = True) -> Found:
    """As `acquire` from the centroids of candidate blobs in the left and in the right image, each (k, 2)."""
    candidates = _candidates_from_stereo(blobs, rig, disc)
    pose, explained = _best_explanation(candidates, blobs, rig, disc)
    if by_one and explained < 2 * disc.n_markers - 3:
        for camera in (0, 1):
            candidates += _candidates_from_one_camera(blobs[camera], camera, rig, disc)
        pose, explained = _best_explanation(candidates, blobs, rig, disc)
    if pose is not None:
        return pose, explained, ""
    counts = " and ".join(f"{len(b)} in the {name}" for b, name in zip(blobs, CAMERAS, strict=True))
    reason = (
        f"no arrangement of the blobs found ({counts} image) matches the {disc.n_markers} dots of [markers]: "
        "is the upper face visible, are diameter and centres right, does the rig belong to these images?"
    )
    return None, explained, reason


def seen_by_one_camera(
    image: AnyArray, camera: int, diameter_px: float, rig: StereoRig, disc: Disc
) -> tuple[Array, Array, Array]:
    """Dots identified by one camera among blobs of about this diameter, and the pose R_world_body, t_world_body.

    The blobs are x, y [px], area [px^2], (n_markers, 3), NaN for dots that are not seen. A single camera does not
    determine the scale: neither baseline nor table matter.
    """
    blobs = dot_blobs(image, diameter_px)
    best = np.full((disc.n_markers, 3), np.nan), np.eye(3), np.zeros(3)
    for R, t in _candidates_from_one_camera(blobs[:, :2], camera, rig, disc):
        gap = _gaps(R[None], t[None], blobs[:, :2], camera, rig, disc)[0]
        seen, nearest = gap.min(axis=1) < 1, gap.argmin(axis=1)
        one_each = len(set(nearest[seen])) == seen.sum()  # a distant or edge-on disc has many dots in one blob
        if one_each and seen.sum() > np.isfinite(best[0][:, 0]).sum():
            best = np.where(seen[:, None], blobs[nearest], np.nan), R, t
    return best


def _gaps(R: Array, t: Array, blobs: Array, camera: int, rig: StereoRig, disc: Disc) -> Array:
    """(n, m, k) distances of blobs (k, 2) from the dots of poses R (n, 3, 3), t (n, 3) in a camera's image.

    In units of INLIER_DIAMETERS: below 1 a blob belongs to a dot. Infinite behind the camera, or if the face is turned
    away.
    """
    pixels = marker_pixels(R, t, rig, disc.marker_centres_body)[0][:, camera]
    R_cw, t_cw = rig.camera_poses()[camera]
    facing = np.einsum("ni,ni->n", R[:, :, 2], -R_cw.T @ t_cw - t) > disc.half_thickness
    reach = INLIER_DIAMETERS * rig.cameras[camera].fx * disc.marker_diameter / (t @ R_cw[2] + t_cw[2])
    gap = np.linalg.norm(pixels[:, :, None] - blobs, axis=-1) / reach[:, None, None]
    return np.where(facing[:, None, None] & np.isfinite(gap), gap, np.inf)


def _score(gap: Array) -> Array:
    """(n,) scores of poses from the distances (n, m) of the nearest blobs: per dot 1 at its centre, 0 beyond 1."""
    return np.asarray(np.sum(np.clip(1 - gap**2, 0, None), axis=1))


def _candidates_from_stereo(blobs: list[Array], rig: StereoRig, disc: Disc) -> list[Pose]:
    if min(len(b) for b in blobs) < 3:
        return []
    i, j = np.indices((len(blobs[0]), len(blobs[1]))).reshape(2, -1)
    pixels = np.stack([blobs[0][i], blobs[1][j]])
    with np.errstate(all="ignore"):
        points = triangulate(pixels, rig)
        error = np.linalg.norm(rig.project(points) - pixels, axis=-1).max(axis=0)
    keep = error < EPIPOLAR_PX
    if rig.world_is_table:  # a dot is neither below the table nor higher than a disc that stands on its edge
        keep &= (points[:, 2] > -3e-3) & (points[:, 2] < 2.1 * disc.radius + 2 * disc.half_thickness)
    points = points[keep][np.argsort(error[keep])][:MAX_BLOBS]
    if len(points) < 3:
        return []
    centres = disc.marker_centres_body
    orders = np.array([*permutations(range(len(points)), 3)])
    triples = np.array([*combinations(centres, 3)])
    apart = np.abs(_sides(points[orders]) / _sides(triples)[:, None] - 1.0).max(axis=2)
    dots, order = np.nonzero(apart < SIDE_TOLERANCE)
    R, t = rigid_motions(triples[dots], points[orders[order]])
    # the score counts the dots with a point near them
    predicted = centres @ np.swapaxes(R, 1, 2) + t[:, None]
    gap = np.linalg.norm(predicted[:, :, None] - points[None, None], axis=-1).min(axis=2)
    return _best(R, t, _score(gap / (INLIER_DIAMETERS * disc.marker_diameter)))


def _sides(triangles: Array) -> Array:
    """(..., 3) lengths of the sides of triangles (..., 3, 3)."""
    return np.asarray(np.linalg.norm(triangles - np.roll(triangles, -1, axis=-2), axis=-1))


def _best(R: Array, t: Array, score: Array) -> list[Pose]:
    """The poses with the highest scores."""
    return [(R[k], t[k]) for k in np.argsort(-score, kind="stable")[:CANDIDATES]]


def rigid_motions(body: Array, world: Array) -> tuple[Array, Array]:
    """Rotations and translations that map sets (k, n, 3) of body points onto world points (Kabsch)."""
    b0, w0 = body.mean(axis=1, keepdims=True), world.mean(axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(body - b0, 1, 2) @ (world - w0))
    sign = np.sign(np.linalg.det(U @ Vt))
    Vt[:, 2] *= sign[:, None]
    R = np.swapaxes(U @ Vt, 1, 2)
    return R, (w0 - b0 @ np.swapaxes(R, 1, 2))[:, 0]


def _candidates_from_one_camera(blobs: Array, camera: int, rig: StereoRig, disc: Disc) -> list[Pose]:
    if len(blobs) <= MIN_DOTS:
        return []
    blobs = blobs[:9]
    rays = normalise(blobs, rig.cameras[camera])
    R_cw, t_cw = rig.camera_poses()[camera]
    centres = disc.marker_centres_body
    # triples of dots far apart determine the pose best, and are tried first
    triples = sorted(
        combinations(range(len(centres)), 3),
        key=lambda k: -np.linalg.norm(np.cross(centres[k[1]] - centres[k[0]], centres[k[2]] - centres[k[0]])),
    )[:6]
    orders = np.array([*permutations(range(len(blobs)), 3)])
    images = np.ascontiguousarray(rays[orders].reshape(-1, 3, 1, 2))
    R, t, score = np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0)
    for triple in triples:
        model = np.ascontiguousarray(centres[list(triple)].reshape(3, 1, 3))
        solved = [cv2.solveP3P(model, image, np.eye(3), None, flags=cv2.SOLVEPNP_AP3P) for image in images]
        turns = np.array([turn for n, turns, _ in solved for turn in turns[:n]]).reshape(-1, 3)
        shifts = np.array([shift for n, _, shifts in solved for shift in shifts[:n]]).reshape(-1, 3)
        turned, placed = R_cw.T @ rotation_from_vector(turns), (shifts - t_cw) @ R_cw
        R, t = np.concatenate([R, turned]), np.concatenate([t, placed])
        score = np.append(score, _score(_gaps(turned, placed, blobs, camera, rig, disc).min(axis=2)))
        if score.max(initial=0.0) > len(centres) - 1.0:
            break  # all dots are explained to the accuracy of blobs: no other triple does better
    good = score > MIN_DOTS + 0.5
    return _best(R[good], t[good], score[good])


def _best_explanation(poses: list[Pose], blobs: list[Array], rig: StereoRig, disc: Disc) -> tuple[Pose | None, int]:
    """Fit the poses to the blobs they explain; the best one, or None, and the number of dot images explained."""
    if not poses:
        return None, 0
    R, t = (np.array(parts) for parts in zip(*poses, strict=True))
    shape = len(R), 2, disc.n_markers
    covariance = np.broadcast_to(BLOB_PX**2 * np.eye(2), (*shape, 2, 2))
    for _ in range(2):  # match with the pose of the triple, then with the refined one
        matched = np.full((*shape, 2), np.nan)
        for camera, points in enumerate(blobs):
            if len(points):
                gap = _gaps(R, t, points, camera, rig, disc)
                matched[:, camera] = np.where((gap.min(axis=2) < 1)[..., None], points[gap.argmin(axis=2)], np.nan)
        seen, fits = DotsInFrames(rig, disc, matched, covariance, R, t).fitted(reject=False)
        R, t = seen.R, seen.t
    explained = np.isfinite(matched).all(-1).sum((1, 2))
    rms = BLOB_PX * np.sqrt(fits.chi_square / np.maximum(explained, 1))
    # each dot explained is worth 2 px of rms; each half thickness off the table costs 0.5 px
    cost = rms - 2.0 * explained
    if rig.world_is_table:
        gap = np.abs(t[:, 2] - disc.resting_height(euler_from_rotation(R)[:, 1]))
        cost += 0.5 * np.minimum(gap, 5e-3) / disc.half_thickness
    cost = np.where((explained > MIN_DOTS) & (rms < 2.5) & fits.converged, cost, np.inf)
    k = int(np.argmin(cost))
    return ((R[k], t[k]), int(explained[k])) if np.isfinite(cost[k]) else (None, 0)
