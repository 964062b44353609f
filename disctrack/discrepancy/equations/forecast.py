"""Free runs of a fitted model over further runs: predicted sensor values with their uncertainty."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calibration.kit.arrays import Array
from disctrack.discrepancy.elimination import prior_rows
from disctrack.discrepancy.equations import shooting
from disctrack.discrepancy.equations.declared import Samples
from disctrack.discrepancy.equations.system import EquationSystem
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.significance import TWO_SIDED

OF_SIZE = 1e4  # prior sigma over the scale of a state: ten times its size


@dataclass(frozen=True)
class Forecast:
    """Predicted sensor values at the instants of a run, by channel; NaN where the motion cannot be integrated."""

    time: Array  # (n,) [s] since the first sample
    values: Mapping[str, Array]  # (n,)
    sigmas: Mapping[str, Array]  # (n,) of a sample: by parameters, initial state, and residuals of the fit

    def __getitem__(self, channel: str) -> Array:
        """Values of a channel (n,)."""
        return self.values[channel]


@dataclass(frozen=True)
class RunScore:
    """How well a free run predicts one channel."""

    rms: float  # of measured minus predicted, in the channel's unit
    covered: float  # share of the samples within the 95 % band
    n_samples: int


def free_run(system: EquationSystem, fitted: Fit, samples: Samples, left: Array, window: float) -> Forecast:
    """Integrate the model with the fitted parameters.

    system : with formulas and sizes; its stretches are not used
    left : (w,) rms of the residuals of each channel
    window : [s] of the run to which its initial state is fitted; 0: it starts from the state of the fit or the run
    """
    alone = replace(system, stretches=[replace(samples, sigma=np.broadcast_to(left, samples.data.shape))])
    values, states = dict(fitted.values), [q for q in alone.base if q.is_initial]
    by_state = [q.name for q in states] if window > 0 else []
    numbers = [n for n in fitted.shared if n in alone.names_of(samples) and n not in by_state]
    covariance = fitted.amounts(numbers)[1]
    spread, follows = np.zeros((0, 0)), np.zeros((0, len(numbers)))
    if by_state:
        n = int(np.searchsorted(samples.time, window, side="right"))
        begin = replace(alone, stretches=[alone.stretches[0].part(0, n)])
        begun = shooting.initial_guess(begin)[0]
        loose = [
            replace(q, null=begun[q.name], prior_sigma=OF_SIZE * q.scale) if np.isinf(q.prior_sigma) else q
            for q in states
        ]
        start = fit(begin, loose, values | begun)
        values, spread = values | start.values, start.covariance
        residual, J = begin.linearise(values, [*by_state, *numbers])
        J = J.reshape(-1, J.shape[-1])
        # one more step: with a wide band the fit stops before the minimum
        prior, by_prior = prior_rows(loose, values)
        step = spread @ (J[:, : len(by_state)].T @ residual.ravel() + by_prior.T @ prior)
        values |= {name: values[name] + float(d) for name, d in zip(by_state, step, strict=True)}
        # with other numbers the fit of the initial state is another
        follows = -spread @ J[:, : len(by_state)].T @ J[:, len(by_state) :]
    found = alone.predict(values, alone.stretches[0], [*by_state, *numbers])
    seen = sigma = np.full(samples.data.shape, np.nan)
    if found is not None:
        of_start, of_numbers = np.split(found.derivative, [len(by_state)], axis=2)
        of_numbers = of_numbers + of_start @ follows
        variance = np.broadcast_to(left**2, seen.shape).copy()
        for J, C in ((of_start, spread), (of_numbers, covariance)):
            variance += np.einsum("nwi,ij,nwj->nw", J, C, J)
        seen, sigma = found.seen, np.sqrt(np.maximum(variance, 0.0))
    by_channel = [dict(zip(alone.formulas.channels, each.T, strict=True)) for each in (seen, sigma)]
    return Forecast(samples.time, *by_channel)


def scored(found: Forecast, samples: Samples, channels: tuple[str, ...], since: float) -> dict[str, RunScore]:
    """By channel, over the samples after `since` [s]."""
    scores = {}
    for c, name in enumerate(channels):
        rows = np.isfinite(samples.data[:, c]) & (samples.time > since)
        left = (samples.data[:, c] - found[name])[rows]
        within = np.abs(left) <= TWO_SIDED * found.sigmas[name][rows]
        scores[name] = RunScore(float(np.sqrt(np.mean(left**2))), float(np.mean(within)), int(rows.sum()))
    return scores
