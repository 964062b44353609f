# PYTHON_ARGCOMPLETE_OK
"""The command line, which runs the stages and converts errors to a line and an exit code.

A subcommand is a line in COMMANDS, its arguments in `disctrack.commands.options`, and a module of its name in
`disctrack.commands` with `run(arguments) -> exit code`, or None for DONE; it is imported only when it is called.
"""

import argparse
import importlib
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from warnings import catch_warnings, simplefilter

from disctrack.commands import DONE, FAILED, INCOMPLETE, INTERNAL, USAGE, options
from disctrack.files.software import __version__
from disctrack.files.text import printable
from disctrack.findings import DoubtWarning

# The matrices are small: threads of the linear algebra wait for each other, up to ten times longer than they save. Set
# before numpy is loaded; a setting of the user is kept.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# A damaged image is reported once, with file and frame, and not in the log of the decoder.
os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")

# In the order of the measurement: name -> (arguments, summary).
COMMANDS: dict[str, tuple[Callable[[argparse.ArgumentParser], None], str]] = {
    "sample": (options.add_sample, "a small recording with known truth, to try the other commands on"),
    "init": (options.add_init, "folder of frames -> a commented recording.toml"),
    "print": (options.add_print, "declared dots and board -> PDF to print, true to scale"),
    "check": (options.add_check, "problems that a run would meet, within seconds"),
    "run": (options.add_run, "calibrate and track a recording: folder in, trajectory and pictures out"),
    "calibrate": (options.add_calibrate, "views of a chessboard -> stereo rig with covariance"),
    "track": (options.add_track, "recording and rig -> trajectory with covariance"),
    "analyse": (options.add_analyse, "trajectory -> velocities, contact, energy, scaling laws and a report"),
    "diagnose": (options.add_diagnose, "trajectory -> which effect the model lacks, before and after"),
    "batch": (options.add_batch, "many recordings side by side: a report of each, and one summary"),
    "open": (options.add_open, "the page of results that was written last, in a browser"),
    "simulate": (options.add_simulate, "rolling model: scene -> motion, energies, contact forces"),
    "render": (options.add_render, "scene -> recording as the cameras would write it, and its truth"),
    "convert": (options.add_convert, "trajectory or rig from and to the formats of other programs"),
    "warm-up": (options.add_warm_up, "compile the inner loops ahead of the first recording"),
    "validate": (options.add_validate, "render -> measure -> compare: the verdict on 0.005 mm / 0.05 deg"),
}

TRACEBACK_VARIABLE = "DISCTRACK_TRACEBACK"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand; returns its exit code. Errors are one line on stderr."""
    with _interruptions() as received:
        try:
            return _run(argv)
        except KeyboardInterrupt:
            return _print_interruption(received)
        except BrokenPipeError:  # the output pipe is closed: `disctrack ... | head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return FAILED
        except Exception as error:
            if os.environ.get(TRACEBACK_VARIABLE):
                raise
            return _print_interruption(received) if received else _print_error(error)


def _run(argv: Sequence[str] | None) -> int:
    _escape_unprintable_characters()
    parser, commands = _parser()
    arguments, unknown = parser.parse_known_args(argv)
    if unknown:
        commands.get(arguments.command, parser).error(f"unrecognized arguments: {' '.join(unknown)}")
    if arguments.command is None:
        parser.print_help()
        return USAGE
    if sys.stderr.isatty():  # the following imports take seconds
        print(f"{arguments.command} ...", end="\r", file=sys.stderr, flush=True)
    from disctrack.files.whole import inputs_kept  # late, so that --help is fast

    command = importlib.import_module(f"disctrack.commands.{arguments.command.replace('-', '_')}")
    with inputs_kept(), catch_warnings():
        simplefilter("ignore", DoubtWarning)  # reports contain them
        return int(command.run(arguments) or DONE)


@contextmanager
def _interruptions() -> Iterator[list[int]]:
    """Signals received: Ctrl-C and signals of queueing systems and closed terminals end a command properly.

    Compiled libraries that are interrupted during loading turn KeyboardInterrupt into another error, which would be
    reported as ours.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received  # only the main thread handles signals
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    kinds = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {kind: signal.getsignal(kind) for kind in kinds}
    handled = [kind for kind in kinds if before[kind] in (signal.default_int_handler, signal.SIG_DFL)]
    for kind in handled:  # handlers of the caller, and signals ignored by nohup, are kept
        signal.signal(kind, interrupt)
    try:
        yield received
    finally:
        for kind in handled:
            signal.signal(kind, before[kind])


def _escape_unprintable_characters() -> None:
    """Print characters that the encoding of a terminal or log lacks as escapes instead of raising an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _print_error(error: Exception) -> int:
    from disctrack.errors import DiscTrackError, reason_of  # late, so that --help is fast

    return _report(reason_of(error), FAILED if isinstance(error, (DiscTrackError, OSError, MemoryError)) else INTERNAL)


def _print_interruption(received: Sequence[int]) -> int:
    kind = received[0] if received else signal.SIGINT
    how = "interrupted" if kind == signal.SIGINT else f"ended by {signal.Signals(kind).name}"
    code = 128 + kind  # the convention of shells
    try:
        return _report(f"{how}. No half-written file is left; the same command continues.", code)
    except OSError:  # the terminal has been closed
        return code


def _report(message: str, code: int) -> int:
    print(f"disctrack: {printable(' '.join(message.split()))}", file=sys.stderr, flush=True)
    return code


def _parser() -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """The parser, and that of each subcommand; with argcomplete installed, shells complete commands and options."""
    parser = argparse.ArgumentParser(
        prog="disctrack",
        description="Six degrees of freedom of a spinning, rolling disc from two synchronised high-speed cameras.",
        epilog=f"Exit codes: {DONE} done, {FAILED} failed, {USAGE} wrong usage, {INCOMPLETE} done but some input could "
        f"not be read, {128 + signal.SIGINT} interrupted (143 by SIGTERM, 129 by SIGHUP).",
    )
    parser.add_argument("--version", action="version", version=f"disctrack {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND")
    commands = {}
    for name, (add_arguments, summary) in COMMANDS.items():
        description = f"{summary[0].upper()}{summary[1:]}."
        commands[name] = subparsers.add_parser(name, help=summary, description=description)
        add_arguments(commands[name])
    if "_ARGCOMPLETE" in os.environ:  # called by a shell for completion
        with suppress(ImportError):
            importlib.import_module("argcomplete").autocomplete(parser)
    return parser, commands
