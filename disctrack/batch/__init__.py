"""Many recordings: found, planned, measured side by side, summed up.

`plan` (which folders are recordings; each rig once, then one job per recording) -> `pool` (who works, what waits;
`measure` is what they do) -> `records` (kept beside the results) -> `columns`, `report` (of all).
`run` is the whole, and writes the summary. Results are judged by content: the hash of inputs, settings and version,
never by their mere existence.
"""

from disctrack.batch.plan import BatchOptions, find_recordings
from disctrack.batch.run import BatchOutcome, run_batch, summarise_batch

__all__ = ["BatchOptions", "BatchOutcome", "find_recordings", "run_batch", "summarise_batch"]
