"""Plant, measure, compare: how good are poses and diagnosis where the truth is known?

A case is a recording with something planted and a seed: rendered (`rendered`) or as points (`points`, with effects of
`hidden`). It is measured (`render_and_measure`; `hide`), compared with the truth (`errors`, `accuracy`; `diagnoses`),
and summed up in a `Validation` of tables, for which there is one writer (`tables`). Only the truth and the reported
numbers enter a judgement, never how the measurement is done.
"""
