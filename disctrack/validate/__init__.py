"""Plant, measure, compare: how good are poses and diagnosis where the truth is known, and is a fault noticed?

A case is a recording with something planted and a seed: rendered (`rendered`), as points (`points`, with effects of
`hidden`), or with a fault in its files (`planted_faults`). It is measured (`render_and_measure`, `Verdict`,
`plant_and_run`), compared with the truth (`errors`, `accuracy`, `diagnoses`), and summed up in a `Validation` of
tables, for which there is one writer (`tables`). Only the truth and the reported numbers enter a judgement, never how
the measurement is done.
"""
