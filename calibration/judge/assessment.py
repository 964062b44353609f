"""Assessment of a calibration: consistency, coverage, uncertainty in px and mm, and a verdict in words."""

from dataclasses import dataclass, replace

import numpy as np

from calibration.cameras.camera import CAMERA_NAMES, StereoRig, causes
from calibration.fit.pairing import GOOD_VIEWS, TWICE
from calibration.fit.refinement import Refinement, held_out
from calibration.fit.start import TooWide
from calibration.fit.stereo_model import N_STEREO
from calibration.judge.pairs import PairMotion
from calibration.kit.least_squares import solve_each
from calibration.kit.types import Array

MIN_COVERAGE = 0.35  # fraction of the image's 8 x 8 cells with a corner: with less, distortion is extrapolated
MIN_TILT_SPREAD_DEG = 20.0  # between the boards' normals: with less, focal length and distance are degenerate
# The verdict in one word, and the largest error over a point's distance: 0.05, 0.5, 5 mm at half a metre. Errors are
# compared in space, not in px, which depend on the size of the images.
GRADES = {"excellent": 1e-4, "good": 1e-3, "usable": 1e-2, "poor": np.inf}
BEYOND_USE = 0.05  # error over a point's distance, above which a rig is kept only on request


@dataclass(frozen=True)
class Assessment:
    """Figures and words about a calibration."""

    stereo_misfit_px: float  # of held-out views, with one pose of the board for both images; NaN if there are none
    held_out_error: float  # [m] distance of triangulated corners of such views from the board fitted to them
    triangulation_sigma: tuple[float, float]  # [m] of points, rms and largest, from the whole calibration covariance
    length_sigma: tuple[float, float]  # relative, of a length or displacement: from the views; with the board's size
    direction_sigma: float  # [rad] of a line across the table's board, or of the rotation of a body as large
    place_sigma: tuple[tuple[float, str], ...]  # of x, y, z of points [m], with the board's sizes; and its main cause
    distance: float  # [m] of the points from the left camera
    pairs: int  # fitted views with both cameras
    motion: PairMotion | None  # of the board between the exposures of a pair
    inflation: float  # factor on the covariance, from the scatter of views
    coverage: tuple[float, ...]  # of each camera: fraction of 8 x 8 image cells with a corner
    tilt_spread_deg: float  # largest angle between two boards' normals
    grade: str = ""  # of GRADES
    verdict: str = ""  # grade and reason: one sentence without full stop
    figures: str = ""  # accuracy on the table, and held-out misfit
    warnings: tuple[str, ...] = ()

    @property
    def beyond_use(self) -> bool:
        """True if lengths are meaningless: such a rig is kept only on request."""
        worst = max(self.triangulation_sigma[0], np.nan_to_num(self.held_out_error)) / self.distance
        return not worst < BEYOND_USE


def stereo_covariance(refinement: Refinement, common: Array | None = None) -> Array:
    """Covariance (s1, s1) of the free stereo parameters, from the corners' noise and the disagreement of the views.

    common : (n_views, s, s) covariance of other contributions to the views' gradients, see `pairs`

    Errors common to a view affect some directions more than others: motion of the board between the two exposures
    affects the stereo pose, not the focal lengths. The covariance of the views' shifts, whitened by that expected from
    noise, is shrunk towards a multiple of the identity (Ledoit and Wolf 2004). No direction gets a variance below the
    geometric mean of all: of two dozen variances from few views the smallest are small by chance. The result is never
    smaller than that of the corners' noise.
    """
    problem = refinement.problem
    s1, views = N_STEREO, len(np.unique(problem.observations.view))
    shift, spread, inverse, scale = refinement.normal.shifts(s1, common)
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
    by_common = 0.0 if common is None else inverse.T @ (common.sum(0) * scale[:, None] * scale) @ inverse
    at_minimum = inverse[:s1] + by_common
    # noise moves fewer than s1 directions
    share = s1 / max(float(np.trace(np.linalg.solve(at_minimum, expected))), 1e-12)
    # its weight was multiplied by the disagreement of the views
    extra = max(problem.prior.weight - 1.0, 0.0) * refinement.normal.prior[:-1, :-1] * scale[:, None] * scale
    by_prior = inverse.T @ extra @ inverse
    return np.asarray((at_minimum + share * beyond @ beyond.T + by_prior) * scale[:s1, None] * scale[:s1], float)


def cells_of(refinement: Refinement, camera: int) -> Array:
    """(8, 8) number of used corners in each cell of a grid on the image, along x and along y."""
    o = refinement.observations
    pixels = o.pixels[refinement.kept & (o.camera == camera)]
    edges = [np.linspace(-0.5, size - 0.5, 9) for size in refinement.model.rig.cameras[camera].image_size]
    return np.histogram2d(pixels[:, 0], pixels[:, 1], bins=edges)[0]


def shifts_of_points(rig: StereoRig, points_world: Array) -> Array:
    """(n, 3, 30) d point / d RIG_PARAMETERS at fixed pixels, of triangulated points (n, 3) [m]."""
    _, d_world, d_rig = rig.project_with_jacobians(points_world)
    J = np.moveaxis(d_world, 0, 1).reshape(len(points_world), 4, 3)
    K = np.moveaxis(d_rig, 0, 1).reshape(len(points_world), 4, -1)
    return -solve_each(J, K)


def measurement_volume(refinement: Refinement, on_table: bool) -> Array:
    """Points (n, 3) [m] in world axes for which uncertainty is stated: the board of the table view and above it."""
    points = refinement.model.points
    if on_table:
        size = np.ptp(points, axis=0)[:2].min()
        return np.concatenate([points + np.array([0, 0, height]) for height in (0.0, 0.5 * size)])
    views = np.unique(refinement.problem.observations.view)
    R, t = refinement.model.R_left_board[views, 0], refinement.model.t_left_board[views, 0]
    return (np.einsum("vij,nj->vni", R, points) + t[:, None]).reshape(-1, 3)


def length_uncertainty(rig: StereoRig, points_world: Array) -> tuple[float, float]:
    """Standard deviations of a line across the points (n, 3) [m]: relative of its length, and its direction [rad].

    Due to the calibration alone; means over the three axes, for a line as long as the points' scatter. They also hold
    for displacements.
    """
    middle, size = points_world.mean(0), float(np.sqrt(np.mean(np.var(points_world, axis=0)) * 3))
    shift = shifts_of_points(rig, middle + 0.5 * size * np.concatenate([np.eye(3), -np.eye(3)]))
    change = (shift[:3] - shift[3:]) / size  # (3 lines, 3 axes, 30)
    variance = np.einsum("lap,pq,laq->la", change, rig.covariance, change)
    own = float(np.trace(variance)) / 3
    return float(np.sqrt(max(own, 0.0))), float(np.sqrt(max(float(variance.sum()) - 3 * own, 0.0) / 6))


def assess(
    refinement: Refinement, rig: StereoRig, rig_with_board: StereoRig, motion: PairMotion | None, wide: TooWide
) -> Assessment:
    """Compute the figures and the verdict.

    rig : with the covariance due to the views alone; rig_with_board : including the tolerances of the board
    wide : result of `start.too_wide`
    """
    used = refinement.problem.observations
    both = np.intersect1d(used.view[used.camera == 0], used.view[used.camera == 1])
    normals = refinement.model.R_left_board[np.unique(used.view), 0, :, 2]
    volume = measurement_volume(refinement, rig.world_is_table)
    shift = shifts_of_points(rig, volume)  # of points in images without noise
    variance = np.einsum("nip,pq,niq->ni", shift, rig.covariance, shift)
    sigma = np.linalg.norm(np.sqrt(np.maximum(variance, 0.0)), axis=-1)
    along, across = length_uncertainty(rig, volume)
    place, most = causes(rig_with_board, shift)
    misfit, held_out_error = held_out(refinement)
    found = Assessment(
        stereo_misfit_px=misfit,
        held_out_error=held_out_error,
        triangulation_sigma=(float(np.sqrt(np.mean(sigma**2))), float(sigma.max())),
        length_sigma=(along, length_uncertainty(rig_with_board, volume)[0]),
        direction_sigma=across,
        place_sigma=tuple(zip(place.tolist(), most, strict=True)),
        distance=float(np.linalg.norm(rig.R_left_world @ volume.mean(0) + rig.t_left_world)),
        pairs=int(np.sum(~refinement.problem.apart[both])),
        motion=motion,
        inflation=refinement.inflation,
        coverage=tuple(float(np.mean(cells_of(refinement, camera) > 0)) for camera in range(len(CAMERA_NAMES))),
        tilt_spread_deg=float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1))).max()),
    )
    return _judged(found, refinement, wide)


def _judged(found: Assessment, refinement: Refinement, wide: TooWide) -> Assessment:
    """With the worst grade of all figures, its reason, and warnings about figures that need action."""
    warnings, reasons = [": ".join(what) for what in wide], [(3, what) for what, _ in wide]
    errors = found.triangulation_sigma[0], found.held_out_error
    for error, what in zip(errors, ("a point is uncertain by", "views left out of the fit are off by"), strict=True):
        if np.isfinite(share := error / found.distance):
            part = f"{what} {_length(error)}, {_percent(share)} of the distance"
            reasons.append((int(np.searchsorted([*GRADES.values()], share)), part))
    if (motion := found.motion) is not None and motion.is_seen and refinement.problem.motion is not None:
        reasons.append((2, "the two images of a pair do not show the board in one place"))
        warnings.append(
            "the pairs are not synchronised, or the lenses are not as modelled: the two images of a pair differ as if "
            f"the board had moved by {motion.distance * 1e3:.2g} mm between them ({motion.pixels:.2g} px; corners "
            f"scatter by {motion.scatter:.2g} px). The refinement gives every board a motion of its own; the sigmas "
            "contain it. Trigger both cameras at once, or hold the board still"
        )
    for name, share in zip(CAMERA_NAMES, found.coverage, strict=True):
        if share < MIN_COVERAGE:
            warnings.append(
                f"{name} camera: corners cover {100 * share:.0f} % of the image (good: above "
                f"{100 * MIN_COVERAGE:.0f} %); outside them the distortion is extrapolated: show the board there too"
            )
    if found.tilt_spread_deg < MIN_TILT_SPREAD_DEG:
        warnings.append(
            f"the boards' normals differ by {found.tilt_spread_deg:.1f} deg at most (good: above "
            f"{MIN_TILT_SPREAD_DEG:.0f} deg): focal lengths and distances are badly determined; tilt the board about "
            "two axes"
        )
    if found.pairs < GOOD_VIEWS:
        reasons.append((2 if found.pairs > 3 else 3, f"only {found.pairs} views were seen by both cameras"))
    if (n_views := len(np.unique(refinement.problem.observations.view))) < GOOD_VIEWS:
        warnings.append(f"{n_views} views are few (good: 15 to 40)")
    if found.inflation > TWICE:
        warnings.append(
            f"the views disagree {found.inflation**0.5:.1f} times more than their corners' noise allows; the "
            "uncertainties were enlarged by that: the board moved or bent between views, or the lenses are not as "
            "modelled"
        )
    if found.stereo_misfit_px > TWICE * refinement.rms():
        reasons.append((2, "views left out of the fit are met far worse than those fitted"))
        warnings.append(
            f"views that were left out fit at {found.stereo_misfit_px:.3f} px, those fitted at {refinement.rms():.3f} "
            "px: more and more varied views are needed"
        )
    if not refinement.converged:
        warnings.append("the refinement did not converge: the result is not the least-squares minimum")
    # the first if several are equal
    worst, why = max(reasons, key=lambda item: item[0], default=(3, "nothing shows how good it is"))
    grade, figures = [*GRADES][worst], _figures(found, refinement.rms())
    verdict = f"{grade.capitalize()}: {why}"
    return replace(found, grade=grade, verdict=verdict, figures=figures, warnings=tuple(warnings))


def _figures(found: Assessment, rms: float) -> str:
    sigma, most = map(_length, found.triangulation_sigma)
    return (
        f"1 sigma: a point {sigma} (at most {most}), a direction {1e3 * np.degrees(found.direction_sigma):.2g} mdeg, a "
        f"length {_percent(found.length_sigma[1])}; stereo misfit {found.stereo_misfit_px:.4f} px, rms {rms:.4f} px"
    )


def _length(value: float) -> str:
    """A length [m] with two digits."""
    scale, unit = (1e6, "µm") if value < 0.5e-3 else (1e3, "mm")
    return f"{float(f'{scale * value:.2g}'):g} {unit}"


def _percent(share: float) -> str:
    return f"{np.format_float_positional(float(f'{100 * share:.1g}'), trim='-')} %"
