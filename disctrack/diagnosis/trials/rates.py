"""How often does the diagnosis find, name and size what is hidden, and how often does it cry wolf?

    python -m disctrack.diagnosis.trials.rates --seeds 8 --controls 60 -o rates.json
    python -m disctrack.diagnosis.trials.rates kz=1e-7 table_tilt=3e-5

Every trial draws a motion, a rig with a calibration error of its own, and the noise of the dots; plants an effect
(`hidden_effects`); and hands the measured trajectory, which does not tell of it, to the diagnosis.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy import stats

from disctrack.diagnosis import DiscDiagnosis, diagnose_trajectory
from disctrack.diagnosis.trials.hidden_effects import HIDDEN_EFFECTS, HiddenEffect, Planted, hidden_effect
from disctrack.diagnosis.trials.recordings import Unseen, measured
from disctrack.discrepancy.fit import Fit, fit
from disctrack.discrepancy.significance import wald
from disctrack.discrepancy.system import Values
from disctrack.errors import DiscTrackError
from disctrack.files.json_text import json_file
from disctrack.files.whole import write_whole
from disctrack.rolling import Model, simulate, steady_precession
from disctrack.synthetic.description import Faults, Scene
from disctrack.trajectory import Trajectory

FRAME_RATE = 1000.0  # [Hz] of the reference recordings
DURATION = (0.4, 0.9)  # [s]
THETA_DEG = (3.0, 15.0)
NUTATION_SHARE = (0.02, 0.1)  # of the nutation angle
OMEGA3 = (-2.0, 3.0)  # [rad/s]
K_M = (0.2e-7, 0.5e-7)  # [m s^2]
FLATTEST_DEG = 0.9  # the last frame's nutation: below, the disc touches its paper
DRAWS = 200
ENOUGH = 3.0  # [sigma] a coefficient may be off
AT_NOISE, HELD_OUT = 1.1, 1.2  # reduced chi-square, free run over its floor


@dataclass(frozen=True)
class Filmed:
    """What is filmed, before anything is planted."""

    seed: int
    n: int
    theta_deg: float
    nutation_deg: float
    omega3: float
    k_m: float
    rate: float  # [Hz]


@dataclass(frozen=True)
class Verdict:
    """What became of one hidden effect, or of none."""

    hidden: tuple[str, ...]
    size: tuple[float, ...]
    recording: Filmed
    verdict: str
    sentence: str
    found: tuple[str, ...]  # every effect claimed, its class after it in brackets
    named: bool  # every hidden effect is among those claimed, or in the class of one
    first: bool  # and is the claim itself, not only in its class
    pull: float  # largest error of a coefficient in its sigmas; NaN where it is not named
    extra: int  # claims beyond those hidden
    chi_square_before: float
    chi_square_after: float
    free_run_before: float
    free_run_after: float
    gain: float  # of chi-square by all effects claimed
    seconds: float
    stands_out: float  # of the hidden effects the least, in sigmas, with all others fitted beside it; NaN: not known
    needed: float  # sigmas that a claim takes

    @property
    def can_be_told(self) -> bool:
        """Does the recording determine every hidden effect beside the others, so that it may be asked for?

        What stands out by less than a claim takes leaves a bound only, whoever looks.
        """
        return not self.stands_out < self.needed

    @property
    def at_noise(self) -> bool:
        """Is what is left noise, in the fit and in the free run?"""
        return self.chi_square_after <= AT_NOISE and self.free_run_after <= HELD_OUT

    @property
    def within(self) -> bool:
        """Are the coefficients right within three sigma?"""
        return self.named and abs(self.pull) <= ENOUGH


def draw(seed: int, planted: Planted, rate: float = FRAME_RATE) -> Filmed:
    """A motion that lasts as long as it is filmed, whatever is planted in it."""
    rng = np.random.default_rng([seed, 31])
    disc = Scene().declared_disc
    for _ in range(DRAWS):
        theta = float(rng.uniform(*THETA_DEG))
        recording = Filmed(
            seed,
            int(rate * rng.uniform(*DURATION)),
            theta,
            theta * float(rng.uniform(*NUTATION_SHARE)),
            float(rng.uniform(*OMEGA3)),
            float(rng.uniform(*K_M)),
            rate,
        )
        model = Model(disc).with_values({"km.k_m": recording.k_m} | dict(planted.effects))
        try:
            start = steady_precession(
                np.radians(theta),
                disc,
                omega3=recording.omega3,
                nutation_amplitude=np.radians(recording.nutation_deg),
            )
            motion = simulate(model, start, duration=1.03 * recording.n / rate + 0.01, rate=rate)
        except DiscTrackError:  # no such precession
            continue
        if len(motion) > 1.02 * recording.n and motion.q[-1, 4] > np.radians(FLATTEST_DEG):
            return recording
    raise DiscTrackError(f"no motion of {DURATION[0]} s among {DRAWS} drawn: what is planted stops the disc at once")


def together(planted: Sequence[Planted]) -> Planted:
    """Several at once; of faults that exclude each other the last one holds."""
    faults, unseen = Faults(), Unseen()
    for p in planted:
        faults = replace(faults, **_changed(p.faults, Faults()))
        unseen = replace(unseen, **_changed(p.unseen, Unseen()))
    merged = lambda kind: {k: v for p in planted for k, v in getattr(p, kind).items()}  # noqa: E731
    return Planted(merged("truth"), merged("effects"), faults, unseen)


def _changed(a: Faults | Unseen, null: Faults | Unseen) -> dict[str, Any]:
    return {f.name: getattr(a, f.name) for f in fields(a) if getattr(a, f.name) != getattr(null, f.name)}


def trajectory_of(recording: Filmed, planted: Planted, n: int | None = None, rig_seed: int | None = None) -> Trajectory:
    """The measured trajectory, of its first `n` frames if given.   rig_seed : as `measured`"""
    return measured(
        planted.effects,
        faults=planted.faults,
        unseen=planted.unseen,
        seed=recording.seed,
        n=n or recording.n,
        theta_deg=recording.theta_deg,
        nutation_deg=recording.nutation_deg,
        omega3=recording.omega3,
        declared_rate=recording.rate,
        base={"km.k_m": recording.k_m},
        rig_seed=rig_seed,
    )


def trial(effects: Sequence[HiddenEffect], sizes: Sequence[float], seed: int, rate: float = FRAME_RATE) -> Verdict:
    """Hide, diagnose, compare."""
    rng: Generator = np.random.default_rng([seed, 32])
    parts = [e.plant(size, rng) for e, size in zip(effects, sizes, strict=True)]
    planted = together(parts)
    recording = draw(seed, planted, rate)
    trajectory = trajectory_of(recording, planted)
    began = time.perf_counter()
    result = diagnose_trajectory(trajectory, separate=False)
    seconds = time.perf_counter() - began
    answers = [_sized(result, p) for p in parts]
    d = result.diagnosis
    nan = float("nan")
    return Verdict(
        tuple(e.name for e in effects),
        tuple(sizes),
        recording,
        d.verdict,
        result.sentence,
        tuple(f.candidate.name + _class_text([r.candidate.name for r in f.cannot_be_told_from]) for f in d.found),
        all(a is not None for a in answers),
        all(a is not None and a[1] for a in answers),
        max((a[0] for a in answers if a is not None), default=nan),
        max(len(d.found) - len(effects), 0),
        result.before.reduced_chi_square if result.before else nan,
        result.after.reduced_chi_square if result.after else nan,
        result.before.ratio_to_floor if result.before else nan,
        result.after.ratio_to_floor if result.after else nan,
        (d.before.cost - d.after.cost) / d.noise,
        seconds,
        *_standing_out(result, parts),
    )


def _standing_out(result: DiscDiagnosis, parts: Sequence[Planted]) -> tuple[float, float]:
    """By how many sigmas the least of the planted effects stands out of the joint model, and how many a claim takes.

    Fisher's information at the truth: the gain is a' C^-1 a for amounts a with covariance C, all else fitted along, the
    other planted effects, too. NaN where the joint model has no fit, or the catalogue no such numbers.
    """
    system, d = result.system, result.diagnosis
    nan = float("nan")
    own = [next((c for c in system.candidates if set(p.truth) <= set(c.names)), None) for p in parts]
    if not parts or not d.before.converged or None in own:
        return nan, nan
    quantities = {q.name: q for q in system.base} | {q.name: q for c in own if c for q in c.quantities}
    truth = {k: v for p in parts for k, v in (*p.effects.items(), *p.truth.items())}
    joint = fit(system, tuple(quantities.values()), d.before.values | truth)
    if not joint.converged:
        return nan, nan
    found = []
    for part, candidate in zip(parts, own, strict=True):
        assert candidate is not None
        index = [joint.names.index(n) for n in candidate.names]
        amount = np.array([part.truth.get(q.name, q.null) - q.null for q in candidate.quantities])
        sigmas = float(np.sqrt(wald(amount, joint.covariance[np.ix_(index, index)]) / d.noise))
        needed = stats.chi2.isf(d.settings.false_alarm / max(len(system.candidates), 1), len(index))
        found.append((sigmas, float(np.sqrt(needed))))
    return min(found, key=lambda one: one[0] / one[1])


def _class_text(names: Sequence[str]) -> str:
    return f" ({', '.join(names)})" if names else ""


def _sized(result: DiscDiagnosis, planted: Planted) -> tuple[float, bool] | None:
    """Largest pull of the planted values where the effect, or a class that holds it, is claimed; was it the claim?"""
    truth = planted.truth
    matches = []
    for found in result.diagnosis.found:
        if set(truth) <= set(found.candidate.names):
            matches.append((_pull(result.diagnosis.after, truth), True))
        for rival in found.cannot_be_told_from:
            if set(truth) <= set(rival.candidate.names):
                matches.append((_pull(rival.fit, truth), False))
    # two claims may have it in their classes: it is in the place of one of them that it fits
    return min(matches, key=lambda match: (not match[1], match[0]), default=None)


def _pull(fit: Fit, truth: Values) -> float:
    return max(abs(fit.values[k] - v) / max(fit.sigma(k), 1e-300) for k, v in truth.items())


@dataclass(frozen=True)
class Rates:
    """Of one effect at one size."""

    hidden: tuple[str, ...]
    size: tuple[float, ...]
    n: int
    can_be_told: int  # trials in which the recording determines all that is hidden
    named: int
    named_of_those: int
    within: int
    at_noise: int
    extra: int  # trials with a claim too many
    sigmas: float  # median of the chi-square gained over the degrees of the data, as a root: sigma per sample is less
    verdicts: tuple[Verdict, ...]


def rates(
    effects: Sequence[HiddenEffect], sizes: Sequence[float], seeds: Sequence[int], rate: float = FRAME_RATE
) -> Rates:
    """Over several recordings."""
    verdicts = tuple(trial(effects, sizes, seed, rate) for seed in seeds)
    return Rates(
        tuple(e.name for e in effects),
        tuple(sizes),
        len(verdicts),
        sum(v.can_be_told for v in verdicts),
        sum(v.named for v in verdicts),
        sum(v.named and v.can_be_told for v in verdicts),
        sum(v.within for v in verdicts),
        sum(v.at_noise for v in verdicts),
        sum(v.extra > 0 for v in verdicts),
        float(np.median([np.sqrt(max(v.gain, 0.0)) for v in verdicts])),
        verdicts,
    )


def line(r: Rates) -> str:
    """One row of the table."""
    what = " + ".join(r.hidden) or "nothing"
    sizes = " + ".join(f"{s:.3g}" for s in r.size) or "-"
    share = lambda k: f"{k}/{r.n}"  # noqa: E731
    seconds = np.median([v.seconds for v in r.verdicts])
    return (
        f"| {what} | {sizes} | {share(r.can_be_told)} | {share(r.named)} | {share(r.within)} | {share(r.at_noise)} "
        f"| {share(r.extra)} "
        f"| {r.sigmas:.3g} | {seconds:.1f} s |"
    )


COLUMNS = ("hidden", "size", "can be told", "named", "within 3 sigma", "noise left", "claim too many", "sigmas", "time")
HEADER = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m disctrack.diagnosis.trials.rates", description=__doc__)
    parser.add_argument("effects", nargs="*", metavar="EFFECT[=SIZE]", help="effects to hide (default: all)")
    parser.add_argument("--seeds", type=int, default=6, help="recordings per effect (%(default)s)")
    parser.add_argument("--first-seed", type=int, default=1, help="the others count up from it")
    parser.add_argument("--controls", type=int, default=0, help="recordings in which nothing is hidden")
    parser.add_argument("--pairs", type=int, default=0, help="recordings in which two effects are hidden")
    parser.add_argument("--frame-rate", type=float, default=FRAME_RATE, help="in Hz (%(default)s)")
    parser.add_argument("--factor", type=float, default=1.0, help="on all sizes")
    parser.add_argument("-v", "--verbose", action="store_true", help="say what was claimed where something was wrong")
    parser.add_argument("-o", "--output", type=Path, help="JSON file with every trial")
    return parser.parse_args()


def _pairs(effects: Sequence[HiddenEffect], number: int, seed: int) -> Iterator[tuple[HiddenEffect, HiddenEffect]]:
    rng = np.random.default_rng([seed, 33])
    for _ in range(number):
        a, b = rng.choice(len(effects), 2, replace=False)
        yield effects[int(a)], effects[int(b)]


def _at_size(text: str) -> HiddenEffect:
    name, _, size = text.partition("=")
    effect = hidden_effect(name)
    return replace(effect, size=float(size)) if size else effect


def _jobs(a: argparse.Namespace) -> Iterator[Rates]:
    seeds = range(a.first_seed, a.first_seed + a.seeds)
    effects = [_at_size(text) for text in a.effects] or list(HIDDEN_EFFECTS)
    if a.controls:
        yield rates([], [], range(a.first_seed, a.first_seed + a.controls), a.frame_rate)
    if a.pairs:
        visible = [e for e in effects if e.visible]
        for number, pair in enumerate(_pairs(visible, a.pairs, a.first_seed)):
            yield rates(pair, [a.factor * e.size for e in pair], [a.first_seed + number], a.frame_rate)
    if not (a.controls or a.pairs) or a.effects:
        for effect in effects if not a.pairs else ():
            yield rates([effect], [a.factor * effect.size], seeds, a.frame_rate)


def _wrong(v: Verdict) -> bool:
    return (
        bool(v.found or v.verdict != "nothing missing")
        if not v.hidden
        else not (v.within and v.at_noise) or v.extra > 0
    )


def main() -> None:
    """Run the trials that the command line asks for, print the table, write the trials."""
    arguments = _arguments()
    done: list[Rates] = []
    print(HEADER, flush=True)
    for r in _jobs(arguments):  # one after the other: a long run shows what it has
        done.append(r)
        print(line(r), flush=True)
        if arguments.verbose:
            for v in filter(_wrong, r.verdicts):
                print(
                    f"    seed {v.recording.seed} ({v.recording.theta_deg:.1f} deg, {v.recording.n}): {v.verdict}; "
                    f"{'; '.join(v.found) or '-'}; pull {v.pull:.1f}, chi2 {v.chi_square_before:.3f} -> "
                    f"{v.chi_square_after:.3f}, free run {v.free_run_before:.2f} -> {v.free_run_after:.2f}, "
                    f"stands out by {v.stands_out:.1f} sigma of {v.needed:.1f}, {v.seconds:.1f} s",
                    flush=True,
                )
    told = [r for r in done if r.hidden]
    if told:
        counts = [sum(getattr(r, name) for r in told) for name in ("n", "can_be_told", "named", "named_of_those")]
        print("named {2} of {0}; {3} of {1} that their recordings determine".format(*counts))
    if arguments.output:
        write_whole(arguments.output, json_file([asdict(r) for r in done]))


if __name__ == "__main__":
    try:
        main()
    except DiscTrackError as error:
        raise SystemExit(f"disctrack: {error}") from None
