"""How good a calibration is: consistency of its parts, coverage, uncertainty in px and mm, and a verdict in words."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.camera import N_INTRINSIC, Array, StereoRig
from calibration.errors import CalibrationError
from calibration.model_choice import Candidate
from calibration.normal_equations import Problem, minimise
from calibration.refinement import Refinement

MIN_COVERAGE = 0.35  # share of the image's 8 x 8 cells with a corner: below, distortion is extrapolated elsewhere
MIN_TILT_SPREAD_DEG = 20.0  # between the boards' normals: below, focal length and distance cannot be told apart
MIN_GOOD_VIEWS = 8
GOOD_RMS_PX = 0.3  # real, printed boards: 0.1 to 0.3 px is usual; rendered or etched ones reach 0.01 px
POOR_RMS_PX = 0.8
BIG_INFLATION = 2.0  # of the variance, view against view: beyond, something is not in the model


@dataclass(frozen=True)
class HalfSets:
    """Odd against even views: differences of what the two halves give alone."""

    baseline: float  # [m] even minus odd
    rotation: float  # [rad] between the two relative orientations
    focal_px: tuple[float, float]  # left, right, mean of fx and fy
    sigmas: float  # root mean square difference in units of its predicted standard deviation; about 1 is right


@dataclass(frozen=True)
class Assessment:
    """Figures and words about a calibration."""

    chi_square: float  # reduced, by the corners' own noise
    unexplained_px: float  # sigma per axis beyond the corners' own noise
    corner_sigma_px: float  # typical located corner, own noise
    inflation: float  # of the covariance, from the scatter of views
    coverage: tuple[float, float]  # left, right: share of 8 x 8 image cells with a corner
    tilt_deg: tuple[float, float]  # least and greatest angle between a board's normal and the left camera's axis
    tilt_spread_deg: float  # greatest angle between two boards' normals
    half_sets: HalfSets | None  # None with fewer than six views
    projection_sigma_px: tuple[float, float]  # root mean square and greatest, over the table view's volume
    triangulation_sigma: tuple[float, float]  # the same for points [m], all of the calibration's uncertainty
    verdict: str
    warnings: tuple[str, ...]


def consistency_factor(refinement: Refinement) -> float:
    """Variance of the parameters as the views disagree about them, over the one that the corners' noise predicts.

    Each view, left out in turn, would move the parameters; to first order by H^-1 g_v with g_v its gradient at the
    common minimum. Noise alone gives E[g_v g_v^T] = H_v - H_v H^-1 H_v, so the ratio of the sum of g_v^T H^-1 g_v to
    its expectation is 1 for a right model, and more where errors are common to the corners of a view.
    """
    s1 = refinement.problem.stereo_basis.shape[1]
    information, gradient = refinement.normal.view_information()
    scale = 1.0 / np.sqrt(np.diag(information.sum(0)))  # the parameters' units differ by 10^6
    information, gradient = information * scale[:, None] * scale, gradient * scale
    inverse = np.linalg.inv(information.sum(0))
    covariance = inverse[:, :s1]
    # the board's own shape is nuisance: compare the stereo parameters' shifts only
    metric = np.linalg.inv(covariance[:s1])
    shift = gradient @ covariance
    seen = float(np.einsum("vi,ij,vj->", shift, metric, shift))
    spread = information - information @ inverse @ information
    expected = float(np.einsum("si,ij,vst,tj->", covariance, metric, spread, covariance))
    return seen / expected if expected > 0 else float("nan")


def half_set_differences(refinement: Refinement, inflation: float) -> HalfSets | None:
    """Refine even and odd views apart and compare; None with fewer than three views in a half."""
    used = refinement.observations[refinement.kept]
    views = np.unique(used.view)
    if len(views) < 6:
        return None
    halves = []
    for part in (views[::2], views[1::2]):
        keep = np.isin(used.view, part)
        problem = replace(refinement.problem, observations=used[keep], weights=refinement.problem.weights[keep])
        # the shape of the board is one for both halves
        problem = replace(problem, shape_basis=problem.shape_basis[..., :0])
        try:
            halves.append(_half(problem, refinement))
        except (CalibrationError, np.linalg.LinAlgError):
            return None
    (even, C_even), (odd, C_odd) = halves
    difference = even - odd
    C = inflation * (C_even + C_odd)
    s = len(difference)
    normalised = difference / np.sqrt(np.diag(C))
    basis = refinement.problem.stereo_basis
    full = basis @ difference
    t = refinement.model.t_right_left
    return HalfSets(
        baseline=float(full[21:24] @ t / np.linalg.norm(t)),
        rotation=float(np.linalg.norm(full[18:21])),
        focal_px=(float(full[0:2].mean()), float(full[N_INTRINSIC : N_INTRINSIC + 2].mean())),
        sigmas=float(np.sqrt(np.sum(normalised**2) / s)),
    )


def _half(problem: Problem, refinement: Refinement) -> tuple[Array, Array]:
    """Parameters (s,) relative to the full refinement, along its basis, and their covariance."""
    minimum = minimise(problem, refinement.model, iterations=40, tolerance=1e-8, damping=1e-6)
    covariance, _, _ = minimum.normal.covariances()
    a, b = refinement.model, minimum.model
    change = np.concatenate([b.cameras[i].parameters - a.cameras[i].parameters for i in (0, 1)])
    turn = b.R_right_left @ a.R_right_left.T
    vector = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    full = np.concatenate([change, vector, b.t_right_left - a.t_right_left])
    return np.linalg.lstsq(problem.stereo_basis, full, rcond=None)[0], covariance


def coverage(refinement: Refinement, camera: int, cells: int = 8) -> float:
    """Share of the cells of a grid on the image that hold a used corner."""
    o = refinement.observations
    pixels = o.pixels[refinement.kept & (o.camera == camera)]
    size = np.array(refinement.model.cameras[camera].image_size)
    index = np.clip((pixels + 0.5) / size * cells, 0, cells - 1).astype(int)
    return len(np.unique(index[:, 0] * cells + index[:, 1])) / cells**2


def tilts(refinement: Refinement) -> tuple[tuple[float, float], float]:
    """Least and greatest angle of a board's normal to the left axis, and greatest between two normals [deg]."""
    views = np.unique(refinement.observations.view[refinement.kept])
    normals = refinement.model.R_left_board[views][:, :, 2]
    to_axis = np.degrees(np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1)))
    between = np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)))
    return (float(to_axis.min()), float(to_axis.max())), float(between.max())


def point_uncertainty(rig: StereoRig, points_world: Array) -> tuple[Array, Array]:
    """Standard deviations from the calibration alone, of pixels (2, n, 2) and of triangulated points (n, 3) [m].

    points_world : (n, 3) [m]. A point's error is what a perfect image of it would give through this rig.
    """
    _, d_world, d_rig = rig.project_with_jacobians(points_world)
    pixel_variance = np.einsum("cnip,pq,cniq->cni", d_rig, rig.covariance, d_rig)
    J = np.moveaxis(d_world, 0, 1).reshape(len(points_world), 4, 3)
    K = np.moveaxis(d_rig, 0, 1).reshape(len(points_world), 4, -1)
    shift = -np.linalg.solve(np.swapaxes(J, 1, 2) @ J, np.swapaxes(J, 1, 2) @ K)
    point_variance = np.einsum("nip,pq,niq->ni", shift, rig.covariance, shift)
    return np.sqrt(np.maximum(pixel_variance, 0)), np.sqrt(np.maximum(point_variance, 0))


def measurement_volume(refinement: Refinement, rig: StereoRig, table_view: int | None) -> Array:
    """Points (n, 3) [m] in world axes over which uncertainty is told: the board of the table view and above it."""
    points = refinement.model.points
    if table_view is not None:
        size = np.ptp(points, axis=0)[:2].min()
        return np.concatenate([points + np.array([0, 0, height]) for height in (0.0, 0.5 * size)])
    views = np.unique(refinement.observations.view[refinement.kept])
    R, t = refinement.model.R_left_board[views], refinement.model.t_left_board[views]
    return (np.einsum("vij,nj->vni", R, points) + t[:, None]).reshape(-1, 3)


def assess(
    refinement: Refinement,
    candidates: tuple[Candidate, ...],
    rig: StereoRig,
    table_view: int | None,
    inflation: float,
    halves: HalfSets | None,
) -> Assessment:
    """Collect the figures and judge them."""
    kept = refinement.observations[refinement.kept]
    share = (coverage(refinement, 0), coverage(refinement, 1))
    tilt, spread = tilts(refinement)
    pixel_sigma, point_sigma = point_uncertainty(rig, measurement_volume(refinement, rig, table_view))
    chosen = next((c for c in reversed(candidates) if c.terms == refinement.terms), None)
    n_views = len(np.unique(kept.view))
    warnings = _warnings(refinement, share, tilt, spread, n_views, inflation, halves, chosen)
    point_length = np.linalg.norm(point_sigma, axis=-1)
    pixel_length = np.linalg.norm(pixel_sigma, axis=-1)
    triangulation = (float(np.sqrt(np.mean(point_length**2))), float(point_length.max()))
    return Assessment(
        chi_square=refinement.chi_square,
        unexplained_px=refinement.unexplained_sigma,
        corner_sigma_px=float(np.sqrt(np.mean(np.trace(kept.covariance, axis1=1, axis2=2)) / 2)),
        inflation=inflation,
        coverage=share,
        tilt_deg=tilt,
        tilt_spread_deg=spread,
        half_sets=halves,
        projection_sigma_px=(float(np.sqrt(np.mean(pixel_length**2))), float(pixel_length.max())),
        triangulation_sigma=triangulation,
        verdict=_verdict(refinement, triangulation, chosen, len(warnings)),
        warnings=warnings,
    )


def _warnings(
    refinement: Refinement,
    share: tuple[float, float],
    tilt: tuple[float, float],
    spread: float,
    n_views: int,
    inflation: float,
    halves: HalfSets | None,
    chosen: Candidate | None,
) -> tuple[str, ...]:
    found = []
    for name, value in zip(("left", "right"), share, strict=True):
        if value < MIN_COVERAGE:
            found.append(
                f"{name} camera: corners cover {100 * value:.0f} % of the image (good: above "
                f"{100 * MIN_COVERAGE:.0f} %); outside them the distortion is extrapolated: show the board there too"
            )
    if spread < MIN_TILT_SPREAD_DEG:
        found.append(
            f"the boards' normals differ by {spread:.1f} deg at most (good: above {MIN_TILT_SPREAD_DEG:.0f} deg): "
            "focal lengths and distances are badly determined; tilt the board about two axes"
        )
    if n_views < MIN_GOOD_VIEWS:
        found.append(f"{n_views} views are few (good: 10 to 20)")
    if inflation > BIG_INFLATION:
        found.append(
            f"the views disagree {inflation**0.5:.1f} times more than their corners' noise allows; the uncertainties "
            "were enlarged by that: is the board flat, stiff and at rest?"
        )
    if halves is not None and halves.sigmas > 2.0:
        found.append(
            f"odd and even views differ by {halves.sigmas:.1f} times what the covariance predicts (good: about 1)"
        )
    if chosen is not None and chosen.held_out_rms_px > 2 * chosen.rms_px:
        found.append(
            f"views that were left out fit at {chosen.held_out_rms_px:.3f} px, those fitted at {chosen.rms_px:.3f} px: "
            "more and more varied views are needed"
        )
    if not refinement.converged:
        found.append("the refinement did not converge: the result is not the least-squares minimum")
    return tuple(found)


def _verdict(
    refinement: Refinement, triangulation: tuple[float, float], chosen: Candidate | None, n_warnings: int
) -> str:
    rms = refinement.rms()
    if rms <= 0.05:
        word = "excellent: rendered views or an etched target reach 0.002 to 0.05 px"
    elif rms <= GOOD_RMS_PX:
        word = f"good: printed boards usually give 0.1 to {GOOD_RMS_PX} px"
    elif rms <= POOR_RMS_PX:
        word = f"usable: printed boards usually give 0.1 to {GOOD_RMS_PX} px; look at the residual plots for a pattern"
    else:
        word = f"poor: above {POOR_RMS_PX} px something is wrong (declared square, blur, board moved, images exchanged)"
    text = f"RMS {rms:.4f} px is {word}."
    if chosen is not None and np.isfinite(chosen.held_out_rms_px):
        text += f" Views left out of the fit give {chosen.held_out_rms_px:.4f} px."
    text += (
        f" Through this calibration a point comes out within {1e3 * triangulation[0]:.4f} mm (1 sigma, 3-D; at most "
        f"{1e3 * triangulation[1]:.4f} mm)."
    )
    return text + (" No warnings." if not n_warnings else f" {n_warnings} warning(s), see there.")
