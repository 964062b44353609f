"""The smallest size of each effect that the diagnosis finds, from how far it would stand out of the noise.

    python -m disctrack.diagnosis.trials.power --seeds 20

One fit per recording without any effect, and the derivatives by every effect there: what the initial state, k_m, the
calibration and the dots' biases leave of a planted effect is its noncentrality, and with the threshold of the search
that gives the probability of a claim. Held against trials with refits and free runs by `trials.rates --factor`.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from calibration.kit.arrays import Array
from disctrack.diagnosis import DiscSystem, Settings
from disctrack.diagnosis.model_file import PAPER, declared_model
from disctrack.diagnosis.trials.hidden_effects import HIDDEN_EFFECTS, HiddenEffect, Planted
from disctrack.diagnosis.trials.rates import FRAME_RATE, draw, trajectory_of
from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.score import Linearisation

FARTHEST = 1e4  # times the effect's size, beyond which nothing is looked for


@dataclass(frozen=True)
class Power:
    """How well one effect is seen in recordings drawn at random."""

    effect: HiddenEffect
    standing_out: Array  # (n,) root of the noncentrality at the effect's size: sigmas, all samples together
    exponent: float  # standing out grows with the size to this power
    threshold: float  # chi-square above which it is claimed
    degrees: int

    def probability(self, size: float) -> float:
        """That an effect of this size is claimed, over the recordings."""
        noncentrality = (self.standing_out * (size / self.effect.size) ** self.exponent) ** 2
        certain = 100.0 * self.threshold  # far beyond it the distribution's series fails
        return float(np.mean(stats.ncx2.sf(self.threshold, self.degrees, np.clip(noncentrality, 1e-12, certain))))

    def smallest(self, share: float) -> float:
        """Size that is claimed in this share of the recordings; infinite where none is."""
        lost = lambda log_size: self.probability(float(np.exp(log_size))) - share  # noqa: E731
        low, high = np.log(self.effect.size / FARTHEST), np.log(self.effect.size * FARTHEST)
        if lost(high) < 0:
            return float("inf")
        return float(np.exp(brentq(lost, low, high, xtol=1e-3)))


def power(effects: Sequence[HiddenEffect], seeds: Sequence[int], rate: float = FRAME_RATE) -> list[Power]:
    """Of every effect, over recordings with these seeds."""
    settings = Settings()
    found: list[list[float]] = [[] for _ in effects]
    exponents, degrees, number = np.ones(len(effects)), np.ones(len(effects), int), 1
    for seed in seeds:
        recording = draw(seed, Planted({}), rate)
        trajectory = trajectory_of(recording, Planted({}))
        system = DiscSystem(trajectory, declared_model(trajectory, PAPER).model)
        base = fit(system, system.base, system.start())
        linear = Linearisation(system, base, system.candidates)
        number = len(system.candidates)
        for i, effect in enumerate(effects):
            planted = [effect.plant(s * effect.size, np.random.default_rng([seed, 34])) for s in (1.0, 0.5)]
            signals = [_signal(linear, dict(p.truth)) for p in planted]
            found[i].append(signals[0])
            exponents[i] = np.log2(signals[0] / signals[1]) if signals[1] > 0 and effect.size != 0 else 1.0
            degrees[i] = next(len(c.names) for c in system.candidates if set(planted[0].truth) <= set(c.names))
    thresholds = stats.chi2.isf(settings.false_alarm / number, degrees)
    return [
        Power(e, np.array(s), max(float(x), 1.0), float(t), int(k))
        for e, s, x, t, k in zip(effects, found, exponents, thresholds, degrees, strict=True)
    ]


def _signal(linear: Linearisation, truth: dict[str, float]) -> float:
    """Norm of the residual that the planted values leave once everything fitted has taken its share."""
    amount = np.array([v - linear.quantities[k].null for k, v in truth.items()])
    return float(np.linalg.norm(linear.cleared((linear.columns(list(truth)) @ amount)[:, None])))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m disctrack.diagnosis.trials.power", description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="recordings (%(default)s)")
    parser.add_argument("--frame-rate", type=float, default=FRAME_RATE, help="in Hz (%(default)s)")
    arguments = parser.parse_args()
    visible = [e for e in HIDDEN_EFFECTS if e.visible]
    print("| effect | unit | size | stands out at it | found in half | in nine of ten |\n" + "|---" * 6 + "|")
    for p in power(visible, range(1, 1 + arguments.seeds), arguments.frame_rate):
        low, middle, high = np.quantile(p.standing_out, [0.1, 0.5, 0.9])
        print(
            f"| {p.effect.name} | {p.effect.unit} | {p.effect.size:.3g} | {low:.3g} / {middle:.3g} / {high:.3g} "
            f"| {p.smallest(0.5):.2g} | {p.smallest(0.9):.2g} |"
        )


if __name__ == "__main__":
    main()
