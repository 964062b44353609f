"""Systematic errors of the positions of the dots, estimated from the dots alone, without a model of the motion.

Two cameras see a rigid pattern of m dots: of the 4 m components of a frame six are its pose, and the others should be
noise. Their scatter from frame to frame is the noise. The remaining residuals change slowly, and are a smooth function
of the position in the image (lens, board), of the dot (print), or of both (glare, gradients of light). The standard
deviations and the correlation length of these random fields are estimated by restricted maximum likelihood from the
components that no pose absorbs. The same fields, with these priors, are then fitted along with the motion as nuisances.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_triangular
from scipy.stats import chi2

from calibration.kit.types import Array, Mask
from disctrack.diagnosis.stretch import MIN_FRAMES
from disctrack.discrepancy.noise import THIRD
from disctrack.discrepancy.significance import SURE
from disctrack.faults.catalogue import TYPICAL_STEPS
from disctrack.track.side_by_side import evenly
from disctrack.trajectory import MarkerStatus, Trajectory

if TYPE_CHECKING:
    from disctrack.diagnosis.disc_system import DiscSystem


MARGIN = 0.6  # of a field's correlation length, by which its grid exceeds the positions
DOT_SIGMA = 3e-7  # [m] a common bias of one dot's centre in all images: 1/800 px, below what edges of dots allow
# Correlation lengths of a camera's field, over the extent of the positions. For the same bends a field of half the
# length has half the size, and shifts or turns the whole image half as much
LENS_LENGTHS = (0.17, 0.24, 0.35, 0.5, 0.7, 1.0)
DOT_LENGTH = 0.5  # correlation length of the fields of single dots, likewise
MAX_FRAMES = 200  # that are used: fields change slowly
WORTH = 20.0  # increase of twice the log likelihood by which a fault or a field is accepted: odds of 2e4
SEEN = 0.2  # sigmas by which a mode of a field moves all dots together at least; smaller ones are left out


def noise_over_stated(trajectory: Trajectory) -> float:
    """Variance of the dots from frame to frame over that stated; 1 if not significantly different, or unknown.

    From third differences in time of the residuals about the poses, which suppress the motion and all slow errors.
    """
    residual = trajectory.markers_residual_px
    seen = (trajectory.marker_status == MarkerStatus.MEASURED) & np.isfinite(residual).all(-1)
    variance = 0.5 * np.trace(trajectory.markers_covariance_px2, axis1=-2, axis2=-1)
    seen &= np.isfinite(variance) & (variance > 0)
    scaled = np.where(seen, residual.transpose(3, 0, 1, 2) / np.sqrt(np.where(seen, variance, 1.0)), 0.0)
    together = seen[3:] & seen[2:-1] & seen[1:-2] & seen[:-3] & np.all(np.diff(trajectory.frame) == 1)
    if together.any(axis=(1, 2)).sum() < MIN_FRAMES // 2:
        return 1.0
    difference = np.diff(scaled, 3, axis=1)[:, together]
    numbers = 2.0 * seen.sum(axis=(1, 2))
    free = np.mean(np.clip((numbers - 6.0) / np.maximum(numbers, 1.0), 0.0, 1.0)[numbers > 6])
    # trimmed by the largest 5 %: single bad frames are outliers
    squares = np.sort(np.ravel(difference) ** 2)
    of_normal = chi2.cdf(chi2.ppf(0.95, 1), 3) / 0.95
    ratio = float(np.mean(squares[: int(0.95 * squares.size)]) / of_normal / 20.0 / free)
    scatter = np.sqrt(2 * (1 + THIRD) / max(float(np.sum(np.maximum(numbers - 6.0, 0.0))), 1.0))
    return ratio if ratio > 0 and abs(ratio - 1.0) > SURE * scatter else 1.0


def with_noise_of_frames(trajectory: Trajectory) -> Trajectory:
    """The trajectory with its covariances reduced to the scatter from frame to frame.

    With a covariance that was enlarged to cover systematic errors, a slow motion looks like rest, and effects are not
    significant.
    """
    ratio = noise_over_stated(trajectory)
    return with_noise(trajectory, ratio) if ratio < 1 else trajectory


def with_noise(trajectory: Trajectory, ratio: float) -> Trajectory:
    """The trajectory with its covariances multiplied by a ratio."""
    poses, dots = ratio * trajectory.pose_covariance, ratio * trajectory.markers_covariance_px2
    reduced = trajectory.reduced_chi_square / ratio
    return replace(trajectory, pose_covariance=poses, markers_covariance_px2=dots, reduced_chi_square=reduced)


@dataclass(frozen=True)
class Systematic:
    """Sizes of the systematic errors of the dots of a recording; zero if not significant."""

    lens_px: float = 0.0  # rms of each camera's field, per coordinate
    lens_length_px: float = 100.0  # its correlation length
    dot_px: float = 0.0  # rms of each dot's own field in each camera
    dot_length_px: float = 200.0
    print_m: float = 0.0  # rms error of the dots' positions on the face, per coordinate
    faults_px: float = 0.0  # rms by which faults of the measurement move the dots, per coordinate
    lens_places: tuple[Array, ...] = ()  # positions in each camera, of all recordings that share its field
    left: float = 1.0  # remaining variance over the noise, of the components that no pose absorbs

    @property
    def present(self) -> bool:
        """Is there any systematic error?"""
        return max(self.lens_px, self.dot_px, self.print_m) > 0

    @property
    def rms_px(self) -> float:
        """Rms of all fields together, per coordinate."""
        return float(np.hypot(self.lens_px, self.dot_px))


def field_modes(at: Array, places: Array, length: float, sigmas: float) -> Array:
    """(..., k) modes at (..., 2) [px] of a random field of unit variance with a correlation length.

    places : (n, 2) positions of the dots
    sigmas : rms of the field over the noise of one position; modes that all n together do not determine are left out
    """
    low, high = places.min(axis=0) - MARGIN * length, places.max(axis=0) + MARGIN * length
    counts = np.maximum(np.ceil((high - low) / length).astype(int) + 1, 2)
    x, y = (np.linspace(a, b, int(n)) for a, b, n in zip(low, high, counts, strict=True))
    centres = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    bumps = _bumps(places, centres, length)
    gram = bumps.T @ bumps
    size = float(np.sqrt(np.trace(gram) / len(places)))  # rms of the sum of bumps with weights of unit variance
    eigenvalues, vectors = np.linalg.eigh(gram / size**2)
    seen = sigmas * np.sqrt(np.maximum(eigenvalues, 0.0)) > SEEN
    return _bumps(at, centres, length) @ (vectors[:, seen] / size)


def _bumps(places: Array, centres: Array, length: float) -> Array:
    squared = np.sum(places**2, axis=-1)[..., None] + np.sum(centres**2, axis=-1) - 2 * places @ centres.T
    return np.asarray(np.exp(-0.5 * squared / length**2), float)


def field_columns(
    places: Array, used: Mask, length: float, sigmas: float, own: bool = False, in_common: Sequence[Array] = ()
) -> Array:
    """(n, 2, m, 2, k) shifts [px] by fields of unit size, one for each camera and coordinate.

    own : each dot has fields of its own; otherwise they are common to all dots
    in_common : of each camera, the positions that define the modes, if not these
    """
    found, m = [], places.shape[2]
    for camera in range(2):
        for dots in [slice(i, i + 1) for i in range(m)] if own else [slice(m)]:
            here, seen = places[:, camera, dots], used[:, camera, dots]
            if seen.any():
                modes = field_modes(here, in_common[camera] if in_common else here[seen], length, sigmas)
                for axis in range(2):
                    column = np.zeros((*places.shape, modes.shape[-1]))
                    column[:, camera, dots, axis] = modes
                    found.append(column)
    return np.concatenate(found, axis=-1)


class Likelihood:
    """Marginal likelihood of data (n,): noise of unit variance plus columns (n, k_i) times normal numbers.

    The numbers of a group i have a common standard deviation, its size. All is computed from inner products, so that
    trying sizes takes no operation on the data.
    """

    def __init__(self, data: Array, groups: Mapping[str, Array]) -> None:
        """Groups : columns of each group, whitened as the data are."""
        ends = np.cumsum([0, *(group.shape[1] for group in groups.values())]).tolist()
        self._slices = {name: slice(*pair) for name, pair in zip(groups, pairwise(ends), strict=True)}
        columns = np.concatenate(list(groups.values()), axis=1)
        self._gram, self._inner, self._power = columns.T @ columns, columns.T @ data, float(data @ data)

    def at(self, sizes: Mapping[str, float]) -> tuple[float, dict[str, Array], float]:
        """Twice the log likelihood at these sizes, up to a constant; the most probable numbers, and chi-square there.

        The size of a group that is not named is zero. The numbers are by group, in the units of its columns.
        """
        scale = np.concatenate([np.full(part.stop - part.start, sizes.get(g, 0.0)) for g, part in self._slices.items()])
        used, numbers = scale > 0, np.zeros(len(scale))
        gram = self._gram[np.ix_(used, used)] * np.outer(scale[used], scale[used])
        root = np.linalg.cholesky(gram + np.eye(len(gram)))
        known = solve_triangular(root, (scale * self._inner)[used], lower=True)
        numbers[used] = scale[used] * solve_triangular(root, known, lower=True, trans=1)
        chi_square = self._power - float(known @ known)
        twice_log = -chi_square - 2.0 * float(np.sum(np.log(np.diag(root))))
        return twice_log, {name: numbers[part] for name, part in self._slices.items()}, chi_square


Sizes = dict[str, float]


def _best_sizes(likelihood: Likelihood, sizes: Sizes, grids: Mapping[str, Array]) -> tuple[float, Sizes]:
    """Sizes of the groups in `grids` that maximise the likelihood, by coordinate ascent on their grids."""
    best, before = likelihood.at(sizes)[0], -np.inf
    while best - before >= 1.0:
        before = best
        for name, grid in grids.items():
            here = int(np.argmin(np.abs(np.log(grid / sizes[name])))) if name in sizes else -1
            for way in (grid[here + 1 :], grid[: max(here, 0)][::-1]):
                for size in way.tolist():
                    trial = sizes | {name: size}
                    value = likelihood.at(trial)[0]
                    if value <= best:
                        break
                    best, sizes = value, trial
    return best, sizes


def _with_faults(likelihood: Likelihood, sizes: Sizes, faults: Mapping[str, float]) -> tuple[float, Sizes]:
    """Forward selection of the faults that increase the likelihood at these sizes."""
    best = likelihood.at(sizes)[0]
    while True:
        trials = {name: likelihood.at(sizes | {name: size})[0] for name, size in faults.items() if name not in sizes}
        name = max(trials, key=lambda n: trials[n], default="")
        if not name or trials[name] < best + WORTH:
            return best, sizes
        best, sizes = trials[name], sizes | {name: faults[name]}


def find_systematic(system: "DiscSystem") -> Systematic:
    """Sizes of the systematic errors of the dots, with the faults of the measurement that explain them better.

    The poses were found with the faults that the system knows.
    """
    known, view = system.known, system.about_poses(system.known)
    rows = np.flatnonzero(view.weights >= np.max(view.weights))
    if len(rows) < MIN_FRAMES:
        return Systematic()
    rows = evenly(rows, MAX_FRAMES)
    places, (residual, by_pose, normal) = view.pixels(known), (part[rows] for part in view.pose_equations(known))

    def across(columns: Array) -> Array:
        """(4 m k, c) the part of whitened columns (k, 4 m, c) that no pose absorbs."""
        taken = by_pose @ np.linalg.solve(normal, np.swapaxes(by_pose, 1, 2) @ columns)
        return np.asarray((columns - taken).reshape(residual.size, -1), float)

    def columns_by(names: Sequence[str]) -> Array:
        return across(view.linearise(known, names)[1][rows])

    data = across(residual[..., None])[:, 0]
    size, numbers = max(float(np.sqrt(np.mean(data**2))), 1.0), float(np.sum(view.weights[rows] - 6.0))
    used = view.used & np.isin(np.arange(len(view.used)), rows)[:, None, None]
    extent = float(max(np.ptp(places[:, c][used[:, c]], axis=0).max() for c in range(2) if used[:, c].any()))

    def field(length: float, own: bool = False) -> Array:
        return across(view.whitened(field_columns(places, used, length, size, own))[rows])

    typical = {fault.name: TYPICAL_STEPS * fault.step for fault in system.faults if fault.of_poses_alone}
    by_fault = {f.name: view.linearise(known, f.names())[1][rows] for f in system.faults if f.name in typical}
    faults = {name: across(columns) for name, columns in by_fault.items()}
    faults = {name: columns for name, columns in faults.items() if np.linalg.norm(columns) * typical[name] > 3.0}
    groups = {"rig": columns_by([q.name for q in system.base if q.owner == "rig"]), **faults}
    groups["print"] = columns_by([f"dot_{i}.{axis}" for i in range(system.disc.n_markers) for axis in "xy"])
    groups["dot"] = field(DOT_LENGTH * extent, own=True)
    steps: Array = size / view.per_px * 2.0 ** np.arange(-7, 4.5, 1.0)
    grids = {"print": DOT_SIGMA * 2.0 ** np.arange(7.0), "lens": steps, "dot": steps}
    start, offered = {"rig": 1.0, "print": DOT_SIGMA}, {name: typical[name] for name in faults}
    found, most = Systematic(), -np.inf
    for share in (0.0, *LENS_LENGTHS):  # without any field, and with fields of the cameras of the likeliest length
        sought, fields = (grids, {"lens": field(share * extent)}) if share else ({}, {})
        likelihood = Likelihood(data, groups | fields)
        value, sizes = _best_sizes(likelihood, dict(start), sought)
        value, sizes = _with_faults(likelihood, sizes, offered)
        chosen = [name for name in sizes if name in offered]
        if chosen:  # the faults have reduced the fields
            value, sizes = _best_sizes(likelihood, start | {name: typical[name] for name in chosen}, sought)
        if share and value < most + (0.0 if found.present else WORTH):
            continue
        _, amounts, chi_square = likelihood.at(sizes)
        moved = float(np.linalg.norm(sum(by_fault[name] @ amounts[name] for name in chosen)))
        lens, dot = (sizes.get("lens", 0.0), share * extent), (sizes.get("dot", 0.0), DOT_LENGTH * extent)
        print_m, left = sizes["print"] if sizes["print"] > DOT_SIGMA else 0.0, max(1.0, chi_square / numbers)
        faults_px = moved / float(np.sqrt(np.sum(view.weights[rows]))) / view.per_px
        found, most = Systematic(*lens, *dot, print_m, faults_px, left=left if share else 1.0), value
    return found
