"""What a run tells its user at the end, in plain words."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from calibration import StereoCalibration, StereoRig
from calibration.cameras.camera import OF_CAMERAS, PAIR_SHIFT, PAIR_TURN
from calibration.kit.brief import SHOWN_RANGES, ranges
from calibration.kit.types import Array
from disctrack.frames import CAMERAS, vector_from_rotation
from disctrack.numbers import measured
from disctrack.trajectory import FrameStatus, Trajectory

Row = tuple[str, str]  # a heading, and what belongs to it


def calibration_rows(found: StereoCalibration, problems: Sequence[str] = ()) -> Iterator[Row]:
    """Views used, misfit of views left out, baseline, the model, what was left out and why."""
    n, assessment = len(found.view_names) + len(problems), found.assessment
    error = f" ({1e6 * assessment.held_out_error:.3g} µm in space)" if np.isfinite(assessment.held_out_error) else ""
    used = n - len(problems) - len(found.rejected_views)
    x, y, z = 1e6 * np.sqrt(np.mean((found.board_points - found.board.points) ** 2, axis=0))
    yield (
        "calibration",
        f"{used} of {n} views ({assessment.pairs} by both cameras), stereo misfit of views left out "
        f"{assessment.stereo_misfit_px:.4f} px{error}, baseline {found.rig.baseline * 1e3:.3f} mm",
    )
    yield "place", _mostly(assessment.place_sigma, "the calibration alone, of a point over the table's board")
    yield "rig", _rig_text(found.rig)
    what = "along its sides and out of its plane, as refined"
    yield "board", f"corners off by {x:.1f}, {y:.1f} and {z:.1f} µm rms {what}"
    if found.lens_rms_px:
        left, right = found.lens_rms_px
        yield "", f"lenses beyond their polynomials: {left:.3f} and {right:.3f} px rms per axis, corrected"
    if corners := len(found.rejected_corners()):
        yield "", f"{corners} corners were found but not used"
    yield from (("", text) for text in left_out(found))


def _rig_text(rig: StereoRig) -> str:
    """Baseline, angle between the cameras and focal lengths, with their sigmas."""
    C, t = rig.covariance, rig.t_right_left / rig.baseline
    baseline = 1e3 * float(np.sqrt(t @ C[PAIR_SHIFT, PAIR_SHIFT] @ t))
    turned = vector_from_rotation(rig.R_right_left)
    angle = float(np.linalg.norm(turned))
    axis = turned / max(angle, 1e-12)
    turn = float(np.degrees(np.sqrt(axis @ C[PAIR_TURN, PAIR_TURN] @ axis)))
    focal = [
        f"{name} {measured(camera.fx, np.sqrt(C[i, i]))} x {measured(camera.fy, np.sqrt(C[i + 1, i + 1]))}"
        for name, camera, i in zip(CAMERAS, rig.cameras, (own.start for own in OF_CAMERAS), strict=True)
    ]
    return (
        f"baseline {measured(1e3 * rig.baseline, baseline, 'mm')}, cameras turned by "
        f"{measured(np.degrees(angle), turn, 'deg')}, focal lengths [px] {', '.join(focal)}"
    )


def _mostly(sigma: Sequence[tuple[float, str]], what: str) -> str:
    """Each coordinate's sigma and what most of it comes from."""
    parts = [f"{axis} {1e6 * value:.2g} µm from {cause}" for axis, (value, cause) in zip("xyz", sigma, strict=False)]
    return f"{', '.join(parts)} (1 sigma, and its largest part: {what})"


def left_out(found: StereoCalibration) -> list[str]:
    """One line for each reason, with the images that it holds for."""
    return [f"not used: {', '.join(images)}: {why}" for why, images in found.reasons.items()]


def trajectory_rows(trajectory: Trajectory, details: Mapping[str, Any]) -> Iterator[Row]:
    """Frames measured and lost with the reasons, sigmas, reprojection error."""
    yield "frames", frames_text(trajectory)
    for status in FrameStatus:
        rows = np.flatnonzero(trajectory.frame_status == status)
        if status != FrameStatus.MEASURED and rows.size:
            yield "", f"{rows.size} {status.sentence} (frames {ranges(trajectory.frame[rows])})"
    if found := details.get("first_pass"):
        looked = f" (first pass, {found['looked_at']} pairs looked at)" if found["looked_at"] else ""
        yield "motion", f"{found['verdict']}{looked}"
    if trajectory.measured.any():
        yield "sigma", sigma_text(trajectory)
        yield "", _sigma_text(trajectory.calibration_sigma, "shared by frames: calibration, table, what repeats")
        yield from _shared_lines(details)
        yield _fit_row(trajectory)
        if any(repeats := details.get("systematic_px", ())):
            left, right = repeats
            what = "lens beyond its model, printed dots, light"
            yield "repeating", f"misfit of the dots, left {left:.4f} px, right {right:.4f} px ({what})"
        if table := details.get("table"):
            yield "table", table["told"]
            if least := table.get("least_off_centre"):
                centred = "the dots' middle is taken for the disc's centre ([markers] centres_mm)"
                yield "given", f"{centred}; it may be off by up to {1e6 * least:.2g} µm unseen"
    yield from (("image", reason) for reason in list(details.get("unreadable", []))[:SHOWN_RANGES])


def _shared_lines(details: Mapping[str, Any]) -> Iterator[Row]:
    if shared := details.get("shared_sigma"):
        yield ("", _mostly(shared, "shared by frames"))
    size = details.get("size", {})
    if abs(size.get("share", 0.0) * size.get("by_dots", 0.0)) > size.get("sigma", np.inf):  # that is worth a line
        yield (
            "size",
            f"by the disc's dots lengths are {measured(100 * size['by_dots'], 100 * size['sigma'])} % longer than "
            f"by the board; {100 * size['share']:.0f} % of that is taken over",
        )


def frames_text(trajectory: Trajectory) -> str:
    """Frames measured and lost."""
    processed = trajectory.looked_for
    measured = int(np.sum(trajectory.measured))
    of = f" of {len(trajectory)} frames" if not processed.all() else ""
    return f"{measured} measured, {int(processed.sum()) - measured} lost{of}"


def sigma_text(trajectory: Trajectory) -> str:
    """Uncertainty of a pose, in one line."""
    return _sigma_text(trajectory.coordinate_sigma, "median of the frames, noise of one frame")


def _sigma_text(sigma: Array, what: str) -> str:
    known = sigma[np.isfinite(sigma).all(axis=1)]
    if not len(known):
        return f"not known ({what})"
    x, y, z = np.median(known[:, :3], axis=0) * 1e6
    psi, theta, phi = np.degrees(np.median(known[:, 3:], axis=0)) * 1e3
    return f"x {x:.2f}  y {y:.2f}  z {z:.2f} µm   psi {psi:.1f}  theta {theta:.2f}  phi {phi:.1f} mdeg  ({what})"


def _fit_row(trajectory: Trajectory) -> Row:
    rms = trajectory.reprojection_rms_px
    cameras = [
        f"{name} {np.sqrt(np.nanmean(rms[:, i] ** 2)):.4f} px" if np.isfinite(rms[:, i]).any() else f"{name} not used"
        for i, name in enumerate(CAMERAS)
    ]
    chi = trajectory.reduced_chi_square
    median = f"{np.nanmedian(chi):.2f}" if np.isfinite(chi).any() else "not known"
    return "reprojection", f"{', '.join(cameras)}; reduced chi-square {median} (median; 1 is expected)"
