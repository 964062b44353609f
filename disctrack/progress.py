"""Progress on stderr: a bar for countable work, and a line with its duration at the end of a stage.

On a terminal, a bar or the name of the stage is shown until its end. If stderr is no terminal (a log, a pipe) there are
no bars; the lines are the same.
"""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

from tqdm import tqdm


@contextlib.contextmanager
def progress_bar(what: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Yields a function to be called with the number of further units done; at the end prints a line with the time.

    Units beyond the total are not shown.
    """
    began = time.perf_counter()
    with tqdm(total=total, desc=what, unit=f" {unit}", disable=None, leave=False) as bar:
        yield lambda n: bar.update(max(0, min(n, total - bar.n))) and None
    _print_duration(began, f"{what}: {total} {unit}{'' if total == 1 else 's'}")


@contextlib.contextmanager
def steps(what: str) -> Iterator[Callable[[str], None]]:
    """Show the stage (terminals only), and print a line with its duration if it succeeds.

    Yields a function to be called with the name of each step, which terminals show as well.
    """
    began = time.perf_counter()
    with tqdm(desc=what, bar_format="{desc} ...", disable=None, leave=False) as bar:
        yield lambda step: bar.set_description_str(f"{what}: {step}")
    _print_duration(began, what)


@contextlib.contextmanager
def compiling(what: str, seconds: int) -> Iterator[None]:
    """Print on stderr what is compiled and for how long, when the compiler starts; nothing if the cache is loaded.

    seconds : estimate of the processor time
    """
    from calibration.kit.compiled import one_at_a_time  # late, as it imports numba

    began = time.perf_counter()
    message = f"compiling the inner loops of {what}: once per installation, about {seconds} s of a free core"
    printed: list[str] = []

    def announce() -> None:
        if not printed:
            print(message, file=sys.stderr, flush=True)
        printed.append(message)

    with one_at_a_time(announce, what):
        yield
    if printed:
        _print_duration(began, f"inner loops of {what} compiled")


def _print_duration(began: float, what: str) -> None:
    print(f"{time.perf_counter() - began:7.1f} s  {what}", file=sys.stderr, flush=True)
