"""Gauss-Newton with bounds and priors; it has never heard of discs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special
from scipy.optimize import lsq_linear

from calibration.kit.arrays import Array
from calibration.kit.brief import Outline
from disctrack.discrepancy.nuisances import Projection, is_linear, projection
from disctrack.discrepancy.own import Head, Own
from disctrack.discrepancy.system import Quantity, System, Values

MAX_ITERATIONS = 40
TOLERANCE = 1e-3  # a fit has converged when a full step would lower chi-square by less, over what is left per datum
NEAR = 1e-3  # sigmas from a bound, within which a quantity stands at it
CRAWLING, CRAWLED = 1e-3, 3  # share of chi-square that a halved step gains at most, so many times in a row
_HALVINGS = 8
NO_DERIVATIVE = np.zeros(0)


@dataclass(frozen=True, repr=False)
class Fit(Outline):
    """Minimum of chi-square, data and priors together."""

    quantities: tuple[Quantity, ...]
    values: dict[str, float]  # of all quantities fitted, and of those that were held
    covariance: Array  # (k, k) of the `shared` ones; zero rows for those that the data do not show
    chi_square: float  # of the data alone
    penalty: float  # of the priors
    n_data: int
    converged: bool
    n_iterations: int
    promised: float = 0.0  # chi-square that one more full step would lower, were the prediction linear
    heads: tuple[Head, ...] = ()  # of the quantities that blocks of rows have of their own
    # of them by name: root (r,), and how it moves with the shared ones (k,); its variance is their sum's
    own: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    @property
    def shared(self) -> tuple[str, ...]:
        """Fitted quantities that no block of rows has of its own."""
        return tuple(q.name for q in self.quantities if not q.slot)

    @property
    def names(self) -> tuple[str, ...]:
        """Fitted quantities."""
        return tuple(q.name for q in self.quantities)

    @property
    def cost(self) -> float:
        """Chi-square of data and priors."""
        return self.chi_square + self.penalty

    @property
    def degrees_of_freedom(self) -> int:
        """Data minus quantities without a prior."""
        return self.n_data - sum(not np.isfinite(q.prior_sigma) for q in self.quantities)

    @property
    def reduced_chi_square(self) -> float:
        """Chi-square of the data per degree of freedom."""
        return self.chi_square / max(self.degrees_of_freedom, 1)

    def sigma(self, name: str) -> float:
        """Standard deviation of one fitted quantity; at a bound, how far inside it the truth may lie (rms)."""
        if name in self.own:
            root, by_shared = self.own[name]
            return float(np.sqrt(root @ root + max(float(by_shared @ self.covariance @ by_shared), 0.0)))
        if name not in self.shared:
            return 0.0  # of a fit that never began
        i = self.shared.index(name)
        return float(np.sqrt(max(self.covariance[i, i], 0.0)))

    def covariance_with(self, name: str) -> Array:
        """(names,) covariances of a shared quantity with all that are fitted."""
        column = self.covariance[self.shared.index(name)]
        found = dict(zip(self.shared, column, strict=True)) | {n: g @ column for n, (_, g) in self.own.items()}
        return np.array([found[n] for n in self.names])


def compress(residual: Array, derivative: Array, common: Projection | None = None) -> tuple[Array, Array]:
    """Smaller least-squares problem with the same solutions: (right side (m,), matrix (m, k)), m = k + 1 at most.

    The Q of [derivative, residual] is dropped; norms and angles of all combinations of columns stay, once what linear
    quantities in `common` absorb is taken off.
    """
    stacked = np.column_stack([derivative.reshape(residual.size, -1), residual.reshape(-1)])
    R = triangle(stacked if common is None else common.cleared(stacked))
    return R[:, -1], R[:, :-1]


def triangle(matrix: Array) -> Array:
    """R of the QR decomposition of a tall matrix (m, k), in blocks of rows that stay in the processor's cache."""
    m, k = matrix.shape
    block = 8 * max(k, 1)
    whole = m // block
    if whole < 2:
        return np.asarray(np.linalg.qr(matrix, mode="r"), float)
    parts = np.asarray(np.linalg.qr(matrix[: whole * block].reshape(whole, block, k), mode="r")).reshape(-1, k)
    return triangle(np.vstack([parts, matrix[whole * block :]]))


def prior_rows(quantities: Sequence[Quantity], values: Values) -> tuple[Array, Array]:
    """Rows that priors add to a least-squares problem: (right side (p,), matrix (p, k))."""
    with_prior = [i for i, q in enumerate(quantities) if np.isfinite(q.prior_sigma)]
    matrix = np.zeros((len(with_prior), len(quantities)))
    for row, i in enumerate(with_prior):
        matrix[row, i] = 1.0 / quantities[i].prior_sigma
    return prior_residual(quantities, values), matrix


def prior_residual(quantities: Sequence[Quantity], values: Values) -> Array:
    """(p,) null minus value, over its standard deviation, of those with a prior."""
    return np.array([(q.null - values[q.name]) / q.prior_sigma for q in quantities if np.isfinite(q.prior_sigma)])


def solve_bounded(right: Array, matrix: Array, lower: Array, upper: Array) -> Array:
    """Argmin |right - matrix x| with lower <= x <= upper; where directions are undetermined, the shortest x."""
    length = np.linalg.norm(matrix, axis=0)
    if length.size == 0:
        return np.zeros(0)
    scale = np.where(length > 0, 1.0 / np.where(length > 0, length, 1.0), 1.0)
    scaled = matrix * scale
    x = np.asarray(np.linalg.lstsq(scaled, right, rcond=1e-12)[0] * scale, float)
    if bool(np.all((x >= lower) & (x <= upper))):
        return x
    with np.errstate(invalid="ignore", over="ignore"):  # far from any solution products of large numbers overflow
        bounds = (lower / scale, upper / scale)
        inside = lsq_linear(scaled, right, bounds, tol=1e-12)
        found = np.asarray(inside.x * scale, float)
    if not np.isfinite(found).all():
        return np.clip(x, lower, upper)
    return np.where(inside.active_mask < 0, lower, np.where(inside.active_mask > 0, upper, found))


def fit(
    system: System,
    quantities: Sequence[Quantity],
    start: Values,
    max_iterations: int = MAX_ITERATIONS,
    may_crawl: bool = True,
) -> Fit:
    """Minimise chi-square over `quantities` from `start`; whatever else `start` holds stays as it is.

    A step that leads where there is no prediction, or uphill, is halved. `converged` is False where that does not help
    or the iterations run out; or where it has to be done again and again to gain next to nothing, unless it may crawl.
    """
    quantities = tuple(quantities)
    values = {q.name: q.null for q in quantities} | dict(start)
    for q in quantities:
        values[q.name] = q.null if is_linear(q) else float(np.clip(values[q.name], q.lower, q.upper))
    common = projection(system, quantities, values)
    own = Own(system, quantities)
    local = [q for block in own.blocks for q in block.quantities]
    moved = [q for q in quantities if not (is_linear(q) or q.slot)]
    names = [q.name for q in moved]
    asked = [*own.slots, *names]
    lower, upper = np.array([q.lower for q in moved]), np.array([q.upper for q in moved])
    residual, derivative = system.linearise(values, asked)
    n_data = int(np.sum(system.weights))
    prior, prior_matrix = prior_rows(moved, values)
    strain = prior_residual([*moved, *local], values)
    cost = _cost(residual, strain, derivative, common)
    converged, iteration, crawled = False, 0, 0
    expected = float("inf")
    matrix, right = np.zeros((0, len(names))), np.zeros(0)
    heads: tuple[Head, ...] = ()
    while np.isfinite(cost) and iteration < max_iterations:
        iteration += 1
        if local:
            right, matrix, heads = own.reduced(residual, derivative, values)
        else:
            right, matrix = compress(residual, derivative, common)
        right, matrix = np.concatenate([right, prior]), np.vstack([matrix, prior_matrix])
        x = np.array([values[n] for n in names])
        step = solve_bounded(right, matrix, lower - x, upper - x)
        expected = float(right @ right - np.sum((right - matrix @ step) ** 2)) + sum(h.gain for h in heads)
        local_step = own.moved(heads, step)
        if expected < TOLERANCE * max(1.0, cost / n_data):
            converged = True
            break
        for halving in range(_HALVINGS):
            factor = 0.5**halving
            trial = values | dict(zip(names, np.clip(x + factor * step, lower, upper).tolist(), strict=True))
            trial |= {name: values[name] + factor * change for name, change in local_step.items()}
            new_strain = prior_residual([*moved, *local], trial)
            if halving and not _cost(system.linearise(trial, ())[0], new_strain, NO_DERIVATIVE, common) < cost:
                continue  # derivatives cost many times more, and a step that failed once may well fail again
            new_residual, new_derivative = system.linearise(trial, asked)
            new_cost = _cost(new_residual, new_strain, new_derivative, common)
            if np.isfinite(new_cost) and new_cost < cost:
                break
        else:
            # rounding of the prediction: no step lowers chi-square although the next one promises next to nothing
            converged = bool(expected < max(0.1, 1e-7 * cost))
            break
        crawled = crawled + 1 if halving and cost - new_cost < CRAWLING * cost else 0
        values, residual, derivative, strain, cost = trial, new_residual, new_derivative, new_strain, new_cost
        prior, _ = prior_rows(moved, values)
        if crawled == CRAWLED and not may_crawl:
            break
    covariance = covariance_within(matrix, right, np.array([values[n] for n in names]), lower, upper)
    chi_square, penalty = float(cost), 0.0
    if np.isfinite(cost):
        penalty = float(strain @ strain)
        chi_square = cost - penalty
    if np.isfinite(cost) and common.names:
        flat = residual.reshape(-1, 1)
        penalty += float(np.sum((common.prior_rows @ (common.rows.T @ flat)) ** 2))
        chi_square = cost - penalty
        found = common.null + common.absorbed(flat)[:, 0]
        values |= dict(zip(common.names, found.tolist(), strict=True))
        covariance = _joint(covariance, common, derivative.reshape(-1, len(names)))
        order = [[*names, *common.names].index(q.name) for q in quantities]
        covariance = covariance[np.ix_(order, order)]
    elif common.names:
        covariance = np.zeros((len(quantities), len(quantities)))
    return Fit(
        quantities, values, covariance, float(chi_square), penalty, n_data, converged, iteration, expected, heads,
        own.known(heads),
    )  # fmt: skip


def no_fit(quantities: Sequence[Quantity], values: Values) -> Fit:
    """What became of a fit that was given up: nothing that any other could be worse than."""
    k = sum(not q.slot for q in quantities)
    return Fit(tuple(quantities), dict(values), np.zeros((k, k)), np.inf, 0.0, 0, False, 0)


def _joint(covariance: Array, common: Projection, derivative: Array) -> Array:
    """Covariance of the moved quantities, and after them of the linear ones, from that of the former."""
    by_moved = -common.absorbed(derivative)
    across = by_moved @ covariance
    own = common.covariance + across @ by_moved.T
    return np.block([[covariance, across.T], [across, own]])


def _cost(residual: Array, prior: Array, derivative: Array, common: Projection) -> float:
    """Chi-square with priors, at the best values of the linear quantities; infinite where there is no prediction.

    Nor is there one where it has no derivative.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        cost = float(np.sum(common.cleared(residual.reshape(-1, 1)) ** 2) + prior @ prior)
        usable = np.isfinite(cost) and np.isfinite(np.sum(derivative))
    return cost if usable else np.inf


def covariance_within(matrix: Array, right: Array, x: Array, lower: Array, upper: Array) -> Array:
    """Covariance of quantities about x, some of which stand at a bound; zero rows for those that nothing shows.

    A quantity at a bound is not known to lie there: the data allow what a normal distribution leaves inside the bound
    (its second moment about the bound), and whatever moves together with it is uncertain by that much more.
    """
    k = len(x)
    covariance = np.zeros((k, k))
    if len(matrix) == 0 or k == 0:
        return covariance
    free = _inverse(matrix)
    sigma = np.sqrt(np.maximum(np.diag(free), 0.0))
    outwards = np.where(x - lower <= NEAR * sigma, -1.0, np.where(upper - x <= NEAR * sigma, 1.0, 0.0))
    held = np.flatnonzero(outwards)
    if held.size == 0:
        return free
    others = np.flatnonzero(outwards == 0)
    covariance[np.ix_(others, others)] = _inverse(matrix[:, others])
    held = held[sigma[held] > 0]
    if held.size == 0:
        return covariance
    beyond = outwards[held] * (free @ (matrix.T @ right))[held] / sigma[held]
    share = np.array([_within_bound(float(t)) for t in beyond])
    across = np.zeros((k, held.size))
    correlation = free[np.ix_(held, held)] / np.outer(sigma[held], sigma[held])
    across[others] = free[np.ix_(others, held)] / sigma[held] @ np.linalg.pinv(correlation, rcond=1e-10) / sigma[held]
    across[held, np.arange(held.size)] = 1.0
    inside = correlation * np.outer(share * sigma[held], share * sigma[held])
    return np.asarray(covariance + across @ inside @ across.T, float)


def _within_bound(beyond: float) -> float:
    """Rms distance from a bound, of a normal number with mean `beyond` sigmas outside of it and known to lie inside."""
    t = max(beyond, 0.0)
    if t > 8.0:  # the exponential tail
        return float(np.sqrt(2.0) / t)
    hazard = np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi) / special.ndtr(-t)
    return float(np.sqrt(max(1.0 + t * t - t * hazard, 0.0)))


def _inverse(matrix: Array) -> Array:
    """Inverse of the normal matrix; directions that are not determined get no variance."""
    length = np.linalg.norm(matrix, axis=0)
    length = np.where(length > 0, length, 1.0)
    if matrix.shape[1] == 0:
        return np.zeros((0, 0))
    _, singular, V = np.linalg.svd(matrix / length, full_matrices=False)
    floor = 1e-12 * max(float(singular[0]), 1e-100)
    weight = np.where(singular > floor, 1.0 / np.maximum(singular, floor) ** 2, 0.0)
    return np.asarray((V.T * weight) @ V / np.outer(length, length), float)
