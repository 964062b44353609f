"""Why the disc is not seen as declared: images mirrored or exchanged, a moved camera, or wrongly declared dots.

Used only if the dots contradict the declaration. Each transformation that a camera or an export program may have
applied to the images is undone, and the disc is searched for again.

If a camera was moved, each camera alone still sees the dots as declared. From blobs in some pairs, a pose for each pair
and one rotation and shift of the right camera are fitted (`self_calibration.fit_shared`): to a tenth of a degree and a
millimetre or two, as the two are correlated. That is enough to say what happened.

If other dots than declared are seen, each camera alone can identify them, at any scale and size. Triangulation of both
images gives their positions in the unit of the rig, to some 0.2 mm: enough to say which declared number is wrong.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, islice

import cv2
import numpy as np
import scipy

from calibration.board.target import Board
from calibration.cameras.camera import N_RIG, PAIR_SHIFT, PAIR_TURN, StereoRig, triangulate
from calibration.kit.types import AnyArray, Array, Mask
from disctrack.analyse.declaration import SIDE_TOLERANCE, other_scale
from disctrack.disc import Disc, has_mirror_axis
from disctrack.findings import NONSENSE, Finding, Kind, Remedy, Severity, Subject
from disctrack.frames import CAMERAS, vector_from_rotation
from disctrack.numbers import Measured
from disctrack.track.dots import acquisition
from disctrack.track.judge.doubts import misplaced_dots
from disctrack.track.pose import MIN_DOTS, DotsInFrames, dots_at
from disctrack.track.refine.self_calibration import declared_places_kept, fit_shared

TURN, SHIFT = np.radians(1.0), 2e-3  # [rad], [m] prior sigmas of an unnoticed motion of a camera
DOT_DIAMETERS_PX = (6.0, 18.0, 54.0, 162.0)  # each search finds blobs of a seventh to twice the diameter
SIZE_TOLERANCE = 0.15  # blur and threshold make a blob larger or smaller than its dot
MISPLACED = 0.2  # relative error of distances between dots: measured with a ruler, say; beyond, wrongly identified
MEETING_PX = 2 * acquisition.BLOB_PX  # misfit beyond which cameras or clocks contradict each other


def why_not_seen(pairs: AnyArray, rig: StereoRig, disc: Disc, board: Board | None) -> tuple[Finding, ...]:
    """The first explanation that holds, if any; pairs (n, 2, height, width) evenly spread over the recording."""
    few = pairs[:: max(1, len(pairs) // 2)][:2]
    explained = chain(
        (finding for pair in few for finding in arrangement_found(pair, rig, disc)),
        moved_camera(pairs, rig, disc),
        (finding for pair in few for finding in unlike_declared(pair, rig, disc, board)),
    )
    return tuple(islice(explained, 1))


def arrangement_found(pair: AnyArray, rig: StereoRig, disc: Disc) -> Iterator[Finding]:
    """The transformation of the images without which the disc is found.

    pair : (2, height, width). All dots but one must be found in both cameras, and more than in the images as declared.
    """
    enough = max(acquisition.acquire(pair, rig, disc)[1] + 1, 2 * disc.n_markers - 2)
    ways = list(_ways(pair, disc))
    dots = [acquisition.acquire(images, rig, layout, by_one=False)[1] for _, images, layout in ways]
    best = dots.index(max(dots))
    if dots[best] >= enough:
        text, _, layout = ways[best]
        kind, action = (Kind.MIRRORED, "store them as the views are") if best else (Kind.EXCHANGED, "exchange the two")
        remedies = [Remedy("[cameras] left, right", action=action)]
        if layout is not disc:
            kind, mirror = Kind.DOTS_MISPLACED, Remedy("[markers] centres_mm", action="y with the other sign")
            remedies.insert(0, mirror)
        yield Finding(kind, Severity.DOUBT, text, remedies=tuple(remedies), explains=NONSENSE)


def _ways(pair: AnyArray, disc: Disc) -> Iterator[tuple[str, tuple[AnyArray, AnyArray], Disc]]:
    """Possible transformations of the images, with the images and the disc after undoing them."""
    left, right = pair
    yield "the left and right images are exchanged", (right, left), disc
    for what, axis in (("mirrored left to right", 1), ("mirrored top to bottom", 0), ("turned by 180 deg", -1)):
        one, other = cv2.flip(left, axis), cv2.flip(right, axis)  # -1: both axes
        since = "since the chessboard was seen"
        yield f"the images of both cameras are {what} {since}", (one, other), disc
        yield f"the {CAMERAS[0]} camera's images are {what} {since}", (one, right), disc
        yield f"the {CAMERAS[1]} camera's images are {what} {since}", (left, other), disc
    if not has_mirror_axis(disc):
        seen_in_a_mirror = replace(disc, marker_centres_body=disc.marker_centres_body * [1.0, -1.0, 1.0])
        yield "the dots are those of [markers] as a mirror shows them", (left, right), seen_in_a_mirror


def moved_camera(pairs: AnyArray, rig: StereoRig, disc: Disc) -> Iterator[Finding]:
    """Motion of the right camera relative to the left one, if it explains the dots.

    pairs : (n, 2, height, width), evenly spread; both cameras must see the dots in most of them
    """
    seen = _by_each_camera(pairs, rig, disc)
    by_both = np.isfinite(seen.pixels).all(-1).sum(axis=2) > MIN_DOTS
    seen = seen.at(np.flatnonzero(by_both.all(axis=1)))
    if 2 * len(seen.t) < len(pairs) or len(seen.t) < MIN_DOTS:
        return
    sigma = np.zeros(N_RIG + 2 * disc.n_markers)
    sigma[PAIR_TURN], sigma[PAIR_SHIFT] = TURN, SHIFT
    found, _, reduced, _ = fit_shared(seen, sigma)
    rms, moved = acquisition.BLOB_PX * np.sqrt(reduced), rig.perturbed(found[:N_RIG])
    turn_deg = float(np.degrees(np.linalg.norm(vector_from_rotation(moved.R_right_left @ rig.R_right_left.T))))
    shift_mm = 1e3 * float(np.linalg.norm(moved.t_right_left - rig.t_right_left))
    if rms[-1] < MEETING_PX < rms[0]:
        text = (
            f"the right camera was turned by about {turn_deg:.1f} deg and shifted by {shift_mm:.0f} mm "
            f"against the left one since the calibration (what both see of the dots fits to {rms[-1]:.1f} px then, to "
            f"{rms[0]:.1f} as calibrated)"
        )
        sizes = {"turn": Measured(turn_deg, unit="deg"), "shift": Measured(shift_mm, unit="mm")}
        advice = (Remedy(action="calibrate again"),)
        yield Finding(Kind.CAMERA_MOVED, Severity.DOUBT, text, Subject("track", "right"), sizes, advice, NONSENSE)


def _by_each_camera(pairs: AnyArray, rig: StereoRig, disc: Disc) -> DotsInFrames:
    """Dots identified among blobs by each camera alone, in pairs (n, 2, height, width), with poses by the left one."""
    diameters = acquisition.expected_diameter_px(rig, disc)
    seen = [[acquisition.seen_by_one_camera(pair[c], c, diameters[c], rig, disc) for c in (0, 1)] for pair in pairs]
    pixels = np.array([[side[0][:, :2] for side in pair] for pair in seen]).reshape(-1, 2, disc.n_markers, 2)
    R, t = (np.array([pair[0][k] for pair in seen]) for k in (1, 2))
    covariance = np.broadcast_to(acquisition.BLOB_PX**2 * np.eye(2), (*pixels.shape, 2))
    return DotsInFrames(rig, disc, pixels, covariance, R, t)


def unlike_declared(pair: AnyArray, rig: StereoRig, disc: Disc, board: Board | None = None) -> tuple[Finding, ...]:
    """Which declared number contradicts the images, and its value, if it can be determined.

    pair : (2, height, width), images of the left and the right camera;  board : of the calibration
    """
    several = list(_seen_dots(pair, rig, disc))
    if not several:
        return ()
    which, points, _, scale, misfit_px = max(several, key=lambda found: found[0].sum())
    if abs(np.log(scale.value)) > SIDE_TOLERANCE:
        return (other_scale(scale, None if board is None else board.square, NONSENSE),)
    (R,), (t,) = acquisition.rigid_motions(disc.marker_centres_body[None, which], points[None])
    # median of the searches: a search for blobs much smaller than the dots finds only their darkest parts
    (affine,) = dots_at(R[None], t[None], rig, disc)[1]
    expected = np.pi / 4 * disc.marker_diameter**2 * np.abs(np.linalg.det(affine))
    sizes = [np.median(np.sqrt(areas / expected[:, numbered])) for numbered, _, areas, *_ in several]
    diameter = disc.marker_diameter * float(np.median(sizes))
    if abs(np.log(diameter / disc.marker_diameter)) > SIZE_TOLERANCE:
        remedy = Remedy("[markers] diameter_mm", f"{1e3 * diameter:.2g}", f"{1e3 * disc.marker_diameter:g}")
        text = "the dots' images are of another size"
        return (Finding(Kind.DIAMETER, Severity.DOUBT, text, remedies=(remedy,), explains=NONSENSE),)
    if not which.all() or misfit_px > MEETING_PX:
        return ()
    shift = (points - t) @ R - disc.marker_centres_body
    return misplaced_dots(disc, disc.marker_centres_body + declared_places_kept(disc, shift[:, :2]))


def _seen_dots(pair: AnyArray, rig: StereoRig, disc: Disc) -> Iterator[tuple[Mask, Array, Array, Measured, float]]:
    """Dots identified by both cameras, from searches for blobs of several sizes that succeed.

    yields : which of the declared dots were found (m,), k of them; their positions (k, 3) [m] in the rig's world and
        unit; areas (2, k) [px^2] of their blobs; scale of their distances over those declared; the largest
        reprojection error [px] of the triangulated points
    """
    for diameter in DOT_DIAMETERS_PX:
        blobs = np.stack([acquisition.seen_by_one_camera(pair[c], c, diameter, rig, disc)[0] for c in (0, 1)])
        which: Mask = np.asarray(np.isfinite(blobs).all((0, 2)))
        if which.sum() <= MIN_DOTS:
            continue
        pixels = blobs[:, which, :2]
        points = triangulate(pixels, rig)
        apart = scipy.spatial.distance.pdist
        ratios = apart(points) / apart(disc.marker_centres_body[which])
        scale = float(np.median(ratios))
        misfit = float(np.abs(rig.project(points) - pixels).max())
        if misfit < acquisition.EPIPOLAR_PX and scale > 0 and np.abs(ratios / scale - 1).max() < MISPLACED:
            # uneven light shifts all blobs alike: more blobs do not reduce the error
            uncertain = float(np.sqrt(2) * acquisition.BLOB_PX / np.median(apart(pixels[0])))
            yield which, points, blobs[:, which, 2], Measured(scale, scale * uncertain), misfit
