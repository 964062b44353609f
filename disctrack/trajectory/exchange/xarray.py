"""A trajectory in memory as an xarray Dataset: names, units and axes of the file, the time axis included."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from disctrack.errors import OutputError
from disctrack.files.labelled_arrays import Variable
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

    def described(item: Variable) -> tuple:
        return item.dims, np.asarray(item.data), {"units": item.units, "long_name": item.long_name, **item.attributes}

    variables, axes, numbers = labelled(trajectory)
    used = {axis for item in variables.values() for axis in item.dims}
    coordinates = {name: described(axis) for name, axis in axes.items() if name in used}
    return xarray.Dataset({name: described(item) for name, item in variables.items()}, coordinates, numbers)
