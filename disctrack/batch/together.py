"""All recordings of a batch diagnosed together, once they are measured."""

from collections.abc import Sequence
from pathlib import Path

from disctrack.batch.columns import Row
from disctrack.batch.reasons import reason_of
from disctrack.report.terminal import short

FOLDER = "together"


def diagnose_all(folder: Path, rows: Sequence[Row], processes: int) -> tuple[list[str], str]:
    """One diagnosis of all measured trajectories, into a folder beside the summary, unless it is there already.

    returns : what it says, and why there is none although it was wanted; empty otherwise
    """
    from disctrack.diagnosis.together.stage import run_together  # draws figures: only where they are wanted

    trajectories = [folder / row["trajectory"] for row in rows if row["trajectory"]]
    if len(trajectories) < 2:
        return [], f"together: {len(trajectories)} of the recordings measured; it takes two or more"
    try:
        report = run_together(trajectories, folder / FOLDER, overwrite=True, reuse=True, processes=processes)
    except Exception as error:  # the single results are worth more than their combination
        return [], f"the recordings could not be diagnosed together: {reason_of(error)}"
    return short(report), ""
