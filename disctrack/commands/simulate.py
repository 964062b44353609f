"""`disctrack simulate`: the rolling model forwards, from a scene to its motion."""

import argparse

from disctrack.errors import SceneError
from disctrack.rolling.effects.base import catalogue_table
from disctrack.synthetic.simulation import run_simulate


def run(arguments: argparse.Namespace) -> None:
    """Simulate, write, and print a summary of the motion."""
    if arguments.list_effects:
        print(catalogue_table(), end="")
        return
    if arguments.scene is None:
        raise SceneError("no scene given: name a TOML file, or ask for the effects with --list-effects")

    output = arguments.output or arguments.scene.parent / f"{arguments.scene.stem}_motion.h5"
    done = run_simulate(
        arguments.scene, output, duration=arguments.duration, rate=arguments.rate, overwrite=arguments.overwrite
    )
    print(done.summary)
