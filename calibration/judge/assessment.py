"""How good a calibration is: consistency of its parts, coverage, uncertainty in px and mm, and a verdict in words."""

from dataclasses import dataclass, replace

import numpy as np

from calibration.cameras.camera import CAMERA_NAMES, OF_LEFT, OF_RIGHT, PAIR_SHIFT, PAIR_TURN, StereoRig
from calibration.cameras.causes import causes
from calibration.fit.model_choice import TermsTried
from calibration.fit.normal_equations import Problem, minimise
from calibration.fit.refinement import Refinement
from calibration.judge.pairs import PairMotion
from calibration.kit.arrays import Array
from calibration.kit.errors import CalibrationError
from calibration.kit.least_squares import scaled_solve

MIN_COVERAGE = 0.35  # share of the image's 8 x 8 cells with a corner: below, distortion is extrapolated elsewhere
MIN_TILT_SPREAD_DEG = 20.0  # between the boards' normals: below, focal length and distance cannot be told apart
MIN_GOOD_VIEWS = 8
# Of a point's distance, excellent, good and usable: 0.05, 0.5 and 5 mm at half a metre. Images of half the size, or of
# half the noise, say as much about cameras that are as wrong.
GRADES = (1e-4, 1e-3, 1e-2)
BEYOND_USE = 0.05  # of a point's distance: no rig to be kept unasked
BIG_INFLATION = 2.0  # of the variance, view against view: beyond, something is not in the model


@dataclass(frozen=True)
class HalfSets:
    """Odd against even views: differences of what the two halves give alone."""

    baseline: float  # [m] even minus odd
    rotation: float  # [rad] between the two relative orientations
    focal_px: tuple[float, float]  # left, right, mean of fx and fy
    sigmas: float  # root of chi-square per parameter, of the difference by its predicted covariance; about 1 is right


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
    length_sigma: tuple[float, float]  # relative, of a length or displacement: by the views; and with the board's size
    place_sigma: tuple[tuple[float, str], ...]  # of x, y, z of points [m], with the board's sizes; most of it from what
    pairs: int  # views that both cameras saw and the fit uses
    motion: PairMotion | None  # of the board between the exposures of a pair
    direction_sigma: float  # [rad] of a line across the table's board, or of the turn of a body as large
    stereo_misfit_px: float  # of views left out of the fit, one place of the board for both images; NaN where none was
    held_out_error: float  # [m] of corners of such views, triangulated, against the board where they put it best
    distance: float  # [m] from the left camera
    verdict: str
    warnings: tuple[str, ...]

    @property
    def beyond_use(self) -> bool:
        """True where lengths mean next to nothing: such a rig is kept only by consent."""
        worst = max(self.triangulation_sigma[0], np.nan_to_num(self.held_out_error)) / self.distance
        return not worst < BEYOND_USE


def consistency_factor(refinement: Refinement) -> float:
    """Variance of the parameters as the views disagree about them, over the one that the corners' noise predicts.

    1 for a right model, and more where errors are common to the corners of a view.
    """
    problem = refinement.problem
    return refinement.normal.disagreement(problem.stereo_basis.shape[1])


def stereo_covariance(refinement: Refinement, common: Array | None = None) -> Array:
    """Covariance (s1, s1) of the free stereo parameters, from the corners' noise and from how the views disagree.

    common : (n_views, s, s) covariance of what else the views' gradients contain, see `pairs`

    Errors that are common to a view weigh more in some directions than in others: a board that moves between the two
    exposures spoils the pair's pose, not the focal lengths. The views' shifts, whitened by what noise would make of
    them, are shrunk towards equal directions as far as so few views scatter (Ledoit and Wolf 2004). No direction is
    taken for better known than the geometric mean of all: of two dozen variances by so few views the smallest are small
    by chance. Nothing gets smaller than by the corners' noise.
    """
    problem = refinement.problem
    s1, views = problem.stereo_basis.shape[1], len(np.unique(problem.observations.view))
    shift, spread, inverse, by_common = refinement.normal.shifts(s1, common)
    expected = inverse.T @ spread @ inverse
    values, vectors = np.linalg.eigh(expected)
    root = vectors * np.sqrt(np.maximum(values, 1e-12 * values.max()))  # expected = root root^T
    white = np.linalg.solve(root, shift.T)
    seen = white @ white.T
    mean = float(np.trace(seen)) / s1
    by_chance = mean**2 * (s1**2 + s1) / views
    kept = max(0.0, 1.0 - by_chance / max(float(np.sum((seen - mean * np.eye(s1)) ** 2)), 1e-300))
    factor, directions = np.linalg.eigh(kept * seen + (1 - kept) * mean * np.eye(s1))
    least = np.exp(np.mean(np.log(np.maximum(factor, 1e-12 * mean))))
    beyond = root @ directions * np.sqrt(np.maximum(np.maximum(factor, least) - 1.0, 0.0))
    at_minimum = inverse[:s1] + by_common
    share = s1 / max(float(np.trace(np.linalg.solve(at_minimum, expected))), 1e-12)  # noise moves fewer than all
    prior = refinement.normal.prior
    scale = 1.0 / np.sqrt(np.diag(refinement.normal.eliminated()[0]))
    by_prior = np.zeros((s1, s1))
    if problem.prior is not None:  # it was weighted as if it were one of views that disagree as much
        told = max(problem.prior.weight - 1.0, 0.0) * prior * scale[:, None] * scale
        by_prior = inverse.T @ told @ inverse
    result: Array = (at_minimum + share * beyond @ beyond.T + by_prior) * scale[:s1, None] * scale[:s1]
    return result


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
        problem = problem.with_shape(refinement.model.points, problem.shape_basis[..., :0])
        try:
            halves.append(_half(problem, refinement))
        except (CalibrationError, np.linalg.LinAlgError):
            return None
    (even, C_even), (odd, C_odd) = halves
    difference = even - odd
    C = inflation * (C_even + C_odd)
    s = len(difference)
    basis = refinement.problem.stereo_basis
    full = basis @ difference
    t = refinement.model.t_right_left
    return HalfSets(
        baseline=float(full[PAIR_SHIFT] @ t / np.linalg.norm(t)),
        rotation=float(np.linalg.norm(full[PAIR_TURN])),
        focal_px=(float(full[OF_LEFT][:2].mean()), float(full[OF_RIGHT][:2].mean())),
        # of all parameters together: most differences are along directions that the views tell badly
        sigmas=float(np.sqrt(difference @ scaled_solve(C, difference) / s)),
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
    d_rig = rig.project_with_jacobians(points_world)[2]
    pixel_variance = np.einsum("cnip,pq,cniq->cni", d_rig, rig.covariance, d_rig)
    shift = _shifts_of_points(rig, points_world)
    point_variance = np.einsum("nip,pq,niq->ni", shift, rig.covariance, shift)
    return np.sqrt(np.maximum(pixel_variance, 0)), np.sqrt(np.maximum(point_variance, 0))


def place_causes(rig: StereoRig, points_world: Array) -> tuple[Array, list[str]]:
    """Of coordinates of points (n, 3) [m] seen through the rig: standard deviation (3,) [m], and what most is from."""
    return causes(rig, _shifts_of_points(rig, points_world))


def _shifts_of_points(rig: StereoRig, points_world: Array) -> Array:
    """(n, 3, 30) d point / d RIG_PARAMETERS at fixed pixels."""
    _, d_world, d_rig = rig.project_with_jacobians(points_world)
    J = np.moveaxis(d_world, 0, 1).reshape(len(points_world), 4, 3)
    K = np.moveaxis(d_rig, 0, 1).reshape(len(points_world), 4, -1)
    return np.asarray(-np.linalg.solve(np.swapaxes(J, 1, 2) @ J, np.swapaxes(J, 1, 2) @ K), np.float64)


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
    candidates: tuple[TermsTried, ...],
    rig: StereoRig,
    rig_with_board: StereoRig,
    table_view: int | None,
    inflation: float,
    halves: HalfSets | None,
    motion: PairMotion | None,
    wide: tuple[str, ...] = (),
) -> Assessment:
    """Collect the figures and judge them; the second rig has the tolerances of the board in its covariance.

    wide : what `wide_lens.too_wide` found
    """
    kept = refinement.observations[refinement.kept]
    share = (coverage(refinement, 0), coverage(refinement, 1))
    tilt, spread = tilts(refinement)
    volume = measurement_volume(refinement, rig, table_view)
    pixel_sigma, point_sigma = point_uncertainty(rig, volume)
    along, across = length_uncertainty(rig, volume)
    sigma, most = place_causes(rig_with_board, volume)
    place = tuple((float(value), cause) for value, cause in zip(sigma, most, strict=True))
    pairs = len(np.intersect1d(kept.view[kept.camera == 0], kept.view[kept.camera == 1]))
    chosen = next((c for c in reversed(candidates) if c.terms == refinement.terms), None)
    n_views = len(np.unique(kept.view))
    warnings = _warnings(refinement, share, tilt, spread, n_views, inflation, halves, chosen)
    named = motion is not None and motion.is_seen and refinement.problem.motion is not None
    if motion is not None and named:
        warnings = (
            "the pairs are not synchronised, or the lenses are not as modelled: the two images of a pair differ as if "
            f"the board had moved by {motion.distance * 1e3:.2g} mm between them ({motion.pixels:.2g} px; corners "
            f"scatter by {motion.scatter:.2g} px). The refinement gives every board a motion of its own; the sigmas "
            "contain it. Trigger both cameras at once, or hold the board still",
            *warnings,
        )
    warnings = (*wide, *warnings)
    point_length = np.linalg.norm(point_sigma, axis=-1)
    pixel_length = np.linalg.norm(pixel_sigma, axis=-1)
    found = Assessment(
        chi_square=refinement.chi_square,
        unexplained_px=refinement.unexplained_sigma,
        corner_sigma_px=float(np.sqrt(np.mean(np.trace(kept.covariance, axis1=1, axis2=2)) / 2)),
        inflation=inflation,
        coverage=share,
        tilt_deg=tilt,
        tilt_spread_deg=spread,
        half_sets=halves,
        projection_sigma_px=(float(np.sqrt(np.mean(pixel_length**2))), float(pixel_length.max())),
        triangulation_sigma=(float(np.sqrt(np.mean(point_length**2))), float(point_length.max())),
        length_sigma=(along, length_uncertainty(rig_with_board, volume)[0]),
        place_sigma=place,
        pairs=pairs,
        motion=motion,
        direction_sigma=across,
        stereo_misfit_px=chosen.held_out_rms_px if chosen else np.nan,
        held_out_error=chosen.held_out_error if chosen else np.nan,
        distance=float(np.linalg.norm(rig.R_left_world @ volume.mean(0) + rig.t_left_world)),
        verdict="",
        warnings=warnings,
    )
    return replace(found, verdict=_verdict(found, refinement.rms(), named, wide))


def _warnings(
    refinement: Refinement,
    share: tuple[float, float],
    tilt: tuple[float, float],
    spread: float,
    n_views: int,
    inflation: float,
    halves: HalfSets | None,
    chosen: TermsTried | None,
) -> tuple[str, ...]:
    found = []
    for name, value in zip(CAMERA_NAMES, share, strict=True):
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
            "were enlarged by that: the board moved or bent between views, or the lenses are not as modelled"
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


def length_uncertainty(rig: StereoRig, points_world: Array) -> tuple[float, float]:
    """Standard deviations of a line across the points (n, 3) [m]: relative of its length, and its direction [rad].

    From the calibration alone; means over the three axes of space, of a line as long as the points' scatter.
    Displacements have the same.
    """
    middle, size = points_world.mean(0), float(np.sqrt(np.mean(np.var(points_world, axis=0)) * 3))
    shift = _shifts_of_points(rig, middle + 0.5 * size * np.concatenate([np.eye(3), -np.eye(3)]))
    change = (shift[:3] - shift[3:]) / size  # (3 lines, 3 axes, 30)
    variance = np.einsum("lap,pq,laq->la", change, rig.covariance, change)
    own = float(np.trace(variance)) / 3
    return float(np.sqrt(max(own, 0.0))), float(np.sqrt(max(float(variance.sum()) - 3 * own, 0.0) / 6))


def _verdict(found: Assessment, rms: float, moved: bool, wide: tuple[str, ...]) -> str:
    """The worst of what the figures say, with the reason, then the figures: what a user gets on the table."""
    (sigma, most), error = found.triangulation_sigma, found.held_out_error
    words = ("excellent", "good", "usable", "poor")
    judged = [(3, wide[0].partition(":")[0])] if wide else []  # of equal grades the first is told: the cause
    for value, what in ((sigma, "a point is uncertain by"), (error, "corners of views left out of the fit are off by")):
        if np.isfinite(value):
            part = f"{1e3 * value:.3g} mm, {100 * value / found.distance:.2g} % of the distance"
            judged.append((int(np.searchsorted(GRADES, value / found.distance)), f"{what} {part}"))
    if found.pairs < MIN_GOOD_VIEWS:
        judged.append((2 if found.pairs > 3 else 3, f"only {found.pairs} views were seen by both cameras"))
    if found.stereo_misfit_px > 2 * rms:
        judged.append((2, f"views left out give {found.stereo_misfit_px:.3f} px where those fitted give {rms:.3f} px"))
    if found.half_sets is not None and found.half_sets.sigmas > 2:
        judged.append((2, f"odd and even views differ by {found.half_sets.sigmas:.1f} of their sigmas"))
    if moved:
        judged.append((2, "the two images of a pair do not show the board in one place"))
    grade, why = max(judged, key=lambda item: item[0], default=(3, "nothing tells how good it is"))
    off = f", their corners {1e3 * error:.4f} mm in space" if np.isfinite(error) else ""
    turn = 1e3 * np.degrees(found.direction_sigma)
    return (
        f"{words[grade].capitalize()}: {why}. Through this calibration a point comes out within {1e3 * sigma:.4f} mm "
        f"(1 sigma, 3-D; at most {1e3 * most:.4f} mm), a direction within {turn:.2g} mdeg, "
        f"a length or displacement within {100 * found.length_sigma[0]:.2g} %, or "
        f"{100 * found.length_sigma[1]:.2g} % with the declared size of the board. Views left out of the fit: stereo "
        f"misfit {found.stereo_misfit_px:.4f} px{off}; RMS of those fitted {rms:.4f} px."
    )
