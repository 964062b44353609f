"""`disctrack simulate`: the rolling model forwards, from a scene to its motion."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack simulate`."""
    parser.add_argument("scene", type=Path, nargs="?", help='TOML file whose motion.kind is "rolling"')
    parser.add_argument("-o", "--output", type=Path, help="HDF5 file (default: SCENE_motion.h5 beside the scene)")
    parser.add_argument("--duration", type=_positive, metavar="S", help="seconds (default: as long as the scene films)")
    parser.add_argument("--rate", type=_positive, metavar="HZ", help="instants per second (default: the cameras')")
    parser.add_argument("--overwrite", action="store_true", help="replace an older file")
    parser.add_argument("--list-effects", action="store_true", help="print the catalogue of effects and stop")


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is not a positive number")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Simulate, write, and say how the motion went; returns the exit code."""
    from disctrack.commands import DONE
    from disctrack.errors import SceneError

    if arguments.list_effects:
        from disctrack.rolling.effects import catalogue_table

        print(catalogue_table(), end="")
        return DONE
    if arguments.scene is None:
        raise SceneError("no scene given: name a TOML file, or ask for the effects with --list-effects")
    from disctrack.scene.simulation import run_simulate

    output = arguments.output or arguments.scene.parent / f"{arguments.scene.stem}_motion.h5"
    done = run_simulate(
        arguments.scene, output, duration=arguments.duration, rate=arguments.rate, overwrite=arguments.overwrite
    )
    print(done.summary)
    return DONE
