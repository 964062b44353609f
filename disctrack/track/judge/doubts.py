"""Findings of the tracking about its own result: what increases its uncertainty, and what makes it doubtful."""

from collections.abc import Iterator

import numpy as np
import scipy

from calibration.kit.brief import ranges
from calibration.kit.types import Array, Mask, robust_sigma
from disctrack import frames
from disctrack.analyse.declaration import LAB_FRAME
from disctrack.analyse.derivatives import CHANNELS
from disctrack.disc import Disc, symmetry_order
from disctrack.findings import MISFITS, Finding, Kind, Remedy, Severity, Subject
from disctrack.numbers import Measured
from disctrack.track.follow.following import Follower
from disctrack.track.judge.cameras import HARDLY, LATE, delay_of_right
from disctrack.track.pose import DotsInFrames
from disctrack.track.refine.scatter import Scatter
from disctrack.track.refine.self_calibration import DOT_SIGMA
from disctrack.track.refine.table_contact import TableFromDisc
from disctrack.track.side_by_side import FEW, SURE, stretches
from disctrack.trajectory import FrameStatus, Trajectory

FAULTY = 2.0  # times the variance of the noise, above which scatter has another cause
ORDINARY_PX = 0.03  # rms of systematic misfit that good lenses have beyond their polynomial
HOPELESS = 25.0  # times the variance of the noise, above which no result is right within its sigmas
NO_TOLERANCE = 0.4e-3  # [m] between the tables by board and by disc: beyond, a wrong declaration or moved cameras
MOVED = "Was a camera moved or turned after its calibration? Then calibrate again."


def repeated_images(repeated: Mask, trajectory: Trajectory) -> Iterator[Finding]:
    """Images that repeat earlier ones, `repeated` (n, 2), and frames that are lost because both images repeat."""
    alone = repeated & ~repeated.all(axis=1, keepdims=True)
    for camera, copies in zip(frames.CAMERAS, alone.T, strict=True):
        if copies.any():
            n, (shown, where) = int(copies.sum()), _named(trajectory, copies)
            text = (
                f"{camera} camera: {n} repeat{'s' * (n > 1)} of earlier images (frame {shown}): "
                "the camera or its recorder lost these; the frames are measured without them"
            )
            yield Finding(Kind.REPEATED_IMAGES, Severity.DOUBT, text, Subject("track", camera, where))
    lost = trajectory.frame_status == FrameStatus.REPEATED
    if lost.any():
        shown, where = _named(trajectory, lost)
        text = (
            f"both cameras repeat earlier images while the disc moves (frame {shown}): the recorder lost these pairs; "
            "they have no pose, and time goes on over them"
        )
        yield Finding(Kind.REPEATED_IMAGES, Severity.NOTE, text, Subject("track", frames=where))


def _named(trajectory: Trajectory, chosen: Mask, shortest: int = 1) -> tuple[str, tuple[tuple[int, int], ...]]:
    """Runs of at least `shortest` of the frames chosen (n,): in words, and first and last frame of each."""
    long = stretches(chosen, shortest)
    rows = [row for first, end in long for row in range(first, end)]
    where = [(int(trajectory.frame[first]), int(trajectory.frame[end - 1])) for first, end in long]
    return ranges(trajectory.frame[rows]) if rows else "", tuple(where)


def off_the_table(trajectory: Trajectory, severity: Severity = Severity.WARNING) -> tuple[Finding, ...]:
    """Distance of the disc's lowest point from the table, if it is not zero or scatters by more than the noise."""
    if not (trajectory.rig.world_is_table and trajectory.measured.any()):
        return ()
    z, psi, theta = trajectory.q[trajectory.measured, 2:5].T
    disc, C = trajectory.disc, trajectory.pose_covariance[trajectory.measured]
    gap = z - disc.resting_height(theta)
    by_tilt = disc.half_thickness * np.sin(theta) - disc.radius * np.cos(theta)
    J = np.stack([np.ones_like(psi), by_tilt * np.cos(psi), by_tilt * np.sin(psi)], axis=1)  # z, turns about x and y
    noise = np.median(np.einsum("ni,nij,nj->n", J, C[:, 2:5, 2:5], J))
    spread = robust_sigma(gap)
    if max(abs(np.median(gap)), np.sqrt(max(spread**2 - FAULTY * noise, 0.0))) <= LAB_FRAME:
        return ()
    seen = Measured(1e6 * float(np.median(gap)), 1e6 * float(gap.std()), "um")
    text = (
        f"the disc's lowest point lies {seen} from the table: thickness of the board or of the disc, radius, or the "
        "table view do not fit this recording, a camera or both moved since it, or the disc is in the air"
    )
    return (Finding(Kind.TABLE_DISAGREES, severity, text, numbers={"height": seen}),)


def misplaced_dots(declared: Disc, found: Array) -> tuple[Finding, ...]:
    """Dots whose positions (m, 3) [m] differ from the declared ones by more than a printer errs; what to declare."""
    away = 1e3 * np.linalg.norm(found - declared.marker_centres_body, axis=1)
    far = np.flatnonzero(away > 1e3 * SURE * DOT_SIGMA)
    if not len(far):
        return ()
    named = ", ".join(f"dot {dot} by {away[dot]:.2f} mm" for dot in far)
    centres = ", ".join(f"[{x:.3f}, {y:.3f}]" for x, y in np.round(1e3 * found[:, :2], 3) + 0.0)
    others = np.delete(away, far)
    rest = f" (the others within {others.max():.3f} mm)" if len(others) else ""
    text = (
        f"dots lie off the places declared in [markers]: {named}{rest}, counted from 0. Poses rest on those found; "
        "that their middle is the disc's is as declared"
    )
    of = Subject("track", dot=int(far[0]) if len(far) == 1 else None)
    remedy = Remedy("[markers] centres_mm", f"[{centres}]")
    return (Finding(Kind.DOTS_MISPLACED, Severity.DOUBT, text, of, remedies=(remedy,)),)


def poses_scatter(factor: Array, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Poses that scatter far more than the noise of the dots predicts, and by how much.

    factor : (6,) on the variances of the POSE_COMPONENTS
    """
    variance = np.nanmedian(np.diagonal(trajectory.pose_covariance[trajectory.measured], axis1=1, axis2=2), axis=0)
    over = []
    for name, group in CHANNELS.items():
        if factor[group[0]] > FAULTY:
            times, sigma = np.sqrt(factor[group[0]]), np.sqrt(np.mean(variance[group]))
            length = f"{1e6 * sigma:.1f} µm" if group[0] < 3 else f"{1e3 * np.degrees(sigma):.1f} mdeg"
            over.append(f"{name} by {length} ({times:.1f} times)")
    if not over:
        return ()
    text = (
        f"from frame to frame poses scatter more than their dots explain: {', '.join(over)}. Dots that err alike leave "
        "no residual: a camera or the table trembles, or the frames were compressed as video. The sigmas follow"
    )
    explains = Kind.DOTS_SCATTER, Kind.TABLE_DISAGREES, Kind.FRAMES_LOST, Kind.ACCURACY
    return (Finding(Kind.POSES_SCATTER, Severity.WARNING, text, explains=explains),)


def _misfit(seen: str, ahead: float, explained: float, frame_rate: float) -> Finding:
    """Why the two cameras contradict each other in all frames: a delay, or a moved or refocused camera."""
    if explained < LATE:
        lags = "" if explained < HARDLY else ", or one lags"
        text = (
            f"{seen}: a camera moved or was refocused since the calibration{lags} (a delay between the two would "
            f"explain {100 * explained:.0f} % of it). `disctrack diagnose` names it with its size; calibrate again"
        )
        # different dots are rejected from frame to frame, which adds scatter to the poses
        explains = Kind.POSES_SCATTER, Kind.TABLE_DISAGREES, Kind.FRAMES_LOST, Kind.ACCURACY
        return Finding(Kind.DOTS_MISFIT, Severity.DOUBT, text, explains=explains)
    early, late = frames.CAMERAS[::-1] if ahead > 0 else frames.CAMERAS
    whole = round(abs(ahead))
    again = f"number its images higher by {whole}" if whole and abs(abs(ahead) - whole) < 0.1 * whole else ""
    text = (
        f"the {early} camera is {abs(ahead):.2f} frames ({1e3 * abs(ahead) / frame_rate:.2f} ms) ahead of the {late} "
        f"one, which explains {100 * explained:.0f} % of this: {seen}. `disctrack diagnose` measures a constant delay"
    )
    size = {"delay": Measured(abs(ahead) / frame_rate, unit="s")}
    advice = (Remedy(action=again or "check the synchronisation"),)
    return Finding(Kind.DELAY, Severity.DOUBT, text, Subject("track", early), size, advice, MISFITS)


def doubts_of(follower: Follower, scatter: Scatter, trajectory: Trajectory, seen: DotsInFrames) -> list[Finding]:
    """Frames that are lost, dots that are not as declared, and dots that miss their poses or scatter.

    seen : the dots, with the poses that were fitted to them
    """
    found = [*_lost(trajectory), *_one_sided(trajectory), *_symmetric(follower.disc), *_clipped(follower)]
    found += misplaced_dots(follower.disc, trajectory.disc.marker_centres_body)
    systematic_px = max(scatter.systematic_px)
    if scatter.whole > min(FAULTY * scatter.free, HOPELESS) and systematic_px > ORDINARY_PX:
        times = np.sqrt(scatter.whole / scatter.noise)
        text = f"the dots miss their fitted places by {times:.1f} times their scatter ({systematic_px:.3f} px)"
        found.append(_misfit(text, *delay_of_right(seen), trajectory.frame_rate))
    elif scatter.noise > 4.0:
        text = (
            f"the dots scatter {np.sqrt(scatter.noise):.1f} times more than the image noise explains: they are not "
            "round, or their edges are not sharp, or the images were processed"
        )
        explains = Kind.FRAMES_LOST, Kind.ACCURACY
        found.append(Finding(Kind.DOTS_SCATTER, Severity.WARNING, text, explains=explains))
    return found


def table_disagrees(table: TableFromDisc | None, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Disagreement of board and disc about the table beyond their tolerances; else a disc that is not on the table."""
    apart = table is not None and abs(table.plane[0]) > NO_TOLERANCE
    severity = Severity.DOUBT if apart else Severity.WARNING
    if table is None or table.probability >= scipy.special.erfc(SURE / np.sqrt(2)):
        return off_the_table(trajectory, severity)
    text = (
        f"the disc's lowest point does not roll on the board's table: {table.sentence}. They differ by more than "
        "their tolerances allow: the board is bowed or its thickness is another, the disc's radius or thickness "
        "is, the sheet of dots is off the disc's centre, a camera moved up or down by about twice as much since "
        "the calibration (or both together), or a long exposure is not declared (exposure_us)"
    )
    spread = float(np.hypot(table.sigma[0], table.board_sigma[0]))
    height = Measured(1e6 * float(table.plane[0]), 1e6 * spread, "um")
    return (Finding(Kind.TABLE_DISAGREES, severity, text, numbers={"height": height}, explains=(Kind.ACCURACY,)),)


def _lost(trajectory: Trajectory) -> Iterator[Finding]:
    """Runs of frames whose poses do not continue the motion, or whose dots contradict each other; most frames lost."""
    status = trajectory.frame_status
    shown, where = _named(trajectory, status == FrameStatus.JUMPED, FEW)
    if where:
        text = (
            f"no motion leads from the other frames to frames {shown}, which are refused: both cameras lost pairs "
            "there and the files were numbered on, the frames are in another order or of another recording, or the "
            "frame rate is far too high"
        )
        of = Subject("track", frames=where)
        yield Finding(Kind.CLOCK_JUMP, Severity.DOUBT, text, of, explains=(Kind.FRAMES_LOST,))
    shown, where = _named(trajectory, status == FrameStatus.CONTRADICTED, FEW)
    if where:
        text = f"frames {shown} are refused: the dots of the two cameras contradict each other"
        yield Finding(Kind.CAMERAS_CONTRADICT, Severity.DOUBT, text, explains=(Kind.FRAMES_LOST,))
    reasons = [s for s in FrameStatus if s.looked_for and not s.has_pose and s != FrameStatus.UNREADABLE]
    counts = {reason: int(np.sum(status == reason)) for reason in reasons}
    lost, measured, most = sum(counts.values()), int(trajectory.measured.sum()), max(reasons, key=lambda r: counts[r])
    if lost > measured:
        text = f"{lost} of {lost + measured} frames have no pose; most often: {most.sentence} ({counts[most]})"
        yield Finding(Kind.FRAMES_LOST, Severity.DOUBT, text, Subject("track"))


def _one_sided(trajectory: Trajectory) -> Iterator[Finding]:
    """Frames measured by one camera: most of them, or runs of them."""
    by_one = trajectory.frame_status == FrameStatus.ONE_CAMERA
    one, both = int(by_one.sum()), int(np.sum(trajectory.frame_status == FrameStatus.MEASURED))
    shown, where = _named(trajectory, by_one, FEW)
    if one > both:
        text = (
            f"the dots of only one camera make sense in {one} of {one + both} measured frames: are left and right "
            f"exchanged, does the rig belong to this recording, does one camera look at the underside? {MOVED}"
        )
        explains = Kind.POSES_SCATTER, Kind.TABLE_DISAGREES, Kind.FRAMES_LOST, Kind.SHARPNESS, Kind.ACCURACY
        yield Finding(Kind.ONE_SIDED, Severity.DOUBT, text, explains=explains)
    elif where:
        text = (
            f"frames {shown} rest on one camera, with its larger sigma: the other was covered, sees the disc edge-on, "
            "or lost images and is at another instant from there on"
        )
        yield Finding(Kind.ONE_SIDED, Severity.NOTE, text, Subject("track", frames=where))


def _symmetric(disc: Disc) -> Iterator[Finding]:
    order = symmetry_order(disc)
    if order > 1:
        text = (
            f"the layout of the dots repeats every {360 / order:.0f} deg: the spin angle phi is known only up to "
            "multiples of that (its rate is not affected)"
        )
        yield Finding(Kind.SYMMETRIC_DOTS, Severity.WARNING, text)


def _clipped(follower: Follower) -> Iterator[Finding]:
    for camera, edge in zip(frames.CAMERAS, follower.edges, strict=True):
        if edge.saturation is not None:
            text = (
                f"{camera} camera: the brighter side of the dots' edges is clipped at grey value {edge.saturation}, "
                "which hides part of them and of the noise: positions may be off by a micrometre"
            )
            advice = (Remedy(action="expose for a shorter time"),)
            where = Subject("track", camera)
            yield Finding(Kind.LIGHT, Severity.WARNING, text, where, remedies=advice, explains=(Kind.ACCURACY,))
