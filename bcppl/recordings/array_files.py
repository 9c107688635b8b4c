"""NumPy's files from elsewhere, which importers read: no objects, no more numbers than a file explains."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from bcppl.recordings.structure import limit

END = ".npy"  # of the members of an .npz file


def npy(path: Path) -> Any:
    """The array of an .npy file.

    Raises:
        ValueError: it is no such file, holds objects, or is shorter than its header claims. numpy raises
            errors of other types too.
    """
    # A map is made only of what is there, whereas np.load asks for memory first, and reads .npz files too.
    return np.array(np.lib.format.open_memmap(path, mode="r"))


def npz(path: Path) -> Any:
    """The arrays of an .npz file, by name, each read when it is asked for.

    Raises:
        ValueError: as `members`, and where an array that is read holds objects; zip files have errors of
            many types.
    """
    members(path)
    return np.load(path, allow_pickle=False)


def members(path: Path, checksums: bool = False) -> list[str]:
    """The names of the arrays in an .npz file.

    Args:
        path: of the file.
        checksums: whether all of it is read, and compared with them.

    Raises:
        ValueError: a name is given twice, the file claims more numbers than its size explains, or a checksum
            is wrong; zip files have errors of many types.
    """
    with zipfile.ZipFile(path) as packed:
        sizes = {each.filename: each.file_size for each in packed.infolist()}
        if len(sizes) < len(packed.infolist()):
            raise ValueError("a name is given twice")
        if sum(sizes.values()) > limit(path.stat().st_size):
            raise ValueError("it claims more numbers than its size explains")
        if checksums and (damaged := packed.testzip()):
            raise ValueError(f"the checksum of {damaged} is wrong")
    return sorted(name.removesuffix(END) for name in sizes if name.endswith(END))
