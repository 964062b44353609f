"""Signs of life on stderr: a bar where there is work to count, a line with its time when a stage ends.

On a terminal a bar or the name of the stage stands there while it lasts and vanishes at its end. Where stderr is no
terminal (a log, a pipe) there are no bars, and the lines are the same.
"""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

from tqdm import tqdm


@contextlib.contextmanager
def progress_bar(what: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Function that is told how many more are done. The bar vanishes at the end; a line with the time stays.

    What is reported beyond the total is not shown.
    """
    began = time.perf_counter()
    with tqdm(total=total, desc=what, unit=f" {unit}", disable=None, leave=False) as bar:
        yield lambda n: bar.update(max(0, min(n, total - bar.n))) and None
    _tell(began, f"{what}: {total} {unit}{'' if total == 1 else 's'}")


@contextlib.contextmanager
def steps(what: str) -> Iterator[Callable[[str], None]]:
    """Name the stage and its age while it lasts (terminals only), and write a line with its time when it ends well.

    Yields a function that is told which step begins, for terminals to show with the stage's age.
    """
    began, over = time.perf_counter(), threading.Event()
    with tqdm(desc=what, bar_format="{desc} ... {elapsed}", disable=None, leave=False) as bar:

        def tick() -> None:
            while not over.wait(1.0):
                bar.refresh()

        ticking = threading.Thread(target=tick, daemon=True)
        ticking.start()
        try:
            yield lambda step: bar.set_description_str(f"{what}: {step}")
        finally:
            over.set()
            ticking.join()
    _tell(began, what)


@contextlib.contextmanager
def compiling(what: str, seconds: int) -> Iterator[None]:
    """Say on stderr what is compiled and for how long, as soon as the compiler begins; nothing where it is only loaded.

    seconds: of processor time that it took where it was measured.
    """
    from calibration.kit.compiled import one_at_a_time  # numba: those who call this have it, others need not wait

    began = time.perf_counter()
    told = f"compiling the inner loops of {what}: once per installation, about {seconds} s of a free core"
    said: list[str] = []

    def tell() -> None:
        if not said:
            print(told, file=sys.stderr, flush=True)
        said.append(told)

    with one_at_a_time(tell, what):
        yield
    if said:
        _tell(began, f"inner loops of {what} compiled")


def _tell(began: float, what: str) -> None:
    print(f"{time.perf_counter() - began:7.1f} s  {what}", file=sys.stderr, flush=True)
