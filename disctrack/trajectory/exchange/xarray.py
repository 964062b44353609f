"""A trajectory in memory as an xarray Dataset: names, units and axes of the file, the time axis included."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from disctrack.errors import OutputError
from disctrack.trajectory import Trajectory
from disctrack.trajectory.file import labelled

if TYPE_CHECKING:
    import xarray


def to_xarray(trajectory: Trajectory) -> xarray.Dataset:
    """`xarray.Dataset` with the root of the trajectory file and its dots (`marker_...`).

    Raises OutputError where xarray is not installed.
    """
    try:
        import xarray
    except ImportError as error:
        raise OutputError("to_xarray needs xarray: pip install xarray") from error
    root, markers, axes = labelled(trajectory)
    used: set[str] = set()
    variables = {}
    for name, item in (*root.items(), *((f"marker_{name}", item) for name, item in markers.items())):
        attributes = {"units": item.units, "long_name": item.long_name, **item.attributes}
        variables[name] = (item.dims, np.asarray(item.data), attributes)
        used.update(item.dims)
    coordinates = {
        name: (axis.dims, np.asarray(axis.data), {"units": axis.units, "long_name": axis.long_name})
        for name, axis in axes.items()
        if name in used
    }
    disc = trajectory.disc
    attributes = {
        "frame_rate_hz": trajectory.frame_rate,
        "gravity_m_s2": trajectory.gravity,
        "air_density_kg_m3": trajectory.air_density,
        "disc_radius_m": disc.radius,
        "disc_half_thickness_m": disc.half_thickness,
        "disc_mass_kg": disc.mass,
    }
    return xarray.Dataset(variables, coordinates, attributes)
