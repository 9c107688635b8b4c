"""What an HDF5 file may hold: numbers and text that lie in it, no more of them than its size explains.

    python structure.py FILE  # reads a file from end to end; exits with 3, and why, where it is refused

Damage can crash the HDF5 library, hang it, or make it ask for terabytes. So a file without a checksum is
first read by a process of its own, with limits; see `bcppl.recordings.hdf5`, which runs this file as a
script. It imports nothing of bcppl: h5py alone takes a tenth of a second.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
from typing import Any

import h5py

ALLOWANCE = 64 << 20  # bytes of numbers in any file, however small
RATIO = 10  # bytes of numbers for each byte of a file beyond that: depth and wrenches compress less
SECONDS = 4.0  # of one core for a small file
BYTES_A_SECOND = 20 << 20  # of a large one, compressed
FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}  # others are plugins
NUMERIC = "biuf"
REFUSED = 3


class StructureError(OSError):
    """A file holds what no file of bcppl does."""


def limit(size: int) -> int:
    """Bytes of numbers that a file of a size may hold."""
    return ALLOWANCE + RATIO * size


def check(file: h5py.File, size: int, read: bool = False) -> None:
    """Refuse links that leave the tree of groups, storage elsewhere, filters of plugins, and bombs.

    Args:
        file: open for reading.
        size: of the file in bytes.
        read: whether the numbers are read too, piece by piece.

    Raises:
        StructureError: says which group or dataset.
    """
    left, seen, waiting = limit(size), {_address(file)}, [file]
    while waiting:
        group = waiting.pop()
        left -= _attributes(group)
        for name in group:
            where = f"{group.name.rstrip('/')}/{name}"
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise StructureError(f"{where} is a link to another place; a recording holds none")
            node = group[name]
            address = _address(node)
            if address in seen:
                raise StructureError(f"{where} is linked twice; a recording holds each thing once")
            seen.add(address)
            if isinstance(node, h5py.Group):
                waiting.append(node)
            elif isinstance(node, h5py.Dataset):
                left -= _attributes(node) + _dataset(node, left)
                if left < 0:
                    raise StructureError(f"{where} claims more numbers than a file of {size} bytes explains")
                if read:
                    node[()]
            else:
                raise StructureError(f"{where} is no group and no dataset")


def _address(node: Any) -> tuple[int, int]:
    found = h5py.h5o.get_info(node.id)
    return found.fileno, found.addr


def _attributes(node: Any) -> int:
    """The bytes of an object's attributes, which are read."""
    total = 0
    for name in node.attrs:
        kept = node.attrs.get_id(name)
        if kept.get_space().get_simple_extent_type() == h5py.h5s.NULL or not _plain(kept.dtype):
            raise StructureError(f"attribute {name!r} of {node.name} is neither numbers nor text")
        total += kept.get_storage_size()
        node.attrs[name]
    return total


def _dataset(node: h5py.Dataset, left: int) -> int:
    """The bytes that a dataset's numbers take in memory."""
    plan = node.id.get_create_plist()
    if node.shape is None or not _plain(node.dtype):
        raise StructureError(f"{node.name} holds neither numbers nor text")
    if node.is_virtual or node.external:
        raise StructureError(f"{node.name} lies in another file; copy its numbers into this one")
    if not {plan.get_filter(k)[0] for k in range(plan.get_nfilters())} <= FILTERS:
        raise StructureError(f"{node.name} is compressed by a plugin; write it with gzip")
    chunk = math.prod(node.chunks or ()) * node.dtype.itemsize
    if chunk > left:
        raise StructureError(f"{node.name} lies in chunks of {chunk} bytes, more than the file explains")
    return math.prod(node.shape) * node.dtype.itemsize


def _plain(dtype: Any) -> bool:
    return (dtype.kind in NUMERIC and dtype.shape == ()) or h5py.check_string_dtype(dtype) is not None


def _limited(size: int) -> None:
    """Let this process take no more memory and time than a file of a size may."""
    with contextlib.suppress(ImportError, OSError, ValueError):  # Windows has no such limits
        import resource

        with open("/proc/self/statm") as taken:
            now = int(taken.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + 2 * limit(size),) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds(size)),) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def seconds(size: int) -> float:
    """Seconds of one core in which a file of a size is read."""
    return SECONDS + size / BYTES_A_SECOND


def main(path: str) -> int:
    """Read a file; 0, or 3 with one line on standard output where it is refused."""
    size = os.path.getsize(path)
    _limited(size)
    try:
        with h5py.File(path, "r") as file:
            check(file, size, read=True)
    except Exception as error:  # h5py has errors of all types
        print(" ".join(str(error).split()) or type(error).__name__)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
