"""Which effect is missing from a set of differential equations? The loop of the disc, for any experiment.

    from disctrack.discrepancy.equations import Equations, Run, diagnose, terms

    pendulum = Equations({"th": "w", "w": "-stiffness*sin(th) - viscous*w"}, {"stiffness": 64.2, "viscous": 0.07})
    answer = diagnose(pendulum, [Run(time, {"th": angle})], [terms.coulomb("w"), terms.quadratic("w")])
    print(answer)
    answer.write("results")                     # diagnosis.json, diagnosis.html

`Equations` and `Term` take text or SymPy expressions; `Run` holds the samples of one motion. The guide with all of it
is disctrack/docs/systems.md.
"""

from disctrack.discrepancy.equations import terms as terms
from disctrack.discrepancy.equations.answer import Answer as Answer
from disctrack.discrepancy.equations.answer import Forecast as Forecast
from disctrack.discrepancy.equations.answer import RunScore as RunScore
from disctrack.discrepancy.equations.declared import Equations as Equations
from disctrack.discrepancy.equations.declared import Parameter as Parameter
from disctrack.discrepancy.equations.declared import Run as Run
from disctrack.discrepancy.equations.declared import Term as Term
from disctrack.discrepancy.equations.loop import diagnose as diagnose
from disctrack.discrepancy.noise import SmoothNoise as SmoothNoise
