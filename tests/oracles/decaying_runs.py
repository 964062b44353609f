"""Runs of one experiment with a closed form, of which many have to be taken together.

y(t) = a exp(-g t) + b, a and b of each run; the rate g is the disc's and the surface's. What may be missing: a term
c t exp(-g t), the air's, that goes with the root of its density; a hum, the rig's; a growth, the disc's.
"""

import numpy as np

from disctrack.discrepancy.fit import fit
from disctrack.discrepancy.joint.sharing import Member, Reduction
from disctrack.discrepancy.system import Candidate, Quantity
from tests.oracles.linear_system import Predicted

TIME = np.linspace(0.0, 3.0, 200)
SIGMA = 0.01
CONTACT, AIR, RIG, DISC = ("disc", "surface"), ("air",), ("rig",), ("disc",)


def one(name, belongs_to, **more):
    return (Quantity(name, "1", 0.01, belongs_to=belongs_to, typical=0.1, **more),)


class Decay(Predicted):
    def __init__(self, observed, density=1.0):
        self.root_density = density**0.5
        base = (Quantity("state.a", "1", 0.1), Quantity("state.b", "1", 0.1),
                Quantity("friction.g", "1/s", 0.01, null=1.0, belongs_to=CONTACT))  # fmt: skip
        candidates = (
            Candidate("drag", "drag", "motion", "drag of the air", "", one("drag.c", AIR, lower=0.0)),
            Candidate("hum", "hum", "measurement", "hum", "", (*one("hum.c", RIG), *one("hum.s", RIG))),
            Candidate("growth", "growth", "motion", "growth", "", one("growth.k", DISC)),
        )
        super().__init__(TIME, observed, base, candidates, SIGMA)

    def predicted(self, values):
        get, t = lambda n, default=0.0: values.get(n, default), TIME
        fall = np.exp(-get("friction.g", 1.0) * t)
        x = fall * (get("state.a") + t * self.root_density * get("drag.c")) + get("state.b") + get("growth.k") * t**2
        return x + get("hum.c") * np.cos(9 * t) + get("hum.s") * np.sin(9 * t)


class DecayMember:
    """As the recordings of the disc are to a crew."""

    def __init__(self, item):
        name, observed, labels, covariates, density = item
        self.system = Decay(observed, density)
        self.base = fit(self.system, self.system.base, {"state.a": 1.0, "state.b": 0.0, "friction.g": 1.0})
        candidates = self.system.candidates
        self.member = Member(name, self.system.base, candidates, self.base.values, len(TIME), labels, covariates)

    def share(self, own):
        self.reduction = Reduction(self.system, own, self.base.values)

    def reduce(self, values, names):
        return self.reduction.reduce(values, names)


def runs(rng, n, drag=0.0, rate=0.8, **changed):
    """(name, data, labels, covariates, density) of n runs; changed: run_3={"rate": 0.9, "mass": 2.0, ...}."""
    items = []
    for i in range(n):
        own = {"rate": rate, "drag": drag, "growth": 0.0, "hum": 0.0, "mass": 1.0, "density": 1.0}
        own |= changed.get(f"run_{i}", {})
        truth = {"state.a": 1 + 0.2 * rng.standard_normal(), "state.b": 0.1 * rng.standard_normal(),
                 "friction.g": own["rate"], "drag.c": own["drag"], "growth.k": own["growth"],
                 "hum.c": own["hum"]}  # fmt: skip
        clean = Decay(np.zeros_like(TIME), own["density"]).predicted(truth)
        labels = {"disc": f"{own['mass']:g} kg", "surface": "glass", "rig": "rig 1", "air": f"{own['density']:g}"}
        covariates = {"mass": own["mass"], "density": own["density"]}
        items.append((f"run {i}", clean + SIGMA * rng.standard_normal(len(TIME)), labels, covariates, own["density"]))
    return items


def fitted_at_once(items, extra=()):
    """Every quantity of every run in one least-squares problem, by SciPy: values and sigmas of g and `extra`, cost."""
    from scipy.optimize import least_squares

    systems = [Decay(data, density) for _, data, _, _, density in items]
    names = ["friction.g", *extra]

    def misfit(x):
        shared = dict(zip(names, x[: len(names)], strict=True))
        own = x[len(names) :].reshape(-1, 2)
        values = [shared | {"state.a": a, "state.b": b} for a, b in own]
        return np.concatenate([s.linearise(v, [])[0][:, 0] for s, v in zip(systems, values, strict=True)])

    start = np.concatenate([[1.0], np.zeros(len(extra)), np.tile([1.0, 0.0], len(items))])
    found = least_squares(misfit, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    k = len(names)
    return dict(zip(names, found.x[:k], strict=True)), np.sqrt(np.diag(covariance))[:k], 2 * found.cost
