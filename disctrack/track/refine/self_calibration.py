"""Self-calibration: parameters that all frames share, refined over the whole sequence.

These are the positions of the dots, and the rig within its sigma. Printed dots are off by tens of micrometres, the rig
by its calibration's sigma. Both cause the same residual in every frame, and a few hundred frames of a moving disc
determine them far better than the calibration. Shared parameters s and one pose per frame are fitted together; the
poses are eliminated frame by frame (Schur complement):

    (sum_i C_i^T C_i - C_i^T P_i (P_i^T P_i)^-1 P_i^T C_i + prior^-1) ds = sum_i C_i^T (1 - P_i (...)^-1 P_i^T) r_i

P, C: whitened Jacobians by the pose and by s. Priors: the rig's covariance; DOT_SIGMA for every dot in the plane of the
face. Gauge: a shift or rotation of the whole pattern on the disc is equivalent to a motion of the disc. The pattern is
placed such that the sum of the dots' displacements is smallest: if one dot is misprinted, the others, and the centre of
mass, which the cameras do not see, stay as declared.

The pattern of the dots is a second ruler, next to the board: if it measures larger than declared, the scale of the rig
or that of the pattern is wrong. Both scales have a variance: that of the rig is in its allowance for the board's size,
that of the pattern follows from its regularity, as a pattern with little stretch and shear hardly has a wrong size. The
scale of the rig is corrected by its share.
"""

from dataclasses import dataclass, replace

import numpy as np

from calibration.cameras.camera import N_RIG, PAIR_SHIFT, StereoRig
from calibration.judge.tolerances import SIZE
from calibration.kit.least_squares import scaled_solve
from calibration.kit.types import Array
from disctrack.disc import Disc
from disctrack.track.pose import DotsInFrames
from disctrack.track.side_by_side import MIN_FRAMES, SHARED_FRAMES, evenly

DOT_SIGMA = 50e-6  # [m] prior sigma of a printed dot about its declared position: tens of micrometres are usual
# Errors of the template and of the camera model (0.002 px) repeat from frame to frame, so the frames of a long
# recording are not independent: this is added to every dot's sigma per shared direction.
SYSTEMATIC_PX = 0.002
SIZE_FLOOR = 3e-6  # relative, of the dots as a ruler: metal and paper expand by some 1e-5 per kelvin
ITERATIONS = 3
MANY_DOTS = 5  # least number of dots of which the worst may be left out
SUM_OF_LENGTHS = 1.35  # variance of the pattern's position by the sum of lengths over that by the sum of squares


@dataclass(frozen=True)
class AsBuilt:
    """Rig and disc after the refinement, and the changes."""

    rig: StereoRig  # with its remaining covariance
    disc: Disc
    marker_shift: Array  # (m, 3) [m] refined minus declared, body axes; third component 0
    marker_shift_sigma: Array  # (m, 2) [m] of the dots against each other
    reduced_chi_square: float = float("nan")  # of the dots about their poses
    size: float = 0.0  # relative excess of lengths by the dots (if as declared) over those by the board
    size_sigma: float = float("nan")  # of the dots as a ruler
    size_share: float = 0.0  # fraction of the excess by which the rig was enlarged

    @classmethod
    def moved(cls, rig: StereoRig, disc: Disc, shift: Array, covariance: Array, reduced_chi_square: float) -> "AsBuilt":
        """Dots displaced by the significant part of `shift` (m, 2), of covariance (2m, 2m)."""
        motions = _pattern_motions(disc).reshape(-1, 3)
        keep = np.eye(len(covariance)) - motions @ np.linalg.pinv(motions)
        sigma = np.sqrt(np.diag(keep @ covariance @ keep)).reshape(-1, 2)
        kept = share_of_places(disc, shift, sigma) * declared_places_kept(disc, shift)
        disc = replace(disc, marker_centres_body=disc.marker_centres_body + kept)
        return cls(rig, disc, kept, sigma, reduced_chi_square)


def refine_as_built(frames: DotsInFrames) -> AsBuilt:
    """Refine the positions of the dots, and the scale of the rig, from the dots of n frames.

    Incomplete frames are used, too. With fewer than MIN_FRAMES frames everything stays as declared.
    """
    rig, disc = frames.rig, frames.disc
    enough = frames.posed & (np.isfinite(frames.pixels).all(-1).sum((1, 2)) >= 4)
    rows = evenly(np.flatnonzero(enough), SHARED_FRAMES)
    if len(rows) < MIN_FRAMES:
        return AsBuilt(rig, disc, np.zeros((disc.n_markers, 3)), np.full((disc.n_markers, 2), DOT_SIGMA))
    sigma = np.r_[np.zeros(N_RIG), np.full(2 * disc.n_markers, DOT_SIGMA)]
    shift, covariance, reduced, _ = fit_shared(frames.at(rows), sigma, repeats=SYSTEMATIC_PX)
    moved, remaining = shift[N_RIG:].reshape(-1, 2), covariance[N_RIG:, N_RIG:]
    size, size_sigma = pattern_size(disc, moved, remaining)
    rig, size_share = sized_by_pattern(rig, size, size_sigma)
    moved = moved + size_share * size * _from_middle(disc)
    found = AsBuilt.moved(rig, disc, moved, remaining, reduced[-1])
    return replace(found, size=size, size_sigma=size_sigma, size_share=size_share)


def fit_shared(
    frames: DotsInFrames, sigma: Array, repeats: float = 0.0
) -> tuple[Array, Array, list[float], DotsInFrames]:
    """Fit the shared parameters by Gauss-Newton, with a free pose for every frame.

    sigma : (30 + 2m + j,) of the prior about zero; parameters with sigma 0 are held
    repeats : [px] errors common to all frames, which limit the accuracy of many frames together
    returns : shift (30 + 2m + j,) of RIG_PARAMETERS, positions of the dots, and further parameters; its covariance,
        zero for parameters held; reduced chi-square before each step; the frames with the poses before the last step
    """
    shift, reduced, free = np.zeros(len(sigma)), [], sigma > 0
    information = np.diag(sigma[free] ** -2)
    variance = float(np.nanmedian(0.5 * np.trace(frames.covariance, axis1=-2, axis2=-1)))
    share = variance / (variance + len(frames.t) * repeats**2)  # at most (sigma / repeats)^2 effective frames
    for iteration in range(ITERATIONS):
        frames, fits = frames.fitted(iteration > 0, shift)
        ok = fits.converged
        chi_square, freedom = fits.chi_square[ok].sum(), max(int(fits.degrees_of_freedom[ok].sum()), 1)
        reduced.append(float(chi_square / freedom))
        normal, gradient, _ = frames.normal(shift, fits.used, free)
        # excess scatter of the dots over the image noise reduces their weight: that predicted after the best step, as
        # before it dots declared at wrong positions look like a hundred times the noise, and would damp it
        explained = gradient @ np.linalg.lstsq(normal, gradient, rcond=1e-12)[0]
        scale = share / max(1.0, float(chi_square - explained) / freedom)
        matrix = scale * normal + information
        shift[free] += scaled_solve(matrix, scale * gradient - information @ shift[free])
    covariance = np.zeros((len(shift), len(shift)))
    covariance[np.ix_(free, free)] = scaled_solve(matrix, np.eye(len(matrix)))
    return shift, covariance, reduced, frames


def share_of_places(disc: Disc, shift: Array, sigma: Array) -> float:
    """Shrinkage factor of displacements (m, 2) of sigma (m, 2): 1 - noise / power, or 0 (James and Stein 1961).

    Power and noise are those of the relative displacements of the dots. Dots at their declared positions show only
    noise, and stay there; displacements of ten sigmas are reduced by 1 %.
    """
    motions = _pattern_motions(disc).reshape(-1, 3)
    own = shift.reshape(-1) - motions @ (np.linalg.pinv(motions) @ shift.reshape(-1))
    return float(max(0.0, 1.0 - np.sum(sigma**2) / max(float(own @ own), 1e-30)))


def pattern_place(disc: Disc, shift: Array, sigma: Array) -> tuple[float, float]:
    """Variances of the shift, per axis [m^2], and rotation [rad^2] of the pattern, which the images do not determine.

    shift : (m, 3) [m] of the dots from their declared positions, from `declared_places_kept`; sigma (m, 2) [m]

    If the dots err relative to each other by s, rms per axis, the pattern as a whole errs by s / sqrt(m). The worst dot
    is left out of s: a wrongly declared one does not represent the others. A sum of lengths is less efficient than one
    of squares, and s has few degrees of freedom (both by simulation, test_self_calibration.py).
    """
    m = disc.n_markers
    squares = np.sort(np.sum(shift[:, :2] ** 2, axis=1))
    freedom = 2 * m - 3
    if m >= MANY_DOTS:
        # expected fraction of the largest in a sum of m exponentially distributed squares
        squares = squares[:-1] / (1.0 - np.sum(1.0 / np.arange(1, m + 1)) / m)
        freedom -= 2
    found = float(squares.sum()) / (2 * m - 3)
    variance = max(0.0, found - float(np.mean(sigma**2))) * SUM_OF_LENGTHS * freedom / (freedom - 2)
    return variance / m, variance / float(np.sum(_from_middle(disc) ** 2))


def by_pattern(as_built: AsBuilt, R: Array, off_centre: float = 0.0) -> Array:
    """(n, 6, 3) change of poses R (n, 3, 3) by one sigma of each shift and of the rotation of the whole pattern.

    off_centre : [m] additional sigma of the pattern's centre, from the table
    """
    place, turn = pattern_place(as_built.disc, as_built.marker_shift, as_built.marker_shift_sigma)
    place += off_centre**2
    return motions_of_pattern(R, as_built.disc) * np.sqrt([place, place, turn])


def motions_of_pattern(R: Array, disc: Disc) -> Array:
    """(n, 6, 3) change of poses R (n, 3, 3) by a shift of the pattern along e1, e2 and a rotation about its centre."""
    x, y = disc.marker_centres_body[:, :2].mean(axis=0)
    motions = np.zeros((len(R), 6, 3))
    motions[:, :3, :2] = R[:, :, :2]
    motions[:, :3, 2] = y * R[:, :, 0] - x * R[:, :, 1]
    motions[:, 3:, 2] = R[:, :, 2]
    return motions


def pattern_size(disc: Disc, shift: Array, covariance: Array) -> tuple[float, float]:
    """By how much lengths are too short, relative, if the dots are as declared; and the sigma of the dots as a ruler.

    shift : (m, 2) [m] refined minus declared positions, of covariance (2m, 2m)

    The variance has three parts: random errors of the dots, from the residuals after displacement, rotation, size,
    stretch and shear, and not below the variance of the refinement; errors of the two sides of the pattern, from
    stretch and shear; and SIZE_FLOOR.
    """
    d = _from_middle(disc)
    columns = np.stack([d, d * [0.5, -0.5], 0.5 * d[:, ::-1]], axis=-1).reshape(-1, 3)
    columns = np.concatenate([columns, _pattern_motions(disc).reshape(-1, 3)], axis=1)
    inverse = np.linalg.pinv(columns)
    size, stretch, shear = (inverse @ shift.reshape(-1))[:3]
    refined = float((inverse @ covariance @ inverse.T)[0, 0])
    residual = shift.reshape(-1) - columns @ (inverse @ shift.reshape(-1))
    freedom = max(len(residual) - 6, 1)
    random = float(residual @ residual) / freedom / float(np.sum(d**2))
    # sides of variance v give stretch and shear the variance 2 v, and the size, their mean, v / 2
    drawn = (stretch**2 + shear**2) / 8.0
    return -float(size), float(np.sqrt(max(random, refined) + drawn + SIZE_FLOOR**2))


def sized_by_pattern(rig: StereoRig, size: float, sigma: float) -> tuple[StereoRig, float]:
    """The rig with its scale corrected by its share of `size` +- `sigma`, and that share; see the module."""
    of_size = next((a for a in rig.allowances if a.cause == SIZE and a.shift[PAIR_SHIFT].any()), None)
    if of_size is None:
        return rig, 0.0
    shift = of_size.shift
    own = float(np.linalg.norm(shift[PAIR_SHIFT])) / rig.baseline
    share = own**2 / (own**2 + sigma**2)
    remaining = np.sqrt(1.0 - share)
    allowances = tuple(replace(a, shift=remaining * shift) if a is of_size else a for a in rig.allowances)
    covariance = rig.covariance - (1.0 - remaining**2) * np.outer(shift, shift)
    grown = rig.perturbed(share * size / own * shift)
    return replace(grown, covariance=covariance, allowances=allowances), share


def _from_middle(disc: Disc) -> Array:
    """(m, 2) [m] positions of the dots relative to their mean."""
    return np.asarray(disc.marker_centres_body[:, :2] - disc.marker_centres_body[:, :2].mean(axis=0))


def declared_places_kept(disc: Disc, shift: Array) -> Array:
    """Displacements (m, 3) that differ from `shift` (m, 2) only by a shift and a rotation of the whole pattern.

    Of these the one with the smallest sum of lengths: as many dots as possible stay at their declared positions.
    """
    motions = _pattern_motions(disc)
    rest = shift
    for _ in range(100):  # iteratively reweighted least squares; 1 nm keeps the weights finite
        weight = 1.0 / np.maximum(np.linalg.norm(rest, axis=1), 1e-9)
        weighted = motions * weight[:, None, None]
        normal = np.einsum("kai,kaj->ij", weighted, motions)
        new = shift - motions @ np.linalg.solve(normal, np.einsum("kai,ka->i", weighted, shift))
        done = np.abs(new - rest).max() < 1e-10
        rest = new
        if done:
            break
    return np.column_stack([rest, np.zeros(len(rest))])


def _pattern_motions(disc: Disc) -> Array:
    """Displacement (m, 2, 3) of the dots by a unit shift and rotation of the whole pattern."""
    x, y = disc.marker_centres_body[:, :2].T
    one, zero = np.ones_like(x), np.zeros_like(x)
    motions = np.stack([np.stack([one, zero, -y], -1), np.stack([zero, one, x], -1)], axis=1)
    motions[..., 2] /= np.sqrt(np.mean(x * x + y * y))
    return motions
