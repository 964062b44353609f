"""Gauss-Newton with bounds and priors; it has never heard of discs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calibration.kit.arrays import Array
from calibration.kit.brief import Outline
from calibration.kit.least_squares import OwnNumbers, covariance_within, solve_bounded, triangle
from disctrack.discrepancy.nuisances import Projection, is_linear, projection
from disctrack.discrepancy.own import Own
from disctrack.discrepancy.system import Quantity, System, Values

MAX_ITERATIONS = 40
TOLERANCE = 1e-3  # a fit has converged when a full step would lower chi-square by less, over what is left per datum
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
    heads: tuple[OwnNumbers, ...] = ()  # of the quantities that blocks of rows have of their own
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
    heads: tuple[OwnNumbers, ...] = ()
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
