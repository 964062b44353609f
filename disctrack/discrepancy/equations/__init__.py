"""Which effect is missing from a set of differential equations? The loop of the disc, for any experiment.

    from disctrack.discrepancy.equations import Equations, Run, diagnose, terms

    pendulum = Equations({"th": "w", "w": "-stiffness*sin(th) - viscous*w"}, {"stiffness": 64.2, "viscous": 0.07})
    answer = diagnose(pendulum, [Run(time, {"th": angle})], [terms.coulomb("w"), terms.quadratic("w")])
    print(answer)
    answer.write("results")                     # diagnosis.json, diagnosis.html

`Equations` and `Term` take text or SymPy expressions; `Run` holds the samples of one motion. The guide with all of it
is disctrack/docs/systems.md.
"""

from disctrack.discrepancy.equations import terms
from disctrack.discrepancy.equations.answer import Answer, diagnose
from disctrack.discrepancy.equations.declared import Equations, Parameter, Run, Term
from disctrack.discrepancy.equations.forecast import Forecast, RunScore
from disctrack.discrepancy.noise import SmoothNoise

__all__ = [
    "Answer",
    "Equations",
    "Forecast",
    "Parameter",
    "Run",
    "RunScore",
    "SmoothNoise",
    "Term",
    "diagnose",
    "terms",
]
