"""`disctrack convert`: trajectories and rigs from and to the formats of other programs."""

import argparse

from disctrack.trajectory.exchange.formats import convert


def run(arguments: argparse.Namespace) -> None:
    """Convert."""
    found = convert(
        arguments.source,
        arguments.target,
        form=arguments.form,
        overwrite=arguments.overwrite,
        world_is_table=arguments.table,
        cameras=arguments.cameras and tuple(arguments.cameras),
        image_size=arguments.image_size and tuple(arguments.image_size),
        unit=arguments.unit_mm and 1e-3 * arguments.unit_mm,
    )
    print(f"{'written':<13} {', '.join(str(path) for path in found.paths)}")
    for note in found.notes:
        print(f"{'note':<13} {note}")
