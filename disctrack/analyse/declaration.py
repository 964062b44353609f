"""Physics against declaration: do the measured motion and the dots contradict a number that was declared?

Three laws hold whatever the friction is, and each contains declared numbers:

- moments about the centre along e1, if the only contact force is that of the table at A:
  e1 . (J alpha + omega x J omega) = e1 . (r_OA x m (a + g k)). Time is counted in frames, so that the gravity which
  satisfies it is proportional to the square of the frame rate and to the radius; the mass cancels. It holds in
  rolling, in slip and in free flight, but not while something else touches the disc, or at rest on a patch.
- rigidity: the distances of the dots, triangulated, equal those of their declared centres in units of the chessboard.
- geometry: the centre of a disc on its rim is r sin(theta) + h cos(theta) above one plane, the table. If that gives
  the same radius as the moments, the radius is wrong, and not gravity or the rate.

A mirrored world satisfies all three. It is recognised by chirality: dots without an axis of symmetry are not found in
it, and the left camera is on the right.

A finding names the declared numbers that could be wrong, most likely first, the observation and the expectation.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
import scipy

from calibration.cameras.camera import StereoRig, triangulate
from calibration.kit.types import Array, evenly, robust_sigma
from disctrack.analyse.derivatives import K, MeasuredMotion, differentiate
from disctrack.analyse.quantities import COLUMN, SIGMAS, quantities
from disctrack.disc import Disc, has_mirror_axis, symmetry_order
from disctrack.errors import AnalysisError
from disctrack.faults.clock_jump import clock_jumps, in_words
from disctrack.findings import MISFITS, Finding, Kind, Remedy, Severity, Subject
from disctrack.frames import CAMERAS, rotation_from_quaternion
from disctrack.numbers import Measured, measured, rounded
from disctrack.trajectory import FrameStatus, MarkerStatus, Trajectory, part

if TYPE_CHECKING:
    from disctrack.recording.declaration import Recording


SIDEWAYS = 0.5  # smallest cosine between the baseline and the direction to the right
USUAL_RATES = np.outer(10.0 ** np.arange(1, 7), [1, 1.2, 1.25, 1.5, 2, 2.4, 2.5, 3, 4, 5, 6, 7.5, 8]).ravel()  # [Hz]
STRETCHES, BLOCK = 4, 20  # number of stretches that are analysed; frames per estimate
MIN_BLOCKS = 5  # estimates that determine their scatter; blocks per stretch
# Below, the disc may lie on a patch of its face, so that the weight has no lever arm; above, the arm is short.
THETA_RANGE = np.radians(1.0), np.radians(60.0)
BALANCE = 0.10  # relative; rounded edges and a table tilted by a degree shift the balance by 3 % at most
NOTED = 0.01  # relative deviation of the balance, or growth of the energy, that is reported
SCALE = 5e-3  # relative, of printed dots to a printed board, with paper and toner
BY_SCALE = (Kind.DOTS_MISPLACED, Kind.RADIUS, Kind.THICKNESS, Kind.BOARD_THICKNESS, Kind.GRAVITY_OR_RATE, *MISFITS)
SIDE_TOLERANCE = 0.06  # of a length: at a larger difference of the print's scale the dots also differ in size
MIN_LEAN = np.radians(2.0)  # of a plane: boards and tables are tilted by less
SEEN_RARELY = 0.1  # fraction of the images
MOST_HEIGHT = 3e-3  # [m] from the rim's plane to the lower face of a board that lies on it, of uncertain thickness
CLAIM_POSITION = 5e-6  # [m] the claimed accuracy: Ma et al. 2014, end of section 3
LAB_FRAME = 20e-6  # [m] accuracy of the position of a board on a table, without particular care
OFF = (Kind.TABLE_DISAGREES, Kind.ACCURACY)  # consequences of a wrong height
UNITS = {1e3: "mm and m", 1e2: "m and cm", 10.0: "cm and mm", 25.4: "inches and mm", 2.0: "radius and diameter"}


class Boards(NamedTuple):
    """Poses of the board in the views of the calibration, in axes of the left camera."""

    places: Mapping[int, tuple[Array, Array]]  # number of the view: R_left_board (3, 3), t_left_board (3,) [m]
    table_view: int | None
    thickness: float  # [m] of the board on the table
    findings: tuple[Finding, ...] = ()  # of the calibration


def contradictions(
    trajectory: Trajectory,
    disc: Disc | None = None,
    recording: "Recording | None" = None,
    noticed: Sequence[Finding] = (),
    boards: Boards | None = None,
    blur_px: Sequence[float] = (),
) -> tuple[Finding, ...]:
    """Every check that this trajectory allows, then the findings of the tracking.

    disc : as declared, before its dots were refined;  recording : the whole declaration, if available
    noticed : findings of the tracking
    boards : in the views of the calibration;  blur_px : of the edges of the dots, per camera
    """
    disc, board = disc or trajectory.disc, None if recording is None else recording.chessboard
    found = [*density(disc), *scale_of_dots(trajectory, disc, None if board is None else board.square)]
    found += [*unseen_dots(trajectory, disc), *lost_pairs(trajectory)]
    if trajectory.rig.world_is_table:
        found += handedness(trajectory.rig, disc)
        off = next((f for f in noticed if f.kind == Kind.TABLE_DISAGREES), None)
        height = None if off is None else 1e-6 * off.numbers["height"].value
        # with a wrong table plane, neither heights nor the direction of gravity are known
        elsewhere = another_plane(trajectory, boards)
        found += elsewhere or motion_against_gravity(trajectory, height)
        if recording is not None and recording.table is not None and off is not None and not elsewhere:
            found += thickness(disc, recording.table.board_thickness, off)
    found += () if board is None else turned_board(board.inner_corners)
    return (*found, *noticed, *(unsharp(trajectory, blur_px) if blur_px else ()))


def thickness(disc: Disc, board: float, off: Finding) -> tuple[Finding, ...]:
    """Thickness of the board, or of the disc, with which the rim is on the table.

    board : [m] as declared;  off : the finding on the height of the table
    """
    if not off.doubtful:
        return ()
    height = off.numbers["height"].value
    sizes = (
        ("[table] board_thickness_mm", Kind.BOARD_THICKNESS, 1e3 * board, 1e3 * board - 1e-3 * height),
        ("[disc] thickness_mm", Kind.THICKNESS, 2e3 * disc.half_thickness, 2e3 * disc.half_thickness + 1e-3 * height),
    )
    suspects = [
        # zero is not a measured thickness: it was forgotten
        (_apart(fits, size) if size else 0.0, kind, Remedy(key, f"{fits:.2f}", f"{size:g}"))
        for key, kind, size, fits in sizes
        if fits > 0
    ]
    text = f"the disc's rim rolls {1e-3 * height:+.2f} mm from the table that the board gives"
    return (_contradiction(suspects, text, OFF),) if suspects else ()


def across(trajectory: Trajectory) -> Array:
    """(2,) [px] minor axis of the image of a dot in each camera, in the middle of the recording."""
    rows = np.flatnonzero(trajectory.measured)
    row, rig = rows[len(rows) // 2], trajectory.rig
    R, t = map(np.array, zip(*rig.camera_poses(), strict=True))
    centres, axes = R @ trajectory.q[row, :3] + t, R @ rotation_from_quaternion(trajectory.quaternion[row])[:, 2]
    slant = np.abs(np.sum(centres * axes, axis=1)) / np.linalg.norm(centres, axis=1)
    focal = np.array([camera.fx for camera in rig.cameras])
    return np.asarray(focal * trajectory.disc.marker_diameter / centres[:, 2] * slant)


def unsharp(trajectory: Trajectory, blur_px: Sequence[float]) -> Iterator[Finding]:
    """Dots so narrow that the blur of opposite edges overlaps, and positions less accurate than claimed."""
    if not trajectory.measured.any():
        return
    for camera, blur, width in zip(CAMERAS, blur_px, across(trajectory), strict=True):
        if 6 * blur > width:  # three sigma on each side
            text = (
                f"{camera} camera: dots are {width:.1f} px across, their edges are blurred by {blur:.2f} px (sigma): "
                "the blur of opposite edges overlaps"
            )
            advice = Remedy(action="larger dots, sharper focus, a shorter exposure, or cameras that look more steeply")
            of = Subject(camera=camera)
            yield Finding(Kind.SHARPNESS, Severity.WARNING, text, of, remedies=(advice,), explains=(Kind.ACCURACY,))
    noise, shared = (
        float(np.nanmedian(sigma[:, :3], axis=0).max())
        for sigma in (trajectory.coordinate_sigma, trajectory.calibration_sigma)
    )
    advice = Remedy(action="more views of the board, tilted and all over; a board that is known better")
    if noise > CLAIM_POSITION:
        advice = Remedy(action="more light, sharper or larger dots")
    if noise > CLAIM_POSITION or shared > LAB_FRAME:
        text = (
            f"a position has a standard deviation of {measured(noise, unit='m')} by the noise of its frame, and of "
            f"{measured(shared, unit='m')} that all frames share"
        )
        yield Finding(Kind.ACCURACY, Severity.WARNING, text, remedies=(advice,))


def lost_pairs(trajectory: Trajectory) -> Iterator[Finding]:
    """Image pairs that both cameras dropped while the files were numbered consecutively."""
    for row, lost in clock_jumps(trajectory).items():
        frame = int(trajectory.frame[row])
        text = f"frame {frame}: {in_words(lost)}; all later times are wrong"
        of, size = Subject(frames=((frame, frame),)), {"pairs": Measured(lost)}
        advice = (Remedy(action=f"number the files from {frame} on higher by {lost}"),)
        explains = Kind.GRAVITY_OR_RATE, Kind.REVERSED, Kind.POSES_SCATTER
        yield Finding(Kind.CLOCK_JUMP, Severity.DOUBT, text, of, size, advice, explains)


# A declared number that may be wrong: |ln| of the fitting value over an ordinary one; kind; remedy. The smallest is the
# most likely.
Suspect: TypeAlias = tuple[float, Kind, Remedy]


def _contradiction(
    suspects: Sequence[Suspect], text: str, explains: tuple[Kind, ...] = (), **numbers: Measured
) -> Finding:
    """A finding that names all suspects, of the kind of the most likely one."""
    likely = sorted(suspects, key=itemgetter(0))
    remedies = tuple(remedy for *_, remedy in likely)
    return Finding(likely[0][1], Severity.DOUBT, text, numbers=numbers, remedies=remedies, explains=explains)


def _apart(one: float, other: float) -> float:
    return abs(float(np.log(one / other)))


def _typical(estimates: Array, unit: str = "") -> Measured:
    """Median of independent estimates, and its sigma from their scatter."""
    return Measured(float(np.median(estimates)), robust_sigma(estimates) * np.sqrt(np.pi / 2 / len(estimates)), unit)


def _slope(x: Array, y: Array) -> Measured:
    """Slope of y over x; outliers, as of a disc in the air or in a hand, count less.

    The sigma takes the autocorrelation of the residuals into account: a push, or a curve, has few independent points.
    """
    weight = np.ones(len(x))
    for _ in range(6):
        slope, offset = np.polyfit(x, y, 1, w=np.sqrt(weight))
        residual = y - slope * x - offset
        weight = _robust_weights(residual)
    scatter, rho = robust_sigma(residual), np.maximum(np.corrcoef(residual[:-1], residual[1:])[0, 1], 0.0)
    sigma = scatter / np.std(x) * np.sqrt((1 + rho) / (1 - rho) / len(x))
    return Measured(float(slope), float(sigma))


def _known(found: Measured) -> bool:
    """Whether a positive number is significant."""
    return found.value > SIGMAS * found.sigma


def _beyond(found: Measured, expected: float, tolerance: float) -> bool:
    """Whether a number differs from the expected one by more than its sigmas and a relative tolerance."""
    differs = _known(found) and abs(found.value - expected) > SIGMAS * found.sigma
    return bool(differs and _apart(found.value, expected) > np.log1p(tolerance))


def motion_against_gravity(trajectory: Trajectory, height: float | None = None) -> tuple[Finding, ...]:
    """Gravity and frame rate, and an energy that grows, on some stretches of the recording.

    Other forces, of a hand or a push, differ from block to block: then nothing is significant.
    height : [m] of the disc's lowest point above the declared table, if they disagree
    """
    found, energy = balance(trajectory)
    if len(found) < MIN_BLOCKS:
        return ()
    g, gravity = trajectory.gravity, _typical(found, "m/s^2")
    if _beyond(gravity, g, NOTED):
        text = (
            f"the motion satisfies the balance of moments with a gravity of {gravity} ({len(found)} stretches of "
            f"{BLOCK} frames); expected {g:.4g} m/s² at {trajectory.frame_rate:g} frames a second, nothing but the "
            "table touching the disc"
        )
        suspects = _of_gravity(trajectory, gravity, height)
        severity = Severity.DOUBT if _beyond(gravity, g, BALANCE) else Severity.NOTE
        away, kind, _ = min(suspects, key=itemgetter(0))
        explains = (Kind.REVERSED, *OFF) if kind == Kind.RADIUS else (Kind.REVERSED,)
        if kind == Kind.RADIUS and not away:  # two laws give the same radius
            severity = max(severity, Severity.WARNING)
        return (replace(_contradiction(suspects, text, explains, gravity=gravity), severity=severity),)
    if not _known(gravity):
        return ()
    grown = replace(_slope(np.linspace(0, 1, len(energy)), 1e3 * energy), unit="mJ")
    if _known(grown) and grown.value > 1e3 * NOTED * energy[0]:
        text = (
            f"the mechanical energy, {1e3 * energy[0]:.4g} mJ at first, grows by {grown} though no force but the "
            "table's acts; expected a loss"
        )
        remedy = Remedy("[cameras] left, right", action="give the files in the order of time")
        return (_contradiction([(0.0, Kind.REVERSED, remedy)], text, growth=grown),)
    return ()


def _of_gravity(trajectory: Trajectory, gravity: Measured, height: float | None) -> tuple[Suspect, ...]:
    """Declared numbers that, if wrong, explain this gravity of the balance."""
    g, rate = trajectory.gravity, trajectory.frame_rate
    ratio = gravity.value / g
    true_rate = rate / np.sqrt(ratio)
    usual = float(min(USUAL_RATES, key=lambda other: _apart(true_rate, other)))
    away = _apart(true_rate, usual)
    hint = f"{usual:g} is usual" if away < BALANCE / 2 else ""
    true_rate = usual if away < SIGMAS * gravity.sigma / gravity.value / 2 else true_rate
    unit = "if it was given in mm/s²" if _apart(1e3 * ratio, 1.0) < BALANCE else ""
    by_gravity = Remedy("[gravity] g_m_s2", f"{gravity.value:.4g}", f"{g:g}", unit)
    by_rate = Remedy("[cameras] frame_rate_hz", f"{true_rate:.4g}", f"{rate:g}", hint)
    return (
        (_apart(gravity.value, 9.81), Kind.GRAVITY_OR_RATE, by_gravity),
        (away, Kind.GRAVITY_OR_RATE, by_rate),
        _radius_suspected(trajectory, ratio, height),
    )


def _radius_suspected(trajectory: Trajectory, ratio: float, height: float | None) -> Suspect:
    """The most likely suspect if heights of the rim give nearly the same radius as the balance, unlike the declared."""
    z, theta = trajectory.q[trajectory.measured][:, [2, 4]].T
    disc, would_be, misfit = trajectory.disc, trajectory.disc.radius / ratio, _apart(ratio, 1.0)
    by_rim = float(np.median((z - disc.half_thickness * np.abs(np.cos(theta))) / np.sin(theta)))
    # if the tracking shifted the table to the disc: from that shift
    by_table = by_rim if height is None else disc.radius + height / float(np.median(np.sin(theta)))
    for radius, better in ((by_rim, by_rim), (by_table, would_be)):
        if trajectory.rig.world_is_table and radius > 0 and _apart(radius, would_be) < 0.5 * misfit:
            would_be, misfit = better, 0.0
    remedy = Remedy("[disc] radius_mm", f"{1e3 * would_be:.4g}", f"{1e3 * disc.radius:g}")
    return (misfit, Kind.RADIUS, remedy)


def density(disc: Disc) -> Iterator[Finding]:
    """A disc lighter than a hard foam or heavier than osmium: mass, radius or thickness is in a wrong unit."""
    found = disc.mass / (2 * np.pi * disc.radius**2 * disc.half_thickness)
    if not 50.0 < found < 23e3:
        sizes = {"mass_g": disc.mass, "radius_mm": disc.radius, "thickness_mm": 2 * disc.half_thickness}
        remedies = tuple(Remedy(f"[disc] {key}", declared=f"{1e3 * size:g}") for key, size in sizes.items())
        text = (
            f"mass, radius and thickness give the disc a density of {1e-3 * found:.2g} g/cm³; expected 0.05 (foam) to "
            "23 (osmium)"
        )
        yield Finding(Kind.DENSITY, Severity.WARNING, text, remedies=remedies)


def balance(trajectory: Trajectory) -> tuple[Array, Array]:
    """Gravity [m/s^2] that satisfies the balance of moments along e1, and energy [J]: (blocks,) in order of time."""
    rows, length = np.flatnonzero(trajectory.measured), MIN_BLOCKS * BLOCK
    end = int(rows.max(initial=-1)) + 1
    starts = range(int(rows.min(initial=end)), end - BLOCK, length)
    found = [(np.empty(0), np.empty(0))]
    for i in evenly(len(starts), STRETCHES):  # evenly distributed over the frames in which the disc was measured
        with suppress(AnalysisError):
            found.append(_blocks(differentiate(part(trajectory, slice(starts[i], min(starts[i] + length, end))))))
    gravity, energy = (np.concatenate(of) for of in zip(*found, strict=True))
    return gravity, energy


def _blocks(motion: MeasuredMotion) -> tuple[Array, Array]:
    """Gravity and mean energy of blocks of frames of one stretch, if the balance determines gravity."""
    disc = motion.disc
    m = disc.mass
    e1, e2, e3 = motion.axes()
    theta = motion.euler[:, 1]
    turn_sigma = np.sqrt(np.trace(motion.covariance[:, 9:12, 9:12], axis1=1, axis2=2) / 3)
    moves = np.linalg.norm(motion.omega_world, axis=1) > SIGMAS * turn_sigma
    good = moves & motion.measured & (theta > THETA_RANGE[0]) & (theta < THETA_RANGE[1])
    if good.sum() < BLOCK:
        return np.empty(0), np.empty(0)
    arm = disc.arm_to_contact(e2, e3)
    spin = np.cross(motion.omega_world, disc.times_inertia(motion.omega_world, e3))
    moment = disc.times_inertia(motion.alpha_world, e3) + spin
    needed = np.sum(e1 * (moment - m * np.cross(arm, motion.acceleration)), axis=1)
    weight = m * np.sum(e1 * np.cross(arm, K), axis=1)
    energy = quantities(motion, disc, motion.gravity)[:, COLUMN["total"]] + m * motion.gravity * disc.half_thickness
    blocks = [rows[good[rows]] for rows in np.split(np.arange(len(good)), range(BLOCK, len(good), BLOCK))]
    blocks = [rows for rows in blocks if len(rows) > BLOCK // 2]
    gravity = [needed[rows] @ weight[rows] / (weight[rows] @ weight[rows]) for rows in blocks]
    return np.array(gravity), np.array([energy[rows].mean() for rows in blocks])


def _robust_weights(residual: Array) -> Array:
    """Cauchy weights (n,), small for outliers."""
    return np.asarray(1 / (1 + (residual / (2 * np.median(np.abs(residual)) + 1e-9)) ** 2))


def another_plane(trajectory: Trajectory, boards: Boards | None = None) -> tuple[Finding, ...]:
    """Whether the rim rolls on a plane tilted against z = 0: the board of the table view did not lie on the table."""
    rows, disc = trajectory.measured, trajectory.disc
    centre, e3 = trajectory.q[rows, :3], rotation_from_quaternion(trajectory.quaternion[rows])[:, :, 2]
    if len(centre) < BLOCK:
        return ()
    start = normal = e3.mean(axis=0) / np.linalg.norm(e3.mean(axis=0))  # it precesses about the normal
    weight = np.ones(len(centre))
    for _ in range(10):  # lowest points with respect to the normal of the plane through the previous ones
        lowest = centre + lowest_arm(e3, normal, disc)
        middle = weight @ lowest / weight.sum()
        normal = np.linalg.svd(np.sqrt(weight)[:, None] * (lowest - middle), full_matrices=False)[2][2]
        normal = normal * np.sign(normal @ start)
        gap = (lowest - middle) @ normal
        weight = _robust_weights(gap)
    side, ahead = np.linalg.svd(normal[None])[2][1:] @ e3.T
    turned, precessed = np.arccos(np.clip(normal[2], -1, 1)), np.ptp(np.unwrap(np.arctan2(ahead, side)))
    rolls = precessed > 2.0 and np.median(e3 @ normal) < np.cos(THETA_RANGE[0])
    if not (rolls and turned > MIN_LEAN and robust_sigma(gap) < SIGMAS * LAB_FRAME):
        return ()
    boards = boards or Boards({}, None, 0.0)
    lies, declared = _view_on_plane(trajectory.rig, boards, normal, middle), boards.table_view
    named = "the table view" if declared is None else f"view {declared}"
    does = "" if lies is None else f"; view {lies} does"
    text = (
        f"{named} does not lie on the table{does}: the rim rolls on a plane that is turned by "
        f"{np.degrees(turned):.1f} deg from that of its board"
    )
    action = "name the view in which the board lies flat on the table" if lies is None else ""
    fits, named = ("" if view is None else str(view) for view in (lies, declared))
    remedy = Remedy("[table] view", fits, named, action)
    of = Subject(view=declared)
    return (Finding(Kind.TABLE_VIEW, Severity.DOUBT, text, of, remedies=(remedy,), explains=OFF),)


def lowest_arm(e3: Array, normal: Array, disc: Disc) -> Array:
    """Vectors (n, 3) [m] from the centre to the lowest point of the disc with respect to a normal; e3 : (n, 3)."""
    cosine = (e3 @ normal)[:, None]
    down = cosine * e3 - normal  # in the plane of the disc
    along = disc.radius * down / np.linalg.norm(down, axis=1, keepdims=True)
    return np.asarray(along - disc.half_thickness * np.sign(cosine) * e3)


def _view_on_plane(rig: StereoRig, boards: Boards, normal: Array, middle: Array) -> int | None:
    """The view whose board lies on this plane of the world frame; None if there is none."""
    found = []
    for view, (R_left_board, t_left_board) in boards.places.items():
        axis = rig.R_left_world.T @ R_left_board[:, 2]
        corner = rig.R_left_world.T @ (t_left_board - rig.t_left_world)
        height = abs(float((corner - middle) @ normal) - boards.thickness)
        found.append((float(np.arccos(min(abs(float(axis @ normal)), 1.0))), height, view))
    lean, height, view = min(found, default=(np.inf, np.inf, 0))
    return view if lean < MIN_LEAN and height < MOST_HEIGHT else None


def handedness(rig: StereoRig, disc: Disc) -> tuple[Finding, ...]:
    """Whether the left camera is on the left in viewing direction, if the dots do not reveal a mirrored world.

    In a mirrored world it is on the right. No verdict if one camera is behind the other, or they face each other.
    """
    if not has_mirror_axis(disc):
        return ()  # the dots would not have been found
    (R_left, t_left), (R_right, t_right) = rig.camera_poses()
    baseline = R_left.T @ t_left - R_right.T @ t_right  # from the left camera to the right one
    to_the_right = np.cross(R_left[2] + R_right[2], K)
    along = baseline @ to_the_right / max(float(np.linalg.norm(baseline) * np.linalg.norm(to_the_right)), 1e-12)
    if along > -SIDEWAYS or np.linalg.norm(to_the_right) < SIDEWAYS:
        return ()
    cameras = "[cameras] left, right (and [calibration])"
    remedies = (
        Remedy(cameras, action="exchanged if they are named wrongly: all is well then"),
        Remedy(cameras, action="mirrored if they were stored so: psi and phi turn round"),
    )
    text = (
        f"the left camera stands {1e3 * rig.baseline:.0f} mm to the right of the right one, as they look at it; "
        "expected on the left. The dots do not show it: their layout looks the same in a mirror"
    )
    return (Finding(Kind.HANDEDNESS, Severity.DOUBT, text, remedies=remedies),)


def scale_of_dots(trajectory: Trajectory, declared: Disc, square: float | None) -> tuple[Finding, ...]:
    """Ratio of the triangulated distances of the dots to those of their declared centres; square : of `other_scale`."""
    rows = np.flatnonzero(trajectory.measured)
    rows = rows[evenly(len(rows), 50)]
    good = (trajectory.marker_status[rows] == MarkerStatus.MEASURED).all(axis=1)
    pixels = np.where(good[:, None, :, None], trajectory.markers_px[rows], np.nan)
    n, _, dots, _ = pixels.shape
    contradicted = trajectory.frame_status == FrameStatus.CONTRADICTED
    if not np.isfinite(pixels).any() or contradicted.sum() > trajectory.measured.sum():
        return ()  # inconsistent cameras determine no size
    rig = replace(trajectory.rig, lens_field=None)  # the pixels of the trajectory are already corrected for it
    seen = triangulate(pixels.swapaxes(0, 1).reshape(2, n * dots, 2), rig).reshape(n, dots, 3)
    distances = scipy.spatial.distance.pdist
    ratio = np.array([distances(places) for places in seen]) / distances(declared.marker_centres_body)
    per_pair = np.array([np.median(r[np.isfinite(r)]) for r in ratio.T if np.isfinite(r).sum() >= min(5, n)])
    if len(per_pair) < MIN_BLOCKS:
        return ()
    typical = _typical(per_pair)
    # pairs share dots: there are only as many independent distances as dots
    scale = replace(typical, sigma=max(typical.sigma * np.sqrt(len(per_pair) / dots), 1e-4))
    return (other_scale(scale, square),) if _beyond(scale, 1.0, SCALE) else ()


def other_scale(scale: Measured, square: float | None = None, explains: tuple[Kind, ...] = BY_SCALE) -> Finding:
    """Distances of the dots differ from the declared ones by this factor. square : [m] of the board as declared"""
    factor, off = scale.value, _apart(scale.value, 1.0)
    uncertain = max(3 * scale.sigma / factor, 0.01 * min(off, 1.0))  # templates do not fit dots far from declared
    digits, mixed = 1 + int(np.log10(factor / scale.sigma)), ""
    for unit, words in UNITS.items():
        if abs(off / np.log(unit) - 1) < 0.02:
            factor, mixed = float(unit ** np.sign(np.log(factor))), f": are {words} mixed up?"
    board = (off, Kind.SQUARE, Remedy("[calibration] square_mm", action=f"times {rounded(1 / factor, digits)}"))
    if square is not None:
        side = 1e3 * square / factor
        usual = max(round(2 * side), 1) / 2  # boards have squares of whole or half mm
        away = _apart(side, usual)
        remedy = Remedy("[calibration] square_mm", f"{usual if away < uncertain else side:.2f}", f"{1e3 * square:g}")
        board = (min(away, off), Kind.SQUARE, remedy)
    which = "[markers] centres_mm" if off < SIDE_TOLERANCE else "every length of [disc] and [markers]"
    lengths = (off, Kind.SQUARE, Remedy(which, action=f"times {rounded(factor, digits)}"))
    text = f"by both cameras the dots are {scale} times as far apart as declared{mixed}"
    return _contradiction((board, lengths), text, explains, scale=scale)


def unseen_dots(trajectory: Trajectory, declared: Disc) -> Iterator[Finding]:
    """Dots that are hardly ever measured: their declared position is wrong, or they are printed differently."""
    status = trajectory.marker_status[trajectory.measured]
    if not len(status):
        return
    share = np.mean(status == MarkerStatus.MEASURED, axis=0).max(axis=0)
    rest = replace(declared, marker_centres_body=declared.marker_centres_body[share >= SEEN_RARELY])
    # three dots fit nearly anything; a symmetric layout does not determine the rotation of the disc
    spoils = rest.n_markers < 4 or symmetry_order(rest) > symmetry_order(declared)
    for dot in np.flatnonzero(share < SEEN_RARELY) if (share > 0.5).sum() >= 3 else ():
        kinds, counts = np.unique(status[:, :, dot], return_counts=True)
        reason = MarkerStatus(int(kinds[counts.argmax()])).name.lower().replace("_", " ")
        x, y = 1e3 * declared.marker_centres_body[dot, :2]
        text = (
            f"dot {dot} of [markers] centres_mm is measured in {100 * share[dot]:.0f} % of the images ({reason}); "
            "expected a dot there, as round and dark as the others (numbers count from 0)"
        )
        severity = Severity.DOUBT if spoils else Severity.WARNING
        remedy = Remedy(f"[markers] centres_mm, entry {dot}", declared=f"[{x:g}, {y:g}]")
        yield Finding(Kind.DOT_UNSEEN, severity, text, Subject(dot=int(dot)), remedies=(remedy,))


def turned_board(inner_corners: Sequence[int]) -> Iterator[Finding]:
    """Corners counted along the short side first rotate the axes of the table by 90 deg."""
    first, second = inner_corners
    if first < second:
        remedy = Remedy("[calibration] inner_corners", f"[{second}, {first}]", f"[{first}, {second}]")
        text = "corners are counted along the short side first, so that x runs along it; expected the long side first"
        yield Finding(Kind.CORNERS, Severity.DOUBT, text, remedies=(remedy,))
