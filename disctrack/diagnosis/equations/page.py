"""The answer on one HTML page that needs nothing else."""

from __future__ import annotations

import base64
import io
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import signal

from disctrack.analyse.figures import BLUE, GRID, INK, MUTED, RED

if TYPE_CHECKING:
    from disctrack.diagnosis.equations.answer import Answer

_STYLE = """body{font:16px/1.5 system-ui,sans-serif;color:#1d2733;background:#fff;margin:0}
main{max-width:60rem;margin:0 auto;padding:1.5rem}h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}
.lead{font-size:1.1rem;border-left:4px solid #1f6f8b;padding-left:.8rem}table{border-collapse:collapse;width:100%}
th,td{text-align:left;padding:.25rem .6rem;border-bottom:1px solid #e3e8ed;font-variant-numeric:tabular-nums}
img{max-width:100%}figcaption{color:#6b7885;font-size:.9rem}figure{margin:1rem 0}.wide{overflow-x:auto}"""
_MOST_POINTS = 6000  # of a curve: a page shows no more


def page(answer: Answer) -> str:
    """The whole page."""
    d = answer.diagnosis
    title = escape(f"{answer.equations.name}: what is missing?")
    equations = "".join(f"<li>d{escape(k)}/dt = {escape(str(v))}</li>" for k, v in answer.equations.rates.items())
    notes = "".join(f"<p>{escape(n[:1].upper() + n[1:])}.</p>" for n in answer.notes)
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head>'
        f"<body><main><h1>{title}</h1><p class=lead>{escape(answer.sentence)}</p>"
        f"<p>Verdict: <b>{escape(d.verdict)}</b>. {escape(d.reason[:1].upper() + d.reason[1:])}.</p>"
        f"<ul>{equations}</ul>{notes}{_numbers(answer)}{_pictures(answer)}{_tried(answer)}</main></body></html>\n"
    )


def _table(head: list[str], rows: list[list[str]]) -> str:
    top = "".join(f"<th>{escape(h)}" for h in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(x)}" for x in row) + "</tr>" for row in rows)
    return f"<div class=wide><table><tr>{top}</tr>{body}</table></div>"


def _numbers(answer: Answer) -> str:
    d = answer.diagnosis
    rows = []
    for c in answer.system.formulas.channels:
        b, a = answer.before[c], answer.after[c]
        unit = answer.equations.units.get(c, "1")
        rows.append([f"rms of {c} [{unit}]", f"{b.rms:.4g}", f"{a.rms:.4g}", f"{a.noise:.4g}"])
        rows.append([f"free run of {c}, held out [{unit}]", f"{b.held_out:.4g}", f"{a.held_out:.4g}", ""])
    rows.append(["chi-square per degree of freedom", *(f"{f.reduced_chi_square / d.noise:.4g}" for f in (d.before, d.after)), "1"])  # fmt: skip
    rows.append(["Ljung-Box: probability of so much memory in noise", "", f"{answer.whiteness:.2g}", ""])
    values = []
    for q in d.after.quantities:
        if not q.name.startswith("state."):
            old = f"{d.before.values[q.name]:.6g} +- {d.before.sigma(q.name):.2g}" if q.name in d.before.names else ""
            values.append([q.name, old, f"{d.after.values[q.name]:.6g} +- {d.after.sigma(q.name):.2g}", q.unit])
    return (
        "<h2>Before and after</h2>" + _table(["", "before", "after", "noise"], rows)
        + "<h2>Fitted numbers</h2>" + _table(["", "before", "after", "unit"], values)
    )  # fmt: skip


def _tried(answer: Answer) -> str:
    rows = [
        [t.candidate.name, t.candidate.title, f"{t.score:.4g}", "" if t.gain is None else f"{t.gain:.4g}",
         "" if t.held_out_gain is None else f"{t.held_out_gain:.4g}", t.reason]
        for t in answer.diagnosis.tried
    ]  # fmt: skip
    return "<h2>What was tried</h2>" + _table(["term", "", "score", "refitted", "held out", "outcome"], rows)


def _pictures(answer: Answer) -> str:
    """Data and model, and what is left in time and frequency, channel by channel: the first stretches."""
    before, after = answer.predicted(answer.diagnosis.before), answer.predicted(answer.diagnosis.after)
    found = []
    with rc_context({"font.size": 10}):
        for c, name in enumerate(answer.system.formulas.channels):
            unit = answer.equations.units.get(name, "")
            figure = Figure(figsize=(9, 7), layout="constrained")
            top, middle, bottom = figure.subplots(3, 1)
            for i, ((s, old), (_, new)) in enumerate(zip(before[:6], after[:6], strict=True)):
                thin = max(1, len(s.time) // _MOST_POINTS)
                t = s.time[::thin]
                first = i == 0
                top.plot(t, s.data[::thin, c], ".", ms=2, color=MUTED, label="measured" if first else None)
                for seen, colour, label in ((old, RED, "before"), (new, BLUE, "after")):
                    left = s.data[:, c] - seen[:, c]
                    top.plot(t, seen[::thin, c], lw=0.9, color=colour, label=label if first else None)
                    middle.plot(t, left[::thin], lw=0.8, color=colour, label=label if first else None)
                    if first and np.isfinite(left).sum() > 64:
                        rate = (len(s.time) - 1) / (s.time[-1] - s.time[0])
                        f, power = signal.periodogram(np.nan_to_num(left), rate)
                        bottom.loglog(f[1:], np.sqrt(power[1:]), lw=0.7, color=colour, label=label)
            top.set(ylabel=f"{name} {f'[{unit}]' if unit else ''}", title=f"{name}: measured and modelled")
            middle.set(ylabel="measured - model", xlabel="time [s]")
            middle.set_yscale("symlog", linthresh=max(3 * answer.after[name].noise, 1e-12))
            bottom.set(xlabel="frequency [Hz]", ylabel="residual per root Hz")
            for axes in (top, middle, bottom):
                _dress(axes)
            found.append(_embedded(figure, f"{name}: measured, modelled, and what is left before and after"))
    return "".join(found)


def _dress(axes: Axes) -> None:
    axes.grid(True, color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=9)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=8)


def _embedded(figure: Figure, caption: str) -> str:
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    source = base64.b64encode(buffer.getvalue()).decode()
    return f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{source}"><figcaption>{escape(caption)}</figcaption></figure>'
