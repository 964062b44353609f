"""Validation with known truth: accuracy of poses, power of the diagnosis, detection of faults.

A case is a recording with a seed and a planted effect or fault: rendered (`rendered`), as points (`points`, with
effects of `hidden`), or with a fault in its files (`planted_faults`). It is measured (`render_and_measure`, `Verdict`,
`plant_and_run`), compared with the truth (`rendered`, `accuracy`, `hidden`), and summarised in a `Validation` with
tables, which `tables` writes. A judgement uses only the truth and the reported numbers, not the method of measurement.
"""
