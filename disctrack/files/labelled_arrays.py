"""Arrays with names, axes and units in HDF5, readable by xarray, netCDF and pandas without options.

Every axis is a dimension scale at the root of the file; variables of all groups refer to it by name.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike

from calibration.kit.types import AnyArray


@dataclass(frozen=True)
class Variable:
    """An array with its axes and its unit, as one dataset of a file."""

    data: ArrayLike
    dims: tuple[str, ...]
    units: str  # "1" if dimensionless
    long_name: str
    attributes: Mapping[str, Any] = field(default_factory=dict)


def write_variables(
    group: h5py.Group, variables: Mapping[str, Variable], axes: Mapping[str, Variable] | None = None
) -> None:
    """Write datasets with dimension scales. Axes that the file's root does not have yet are taken from `axes`.

    Raises ValueError if an axis is unknown or a length does not fit.
    """
    root = group.file["/"]
    for name, axis in (axes or {}).items():
        if name not in root:
            _create(root, name, axis).make_scale(name)
    for name, variable in variables.items():
        dataset = _create(group, name, variable)
        for position, axis_name in enumerate(variable.dims):
            if axis_name not in root:
                raise ValueError(f"{name}: no axis {axis_name} at the root of the file")
            if root[axis_name].shape[0] != dataset.shape[position]:
                raise ValueError(f"{name}: {dataset.shape[position]} along {axis_name} of {root[axis_name].shape[0]}")
            dataset.dims[position].attach_scale(root[axis_name])


def copy_without(source: h5py.File, target: h5py.File, groups: Collection[str], axes: Collection[str]) -> None:
    """Copy a file except these groups of its root, and except those of these axes that no other variable uses."""
    paths: list[str] = []
    source.visit(paths.append)
    kept = [source[path] for path in paths if path.partition("/")[0] not in groups]
    axes_of = {
        item.name: [dimension[0].name for dimension in item.dims if len(dimension)]
        for item in kept
        if isinstance(item, h5py.Dataset) and not item.is_scale
    }
    needed = {axis for names in axes_of.values() for axis in names}
    for name in source:
        if name not in groups and (name not in axes or f"/{name}" in needed):
            source.copy(name, target)
            # references between scales and datasets are invalid in another file
            target[name].attrs.pop("REFERENCE_LIST", None)
    target.attrs.update(source.attrs)
    for name, names in axes_of.items():
        target[name].attrs.pop("DIMENSION_LIST", None)
        for position, axis in enumerate(names):
            target[name].dims[position].attach_scale(target[axis])


def _create(group: h5py.Group, name: str, variable: Variable) -> h5py.Dataset:
    data = np.asarray(variable.data)
    if data.ndim != len(variable.dims):
        raise ValueError(f"{name}: {data.ndim} axes, but {len(variable.dims)} names for them")
    if data.dtype == bool or data.dtype.kind not in "iufU":
        raise ValueError(f"{name}: arrays of {data.dtype} are not written; use uint8 or a float")
    options: dict[str, object] = {}
    if data.dtype.kind == "U":
        data, options = data.astype(object), {"dtype": h5py.string_dtype()}
    elif data.ndim and data.size:
        options = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
    dataset = group.create_dataset(name, data=data, **options)
    dataset.attrs.update({"units": variable.units, "long_name": variable.long_name, **variable.attributes})
    return dataset


# Above the largest compression ratio of gzip: a dataset larger than this times the file's size is damaged, and not read
MOST_COMPRESSION = 1100


def read_array(dataset: h5py.Dataset) -> AnyArray:
    """Values of a dataset, text as str. Raises ValueError if its stated size is larger than the file can hold."""
    if dataset.size * dataset.dtype.itemsize > MOST_COMPRESSION * dataset.file.id.get_filesize():
        raise ValueError(f"{dataset.name} claims {dataset.shape} values, more than the file can hold")
    return dataset.asstr()[()] if h5py.check_string_dtype(dataset.dtype) else dataset[()]


def flags(enum: type) -> dict[str, Any]:
    """CF attributes of an array of members of an IntEnum."""
    members = list(enum)  # type: ignore[call-overload]
    return {
        "flag_values": np.array([int(member) for member in members], np.uint8),
        "flag_meanings": " ".join(member.name.lower() for member in members),
    }
