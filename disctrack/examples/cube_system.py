"""A tossed cube in free flight as a system of one's own (`disctrack.discrepancy.system`).

Base model: the centre of the tags is the centre of mass and falls with the declared gravity; a uniform cube turns at a
constant angular velocity. Place, velocity, attitude and angular velocity are each flight's own: they are cleared out,
and what is judged are the combinations of a flight's samples that these cannot move. Every effect is small; its
residual is reckoned to first order along the smooth motion of the flight (`cube_effects`).
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from calibration.kit.arrays import Array, Mask
from disctrack.discrepancy.noise import SampleStretch, SmoothNoise, estimate
from disctrack.discrepancy.system import System, Values
from disctrack.errors import AnalysisError
from disctrack.examples.cube_data import HALF_WIDTH, Flight, Resting, Toss, flights, resting, without_copies
from disctrack.examples.cube_effects import GRAVITY, candidates, flown, rested

GROUPS = {"horizontal": (0, 1), "vertical": (2,), "turn": (3, 4, 5)}  # channels whose noise is alike: x, y, z, turns
HELD_OUT = 3  # every third toss
ABSORBED = 1e-9  # share of an effect, up to which what a flight's own motion leaves of it is rounding
_START = {
    "horizontal": SmoothNoise(2e-5, 5e-5, 0.03),
    "vertical": SmoothNoise(2e-5, 3e-5, 0.03),
    "turn": SmoothNoise(2e-4, 3e-4, 0.03),
}
# of one flight: what effects make and, last, measured minus base model (n, 6, k + 1) [m], [rad], not whitened; and what
# its own place, velocity, attitude and angular velocity may make (n, 6, 12)
Rows = tuple[Array, Array]


class CubeTosses(System):
    """Poses in free flight, two rows fewer than samples in each, then heights at rest, one row a toss."""

    base = ()

    def __init__(self, tosses: Sequence[Toss]) -> None:
        """Find the flights, measure their noise, whiten. Raises AnalysisError."""
        tosses, self.n_copies = without_copies(tosses)
        self.flights, self.n_left_out = flights(tosses)
        if len(self.flights) < 2 * HELD_OUT:
            raise AnalysisError(f"{len(self.flights)} free flights in {len(tosses)} tosses: 6 are needed at least.")
        self.cubes = resting(tosses, self.flights)
        made, at_rest = [flown(f) for f in self.flights], [rested(c) for c in self.cubes]
        self.names = tuple(
            dict.fromkeys([name for of in made for name in of] + [name for of in at_rest for name in of])
        )
        self.candidates = candidates(self.names)
        self._rows = [_rows(f, own, self.names) for f, own in zip(self.flights, made, strict=True)]
        self.noise = _measured_noise(self.flights, self._rows)
        blocks, toss, present = [], [], []
        for flight, rows in zip(self.flights, self._rows, strict=True):
            part = _whitened(flight, rows, self.noise)
            blocks += [part, np.zeros((1, *part.shape[1:]))]  # a row without data between two flights
            toss += [np.full(len(part) + 1, flight.number)]
            present += [np.full(len(part), 6.0), np.zeros(1)]
        still = _resting_rows(self.cubes, at_rest, self.names)
        everything = np.concatenate([*blocks, still])
        self._columns, self._left = everything[..., :-1], everything[..., -1]
        self._index = {name: i for i, name in enumerate(self.names)}
        self.weights = np.concatenate([*present, np.sum(np.any(still != 0, axis=-1), axis=1)])
        self.toss = np.concatenate([*toss, np.array([c.number for c in self.cubes], int)])
        self.time = np.arange(len(self.weights), dtype=float)  # only an order: tosses have no common clock

    def training_rows(self) -> Mask:
        """(n,) False for every third toss."""
        return np.asarray(self.toss % HELD_OUT != HELD_OUT - 1, bool)

    def linearise(self, values: Values, names: Sequence[str]) -> tuple[Array, Array]:
        """Whitened residual (n, 6), and the prediction's derivative (n, 6, k): linear in every quantity."""
        residual = self._left - self._columns @ np.array([values.get(n, 0.0) for n in self.names])
        return residual, self._columns[..., [self._index[n] for n in names]]

    def residuals(self, values: Values) -> list[Array]:
        """Measured minus predicted (n, 6) [m], [rad] of every flight, its own start and rates by least squares."""
        amounts = np.array([*(-values.get(n, 0.0) for n in self.names), 1.0])
        return [_cleared(rows @ amounts, own) for rows, own in self._rows]


def _side_by_side(made: Mapping[str, Iterable[float]], names: Sequence[str], nothing: Array) -> Array:
    return np.stack([np.asarray(made.get(name, nothing), float) for name in names], axis=-1)


def _resting_rows(
    cubes: Sequence[Resting], made: Sequence[Mapping[str, Iterable[float]]], names: Sequence[str]
) -> Array:
    """Whitened (m, 6, k + 1), three of the six used: height, normal (two).

    How much resting cubes differ once all candidates have taken their share is the noise.
    """
    found = np.zeros((len(cubes), 6, len(names) + 1))
    if len(cubes) < 4 * HELD_OUT:
        return found[:0]
    effects = np.array([_side_by_side(of, names, np.zeros(3)) for of in made])
    left = np.array([[c.height - HALF_WIDTH, *c.normal] for c in cubes])
    for i in range(3):
        A = effects[:, i][:, np.any(effects[:, i] != 0, axis=0)]
        rest = left[:, i] - A @ np.linalg.lstsq(A, left[:, i], rcond=1e-10)[0]
        sigma = np.sqrt(np.sum(rest**2) / (len(cubes) - A.shape[1]))
        found[:, i] = np.column_stack([effects[:, i], left[:, i]]) / sigma
    return found


def _rows(flight: Flight, made: Mapping[str, Array], names: Sequence[str]) -> Rows:
    falling = np.zeros_like(flight.position)
    falling[:, 2] = -GRAVITY * flight.time**2 / 2
    step, dt = np.swapaxes(flight.turning, 1, 2), flight.time[1] - flight.time[0]
    own = np.zeros((len(step), 6, 12))
    own[:, :3, :3], own[:, :3, 3:6] = np.eye(3), flight.time[:, None, None] * np.eye(3)
    own[:, 3:, 6:9], own[1:, 3:, 9:] = np.eye(3), np.cumsum(0.5 * (step[1:] + step[:-1]) * dt, axis=0)
    left = np.concatenate([flight.position - falling, flight.turn], axis=1)
    everything = np.concatenate([_side_by_side(made, names, np.zeros(left.shape)), left[..., None]], axis=-1)
    cleared = _cleared(everything, own)
    # rounding is left of an effect that the flight's own motion makes whole: no trace
    before, after = (np.linalg.norm(x, axis=(0, 1)) for x in (everything, cleared))
    everything = np.where(after > ABSORBED * before, everything, 0.0)
    everything[..., -1] = cleared[..., -1]
    return everything, own


def _cleared(left: Array, own: Array) -> Array:
    """Columns (n, 6, ...) without what the flight's own motion makes of them."""
    amounts = np.linalg.lstsq(own.reshape(-1, 12), left.reshape(-1, int(np.prod(left.shape[2:]))), rcond=None)[0]
    return np.asarray(left - (own @ amounts).reshape(left.shape), float)


def whitening_blind_to(basis: Array, covariance: Array) -> Array:
    """W (m - k, m) with W basis = 0 for a basis (m, k), and W covariance W^T = 1."""
    W = np.linalg.inv(np.linalg.cholesky(covariance))
    return np.asarray(np.linalg.qr(W @ basis, mode="complete")[0][:, basis.shape[1] :].T @ W, float)


def _whitened(flight: Flight, rows: Rows, noise: Mapping[str, SmoothNoise]) -> Array:
    """(n - 2, 6, k + 1) effects and residual of one flight, the residual last."""
    everything, own = rows
    n, _, k = everything.shape
    found = np.empty((n - 2, 6, k))
    for name, channels in GROUPS.items():
        c = list(channels)
        mine = own[:, c].reshape(-1, 12)
        K = np.kron(noise[name].covariance(flight.time), np.eye(len(c)))
        W = whitening_blind_to(mine[:, mine.any(axis=0)], np.asarray(K, float))
        found[:, c] = (W @ everything[:, c].reshape(-1, k)).reshape(n - 2, len(c), k)
    return found


def _measured_noise(flown: Sequence[Flight], rows: Sequence[Rows]) -> dict[str, SmoothNoise]:
    """Noise of each group of channels, from what is left when all candidates together have taken their share."""
    noise = dict(_START)
    for _ in range(2):
        parts = [_whitened(f, own, noise) for f, own in zip(flown, rows, strict=True)]
        whitened = np.concatenate(parts).reshape(-1, parts[0].shape[-1])
        length = np.linalg.norm(whitened[:, :-1], axis=0)
        scale = np.where(length > 0, length, 1.0)
        # normal equations: 50 columns of length one, of which some are alike by intention
        A = whitened[:, :-1] / scale
        amounts = np.linalg.pinv(A.T @ A, rcond=1e-10, hermitian=True) @ (A.T @ whitened[:, -1]) / scale
        left = [_cleared(everything @ np.array([*-amounts, 1.0]), own) for everything, own in rows]
        for name, channels in GROUPS.items():
            noise[name] = estimate(_by_length(flown, left, channels), noise[name])
    return noise


def _by_length(flown: Sequence[Flight], left: Sequence[Array], channels: Sequence[int]) -> list[SampleStretch]:
    """Flights of one length share instants, so that their samples stand side by side."""
    found = []
    for n in sorted({len(x) for x in left}):
        alike = [(f.time, x[:, list(channels)]) for f, x in zip(flown, left, strict=True) if len(x) == n]
        time = alike[0][0]
        values = np.concatenate([x for _, x in alike], axis=1)
        found.append(SampleStretch(time, values, np.column_stack([np.ones(n), time])))
    return found
