"""`disctrack render`: a scene as recorded by a pair of cameras, with its true motion."""

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from disctrack.errors import SceneError
from disctrack.synthetic.description import Scene, load_scene, scene_toml
from disctrack.synthetic.motion import effects_in_words
from disctrack.synthetic.recording import run_render


def run(arguments: argparse.Namespace) -> None:
    """Render, write, and print a summary."""
    if arguments.defaults:
        print(scene_toml(Scene()), end="")
        return
    if arguments.scene is None:
        raise SceneError("no scene given: name a TOML file, or ask for one with --defaults")

    folder = arguments.output or arguments.scene.parent / arguments.scene.stem
    rendered(arguments.scene, folder, arguments.truth, arguments.quiet)


def rendered(file: Path, folder: Path, truth_file: Path | None, quiet: bool) -> None:
    """Render the scene file into the folder, with a progress bar, and print the files."""
    scene = load_scene(file)
    with tqdm(unit="image", file=sys.stderr, disable=quiet or None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        truth = run_render(scene, folder, truth_file, progress)
    views = f"{len(truth.R_world_board)} views of the chessboard"
    print(f"{folder}: {len(truth.time)} pairs of frames at {truth.frame_rate:g} Hz, {views}")
    if scene.motion.kind == "rolling":
        print(f"effects: {effects_in_words(scene)}")
    print(f"truth, for comparison only: {truth_file or folder / 'truth.h5'}")
