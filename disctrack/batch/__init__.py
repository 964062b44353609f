"""Measurement of many recordings in parallel, with a summary.

`plan` (finds recordings; one job per rig, then one per recording) -> `pool` (distributes the jobs to processes;
`measure` does one job) -> `records` (stored with the results) -> `columns`, `report` (of all recordings).
`run` does all of this and writes the summary. Results are reused if the hash of inputs, settings and version is equal,
not because they exist.
"""

from disctrack.batch.plan import BatchOptions, find_recordings
from disctrack.batch.run import BatchOutcome, run_batch, summarise_batch

__all__ = ["BatchOptions", "BatchOutcome", "find_recordings", "run_batch", "summarise_batch"]
