"""What all frames of a recording share, refined over the whole sequence: the dots' places, the rig within its sigma.

Printed dots are off by tens of micrometres, the rig by its calibration's sigma; both leave the same residual in every
frame, and a few hundred frames of a moving disc determine them far better than the calibration did. Shared parameters
s and one pose per frame are fitted together; the poses are eliminated frame by frame (Schur complement):

    (sum_i C_i^T C_i - C_i^T P_i (P_i^T P_i)^-1 P_i^T C_i + prior^-1) ds = sum_i C_i^T (1 - P_i (...)^-1 P_i^T) r_i

P, C: whitened Jacobians by the pose and by s. Priors: the rig's own covariance; DOT_SIGMA for every dot in the plane
of the face. Gauge: moving or turning the whole pattern on the disc cannot be told from moving the disc. The pattern is
moved and turned to where the sum of the dots' displacements is smallest: if one dot is misprinted, the others stay
where they were declared, and the centre of mass with them; the cameras do not see it.

The pattern of the dots is a second ruler beside the board: by how much it comes out larger than declared is the error
of the rig's size or of the pattern's. Each has a variance, the rig's in its allowance for the board's size, the
pattern's from how regular it is: one that is stretched or sheared by little was hardly drawn to a wrong size. The rig's
size is moved by its share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.cameras.camera import N_RIG, PAIR_SHIFT, StereoRig
from calibration.judge.tolerances import SIZE
from calibration.kit.arrays import Array
from calibration.kit.least_squares import scaled_solve
from disctrack.disc import Disc
from disctrack.track.pose import DotsInFrames, PoseFits
from disctrack.track.side_by_side import MIN_FRAMES, SHARED_FRAMES, evenly

DOT_SIGMA = 50e-6  # [m] how far a printed dot may lie from its declared place: tens of micrometres are usual
# The template's and the camera model's own errors (0.002 px) repeat from frame to frame, so that a long recording must
# not be taken for as many independent measurements: this much is added to every dot's sigma per shared direction.
SYSTEMATIC_PX = 0.002
SIZE_FLOOR = 3e-6  # relative, of the dots as a ruler: metal and paper grow by some 1e-5 per kelvin
ITERATIONS = 3
MANY_DOTS = 5  # from which one may be left out
SUM_OF_LENGTHS = 1.35  # variance of the pattern's place by the sum of lengths over that by the sum of squares


@dataclass(frozen=True)
class AsBuilt:
    """Rig and disc after the refinement, and what it changed."""

    rig: StereoRig  # with the covariance that remains
    disc: Disc
    marker_shift: Array  # (m, 3) [m] refined minus declared, body axes; third component 0
    marker_shift_sigma: Array  # (m, 2) [m] of the dots against each other
    reduced_chi_square: float = float("nan")  # of the dots about their poses
    size: float = 0.0  # relative, by which dots that are as declared make all lengths longer than the board does
    size_sigma: float = float("nan")  # of the dots as a ruler
    size_share: float = 0.0  # of that, which the rig has been made larger by

    @property
    def details(self) -> dict[str, Any]:
        """Of JSON's types."""
        return {
            "size": {"by_dots": self.size, "sigma": self.size_sigma, "share": self.size_share},
            "marker_shift_um": (1e6 * self.marker_shift[:, :2]).round(3).tolist(),
            "marker_shift_sigma_um": (1e6 * self.marker_shift_sigma).round(3).tolist(),
        }

    @classmethod
    def moved(cls, rig: StereoRig, disc: Disc, shift: Array, covariance: Array, reduced_chi_square: float) -> AsBuilt:
        """Dots moved by the part of displacements (m, 2) of covariance (2m, 2m) that is theirs, not their sigma's."""
        motions = _pattern_motions(disc).reshape(-1, 3)
        keep = np.eye(len(covariance)) - motions @ np.linalg.pinv(motions)
        sigma = np.sqrt(np.diag(keep @ covariance @ keep)).reshape(-1, 2)
        kept = share_of_places(disc, shift, sigma) * declared_places_kept(disc, shift)
        disc = replace(disc, marker_centres_body=disc.marker_centres_body + kept)
        return cls(rig, disc, kept, sigma, reduced_chi_square)


def refine_as_built(frames: DotsInFrames) -> AsBuilt:
    """Refine the dots' places, and the rig's size, from the dots of n frames.

    Frames with fewer than all dots serve too. Fewer than MIN_FRAMES frames leave everything as declared.
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
    """Fit what the frames share by Gauss-Newton, with a free pose for every frame.

    sigma : (30 + 2m + j,) of the prior about zero; what has none is not free
    repeats : [px] errors that are common to all frames: they bound what these tell together
    returns : shift (30 + 2m + j,) of RIG_PARAMETERS, of the dots' places, of anything else; its covariance, zero where
        it was not free; reduced chi-square before each step; the frames with the poses before the last one
    """
    shift, reduced, free = np.zeros(len(sigma)), [], sigma > 0
    information = np.diag(sigma[free] ** -2)
    variance = float(np.nanmedian(0.5 * np.trace(frames.covariance, axis1=-2, axis2=-1)))
    share = variance / (variance + len(frames.t) * repeats**2)  # n frames count at most as (sigma / repeats)^2 frames
    for iteration in range(ITERATIONS):
        frames, fits = frames.fitted(shift, reject=iteration > 0)
        ok = fits.converged
        reduced.append(float(fits.chi_square[ok].sum() / max(fits.degrees_of_freedom[ok].sum(), 1)))
        used = fits.used & ok[:, None, None]
        normal, gradient, _ = frames.normal(shift, used, free)
        # dots that scatter more than the image noise alone makes them tell accordingly less, whatever is common to them
        scale = share / _scatter_left(fits, normal, gradient)
        matrix = scale * normal + information
        shift[free] += scaled_solve(matrix, scale * gradient - information @ shift[free])
    covariance = np.zeros((len(shift), len(shift)))
    covariance[np.ix_(free, free)] = scaled_solve(matrix, np.eye(len(matrix)))
    return shift, covariance, reduced, frames


def share_of_places(disc: Disc, shift: Array, sigma: Array) -> float:
    """Part of displacements (m, 2) of sigma (m, 2) to believe in: 1 - noise / power, or 0 (James and Stein 1961).

    Power and noise are those of the displacements against each other. What is found of dots that lie where they were
    declared is noise, and keeps them there; of dots that are off by ten times as much, 1 % is left out.
    """
    motions = _pattern_motions(disc).reshape(-1, 3)
    own = shift.reshape(-1) - motions @ (np.linalg.pinv(motions) @ shift.reshape(-1))
    return float(max(0.0, 1.0 - np.sum(sigma**2) / max(float(own @ own), 1e-30)))


def pattern_place(disc: Disc, shift: Array, sigma: Array) -> tuple[float, float]:
    """Variances of the pattern's displacement, per axis [m^2], and of its turn [rad^2]: what the gauge leaves open.

    shift : (m, 3) [m] of the dots from their declared places as `declared_places_kept` has them; sigma (m, 2) [m]

    Dots that lie off their places against each other by s, rms per axis, lie off them as a whole by s / sqrt(m). The
    dot that is off most is left out of s: one that was declared wrongly says nothing of the others. A sum of lengths is
    less efficient than one of squares, and s has few degrees of freedom (both by simulation, test_self_calibration.py).
    """
    m = disc.n_markers
    squares = np.sort(np.sum(shift[:, :2] ** 2, axis=1))
    freedom = 2 * m - 3
    if m >= MANY_DOTS:
        # of the sum of m exponentially distributed squares, the largest is this share
        squares = squares[:-1] / (1.0 - np.sum(1.0 / np.arange(1, m + 1)) / m)
        freedom -= 2
    found = float(squares.sum()) / (2 * m - 3)
    variance = max(0.0, found - float(np.mean(sigma**2))) * SUM_OF_LENGTHS * freedom / (freedom - 2)
    return variance / m, variance / float(np.sum(_from_middle(disc) ** 2))


def by_pattern(as_built: AsBuilt, R: Array, off_centre: float = 0.0) -> Array:
    """(n, 6, 3) change of poses R (n, 3, 3) whose dots are off as a whole, too, by one sigma of each way of it.

    off_centre : [m] by which the pattern may be off the disc's centre beside that, as the table tells
    """
    place, turn = pattern_place(as_built.disc, as_built.marker_shift, as_built.marker_shift_sigma)
    place += off_centre**2
    return motions_of_pattern(R, as_built.disc) * np.sqrt([place, place, turn])


def motions_of_pattern(R: Array, disc: Disc) -> Array:
    """(n, 6, 3) how poses R (n, 3, 3) change when the pattern is displaced along e1, e2 and turned about its middle."""
    x, y = disc.marker_centres_body[:, :2].mean(axis=0)
    motions = np.zeros((len(R), 6, 3))
    motions[:, :3, :2] = R[:, :, :2]
    motions[:, :3, 2] = y * R[:, :, 0] - x * R[:, :, 1]
    motions[:, 3:, 2] = R[:, :, 2]
    return motions


def pattern_size(disc: Disc, shift: Array, covariance: Array) -> tuple[float, float]:
    """By how much lengths are too short, relative, if the dots are as declared; and the dots' sigma as a ruler.

    shift : (m, 2) [m] refined minus declared places of covariance (2m, 2m); SIZE_FLOOR is added

    The sigma has two parts beside the floor: of dots that are misplaced at random, as those left by displacement, turn,
    size, stretch and shear are, which holds the refinement's errors as well and is no less than these; and of a pattern
    whose two sides are off by what stretch and shear show.
    """
    d = _from_middle(disc)
    columns = np.stack([d, d * [0.5, -0.5], 0.5 * d[:, ::-1]], axis=-1).reshape(-1, 3)
    columns = np.concatenate([columns, _pattern_motions(disc).reshape(-1, 3)], axis=1)
    inverse = np.linalg.pinv(columns)
    size, stretch, shear = (inverse @ shift.reshape(-1))[:3]
    refined = float((inverse @ covariance @ inverse.T)[0, 0])
    left = shift.reshape(-1) - columns @ (inverse @ shift.reshape(-1))
    freedom = max(len(left) - 6, 1)
    random = float(left @ left) / freedom / float(np.sum(d**2))
    # stretch and shear have the variance 2 v of two sides, the size, their mean, has v / 2
    drawn = (stretch**2 + shear**2) / 8.0
    return -float(size), float(np.sqrt(max(random, refined) + drawn + SIZE_FLOOR**2))


def sized_by_pattern(rig: StereoRig, size: float, sigma: float) -> tuple[StereoRig, float]:
    """The rig with all lengths longer by its share of `size` +- `sigma`, and that share; see the module."""
    by_size = [i for i, a in enumerate(rig.allowances) if a.cause == SIZE and a.shift[PAIR_SHIFT].any()]
    if not by_size:
        return rig, 0.0
    shift = rig.allowances[by_size[0]].shift
    own = float(np.linalg.norm(shift[PAIR_SHIFT])) / rig.baseline
    share = own**2 / (own**2 + sigma**2)
    left = np.sqrt(1.0 - share)
    allowances = list(rig.allowances)
    allowances[by_size[0]] = replace(allowances[by_size[0]], shift=left * shift)
    covariance = rig.covariance - (1.0 - left**2) * np.outer(shift, shift)
    grown = rig.perturbed(share * size / own * shift)
    return replace(grown, covariance=covariance, allowances=tuple(allowances)), share


def _from_middle(disc: Disc) -> Array:
    """(m, 2) [m] from the middle of the dots."""
    d: Array = disc.marker_centres_body[:, :2] - disc.marker_centres_body[:, :2].mean(axis=0)
    return d


def declared_places_kept(disc: Disc, shift: Array) -> Array:
    """Displacements (m, 3) that differ from `shift` (m, 2) by a displacement and a turn of the whole pattern only.

    Of all these the one with the smallest sum of lengths: as many dots as possible stay where they were declared.
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
    """Displacement (m, 2, 3) of the dots by a unit displacement and turn of the whole pattern."""
    x, y = disc.marker_centres_body[:, :2].T
    one, zero = np.ones_like(x), np.zeros_like(x)
    motions = np.stack([np.stack([one, zero, -y], -1), np.stack([zero, one, x], -1)], axis=1)
    motions[..., 2] /= np.sqrt(np.mean(x * x + y * y))
    return motions


def _scatter_left(fits: PoseFits, normal: Array, gradient: Array) -> float:
    """Reduced chi-square, at least 1, that the best step of what frames share will leave: the dots' own scatter.

    Before that step, dots declared in wrong places look like noise a hundred times the pixels', and hold it up.
    """
    chi_square, freedom = fits.chi_square[fits.converged].sum(), fits.degrees_of_freedom[fits.converged].sum()
    explained = gradient @ np.linalg.lstsq(normal, gradient, rcond=1e-12)[0]
    return max(1.0, float(chi_square - explained) / max(float(freedom), 1.0))
