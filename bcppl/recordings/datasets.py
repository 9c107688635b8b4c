"""Datasets of an HDF5 file: numbers with their units."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

POSE_UNITS = "m m m 1 1 1 1"  # [x y z qw qx qy qz]
SMALLEST_COMPRESSED = 256  # entries: below it gzip's chunk index outweighs what it saves

Array = npt.NDArray[np.float64]


def put(group: h5py.Group, name: str, values: object, units: str, dtype: npt.DTypeLike = np.float64) -> None:
    """Write an array, with its units as an attribute, compressed where that is worth it."""
    array = np.asarray(values, dtype=dtype)
    compressed = array.size >= SMALLEST_COMPRESSED
    options: dict[str, Any] = {"compression": "gzip", "shuffle": True} if compressed else {}
    group.create_dataset(name, data=array, **options).attrs["units"] = units


def array(group: h5py.Group, name: str) -> Array:
    """Read an array as float64."""
    return np.asarray(group[name][()], dtype=np.float64)


def number(group: h5py.Group, name: str) -> float:
    """Read one number."""
    return float(group[name][()])
