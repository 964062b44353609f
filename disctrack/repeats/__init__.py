"""Repeats of one experiment side by side: aligned in time, their spread, averages of what was fitted to each.

As figure 4 and tables 2 and 3 of Ma et al. (2014), with what the paper leaves open: how much of the spread is the
measurement, and whether the trials agree.

    comparison = compare(paths)                  # analysed trajectory files; what cannot be used is listed
    written = write(comparison, folder)          # repeats.html, figures, tables as CSV, repeats.json
"""

from disctrack.repeats.compare import Comparison, LeftOut, RepeatGroup, compare
from disctrack.repeats.output import Written, write

__all__ = ["Comparison", "LeftOut", "RepeatGroup", "Written", "compare", "write"]
