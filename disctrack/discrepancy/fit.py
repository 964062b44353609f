"""Gauss-Newton least squares with bounds and normal priors, for any system."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calibration.kit.brief import Brief
from calibration.kit.least_squares import OwnNumbers, covariance_within, solve_bounded
from calibration.kit.types import Array
from disctrack.discrepancy.elimination import Own, Projection, is_linear, prior_rows, projection
from disctrack.discrepancy.system import GivenUp, Quantity, System, Values

MAX_ITERATIONS = 40
TRIAL = 15  # iterations of a trial: an explanation that fits the data has converged by then
TOLERANCE, ROUGHLY = 1e-3, 0.1  # of the answer; of a trial, as 10 are needed to tell two explanations apart
HOPELESS = 1e-2  # share of what a fit lacks, below which its next step promises too little
_HALVINGS = 8


@dataclass(frozen=True, repr=False, eq=False)
class Fit(Brief):
    """Minimum of chi-square, data and priors together."""

    quantities: tuple[Quantity, ...]
    values: dict[str, float]  # of all fitted quantities, and of those that were held
    covariance: Array  # (k, k) of the `shared` ones; zero rows for those that the data do not determine
    chi_square: float  # of the data alone
    penalty: float  # of the priors
    n_data: int
    converged: bool
    n_iterations: int
    promised: float = 0.0  # decrease of chi-square by one more full step, to first order
    heads: tuple[OwnNumbers, ...] = ()  # elimination of the quantities that belong to single blocks of rows
    # of these quantities by name: root (r,) of the conditional variance, and derivative (k,) by the shared quantities
    own: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    @property
    def shared(self) -> tuple[str, ...]:
        """Fitted quantities that do not belong to a single block of rows."""
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
    def n_free(self) -> int:
        """Quantities without a prior."""
        return sum(not np.isfinite(q.prior_sigma) for q in self.quantities)

    @property
    def degrees_of_freedom(self) -> int:
        """Data minus quantities without a prior."""
        return self.n_data - self.n_free

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
            return 0.0  # of a fit that could not start
        i = self.shared.index(name)
        return float(np.sqrt(max(self.covariance[i, i], 0.0)))

    def amounts(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Differences (k,) of shared quantities from their nulls, and their covariance (k, k)."""
        index = [self.shared.index(n) for n in names]
        nulls = {q.name: q.null for q in self.quantities}
        return np.array([self.values[n] - nulls[n] for n in names]), self.covariance[np.ix_(index, index)]

    def excess(self, noise: float) -> float:
        """Chi-square in excess of its expectation for noise of this variance, in units of it."""
        return self.chi_square / noise - self.degrees_of_freedom

    def covariance_with(self, name: str) -> Array:
        """(names,) covariances of a shared quantity with all that are fitted."""
        column = self.covariance[self.shared.index(name)]
        found = dict(zip(self.shared, column, strict=True)) | {n: g @ column for n, (_, g) in self.own.items()}
        return np.array([found[n] for n in self.names])


def fit(
    system: System, quantities: Sequence[Quantity], start: Values, max_iterations: int = MAX_ITERATIONS,
    tolerance: float = TOLERANCE, wanted: float = np.inf,
) -> Fit:  # fmt: skip
    """Minimise chi-square over `quantities` from `start`; all other values of `start` are held.

    A step is halved where it increases chi-square or leads to where there is no prediction. `converged` is False where
    that does not help, or after the last iteration.

    tolerance : decrease of chi-square promised by a full step, over chi-square per datum, at which it has converged
    wanted : cost without which the fit is of no use: it is given up where a step promises little of what is lacking
    """
    problem = _Problem(system, quantities, start)
    converged, iteration = False, 0
    while np.isfinite(problem.cost) and iteration < max_iterations:
        iteration += 1
        step = problem.solve()
        if problem.expected < tolerance * max(1.0, problem.cost / problem.n_data):
            converged = True
            break
        if problem.expected < HOPELESS * (problem.cost - wanted) or not problem.go(step):
            # at the rounding errors of the prediction no step decreases chi-square, and the next one promises little
            converged = bool(problem.expected < max(0.1, 1e-7 * problem.cost))
            break
    return problem.fit(converged, iteration)


def attempt(
    system: System, quantities: Sequence[Quantity], start: Values, max_iterations: int = MAX_ITERATIONS,
    wanted: float = np.inf,
) -> Fit:  # fmt: skip
    """The fit of one hypothesis among many; `no_fit` where it takes more work than such a trial may."""
    try:
        with system.budget.trial(system.trial_work):
            return fit(system, quantities, start, max_iterations, ROUGHLY, wanted)
    except GivenUp:
        return no_fit(quantities, start)


def settled(system: System, trial: Fit) -> Fit:
    """The fit of a trial, which ends roughly, continued to its end; unchanged where that is not reached or better."""
    found = fit(system, trial.quantities, trial.values)
    return found if found.converged and found.cost < trial.cost else trial


class _Problem:
    """Residuals, derivatives and priors at the current values, and the step to better ones."""

    def __init__(self, system: System, quantities: Sequence[Quantity], start: Values) -> None:
        self.system, self.quantities = system, tuple(quantities)
        self.values = {q.name: q.null for q in self.quantities} | dict(start)
        for q in self.quantities:
            inside = float(np.clip(self.values[q.name], q.lower, q.upper))
            self.values[q.name] = q.null if is_linear(q) else inside
        self.common = projection(system, self.quantities, self.values)
        self.own = Own(system, self.quantities)
        self.moved = [q for q in self.quantities if not (is_linear(q) or q.slot)]
        self.names = [q.name for q in self.moved]
        self.lower, self.upper = np.array([q.lower for q in self.moved]), np.array([q.upper for q in self.moved])
        self.residual, self.derivative = system.linearise(self.values, [*self.own.slots, *self.names])
        self.n_data = int(np.sum(system.weights))
        self.cost = self._cost(self.values, self.residual, self.derivative)
        self.expected = float("inf")  # decrease of chi-square by a full step, to first order
        self.matrix, self.right = np.zeros((0, len(self.names))), np.zeros(0)
        self.heads: tuple[OwnNumbers, ...] = ()

    @property
    def x(self) -> Array:
        """(k,) values of the shared quantities that are not linear."""
        return np.array([self.values[n] for n in self.names])

    def solve(self) -> Array:
        """The full step (k,)."""
        right, matrix, self.heads = self.own.reduced(self.residual, self.derivative, self.values, self.common)
        prior, prior_matrix = prior_rows(self.moved, self.values)
        self.right, self.matrix = right, matrix = np.concatenate([right, prior]), np.vstack([matrix, prior_matrix])
        step = solve_bounded(right, matrix, self.lower - self.x, self.upper - self.x)
        gain = float(right @ right - np.sum((right - matrix @ step) ** 2))
        self.expected = gain + sum(h.gain for h in self.heads)
        return step

    def go(self, step: Array) -> bool:
        """Take the step, or a part of it; False where none decreases chi-square."""
        x, values, own = self.x, self.values, self.own.moved(self.heads, step)
        for halving in range(_HALVINGS):
            factor = 0.5**halving
            inside = np.clip(x + factor * step, self.lower, self.upper)
            trial = values | dict(zip(self.names, inside.tolist(), strict=True))
            trial |= {name: values[name] + factor * change for name, change in own.items()}
            # the prediction is tested first: derivatives cost many times more, above all after too long a step
            if not self._cost(trial, *self.system.linearise(trial, ())) < self.cost:
                continue
            residual, derivative = self.system.linearise(trial, [*self.own.slots, *self.names])
            cost = self._cost(trial, residual, derivative)
            if cost < self.cost:
                self.values, self.residual, self.derivative, self.cost = trial, residual, derivative, cost
                return True
        return False

    def _strain(self, values: Values) -> float:
        local = [q for block in self.own.blocks for q in block.quantities]
        return float(np.sum(prior_rows([*self.moved, *local], values)[0] ** 2))

    def _cost(self, values: Values, residual: Array, derivative: Array) -> float:
        """Chi-square with priors, minimised over the linear quantities; infinite without a prediction or derivative."""
        with np.errstate(over="ignore", invalid="ignore"):
            cost = float(np.sum(self.common.cleared(residual.reshape(-1, 1)) ** 2) + self._strain(values))
            usable = np.isfinite(cost) and np.isfinite(np.sum(derivative))
        return cost if usable else np.inf

    def fit(self, converged: bool, iterations: int) -> Fit:
        """The fit at the current values, with the best values of the linear quantities."""
        common, names, values = self.common, self.names, dict(self.values)
        covariance = covariance_within(self.matrix, self.right, self.x, self.lower, self.upper)
        penalty = 0.0
        if np.isfinite(self.cost):
            penalty = self._strain(values)
            if common.names:
                flat = self.residual.reshape(-1, 1)
                penalty += float(np.sum((common.prior_rows @ (common.rows.T @ flat)) ** 2))
                values |= dict(zip(common.names, (common.null + common.absorbed(flat)[:, 0]).tolist(), strict=True))
                covariance = _joint(covariance, common, self.derivative.reshape(-1, len(names)))
                order = [[*names, *common.names].index(q.name) for q in self.quantities]
                covariance = covariance[np.ix_(order, order)]
        elif common.names:
            covariance = np.zeros((len(self.quantities), len(self.quantities)))
        return Fit(
            self.quantities, values, covariance, float(self.cost - penalty), penalty, self.n_data, converged,
            iterations, self.expected, self.heads, self.own.known(self.heads),
        )  # fmt: skip


def no_fit(quantities: Sequence[Quantity], values: Values) -> Fit:
    """A fit without a result, worse than any other."""
    k, held = sum(not q.slot for q in quantities), {q.name: q.null for q in quantities} | dict(values)
    return Fit(tuple(quantities), held, np.zeros((k, k)), np.inf, 0.0, 0, False, 0)


def _joint(covariance: Array, common: Projection, derivative: Array) -> Array:
    """Joint covariance of the nonlinear quantities and, after them, the linear ones, from that of the former."""
    by_moved = -common.absorbed(derivative)
    across = by_moved @ covariance
    own = common.covariance + across @ by_moved.T
    return np.block([[covariance, across.T], [across, own]])
