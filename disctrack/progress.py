"""Progress bars on stderr, silent where stderr is not a terminal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from tqdm import tqdm


@contextlib.contextmanager
def progress_bar(what: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Function that is told how many more are done; the bar vanishes at the end."""
    with tqdm(total=total, desc=what, unit=f" {unit}", disable=None, leave=False) as bar:
        yield lambda n: bar.update(n) and None
