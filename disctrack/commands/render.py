"""`disctrack render`: a scene as the pair of cameras would have recorded it, with what is true of it beside it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `disctrack render`."""
    parser.add_argument("scene", type=Path, nargs="?", help="TOML file; what it does not say takes its default")
    parser.add_argument(
        "-o", "--output", type=Path, help="new folder for the recording (default: SCENE beside the scene)"
    )
    parser.add_argument(
        "--truth", type=Path, metavar="FILE", help="where the truth goes (default: truth.h5 in the folder)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--defaults", action="store_true", help="print a scene with every key at its default and stop")


def run(arguments: argparse.Namespace) -> int:
    """Render, write, and say what; returns the exit code."""
    from disctrack.commands import DONE
    from disctrack.errors import SceneError

    if arguments.defaults:
        from disctrack.scene.description import Scene, scene_toml

        print(scene_toml(Scene()), end="")
        return DONE
    if arguments.scene is None:
        raise SceneError("no scene given: name a TOML file, or ask for one with --defaults")
    from tqdm import tqdm

    from disctrack.render import run_render
    from disctrack.scene.description import load_scene
    from disctrack.scene.motion import effects_in_words

    folder = arguments.output or arguments.scene.parent / arguments.scene.stem
    with tqdm(unit="image", file=sys.stderr, disable=arguments.quiet or None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        truth = run_render(arguments.scene, folder, arguments.truth, progress)
    written = [f"{name} {len(files)}" for name, files in _files(folder).items()]
    print(
        f"{folder}: {len(truth.time)} frames at {truth.frame_rate:g} Hz ({', '.join(written)} images), "
        f"{len(truth.R_world_board)} views of the chessboard"
    )
    scene = load_scene(arguments.scene)
    if scene.motion.kind == "rolling":
        print(f"effects: {effects_in_words(scene)}")
    print(f"truth, for comparison only: {arguments.truth or folder / 'truth.h5'}")
    return DONE


def _files(folder: Path) -> dict[str, list[Path]]:
    return {name: list((folder / name).glob("*.png")) for name in ("left", "right")}
