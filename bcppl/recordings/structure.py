"""What an HDF5 file may hold: numbers and text that lie in it, no more of them than its size explains.

    python structure.py FILE [NAME ...]  # reads a file, or what is named; exits with 3, and why, if refused

Damage can crash the HDF5 library, hang it, or make it ask for terabytes. So a file without a checksum is
first read by a process of its own, with limits; see `bcppl.recordings.hdf5`, which runs this file as a
script. It imports nothing of bcppl: h5py alone takes a tenth of a second.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np

ALLOWANCE = 64 << 20  # bytes of numbers in any file, however small
RATIO = 10  # bytes of numbers for each byte of a file beyond that: depth and wrenches compress less
WORD = 64  # bytes of an object of Python without its characters, rounded up
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


def check(file: h5py.File, size: int, read: bool = False, within: Sequence[str] = ()) -> None:
    """Refuse links that leave the tree of groups, storage elsewhere, filters of plugins, and bombs.

    Args:
        file: open for reading.
        size: of the file in bytes.
        read: whether the numbers are read too, piece by piece.
        within: paths of the groups and datasets that are looked at in a file of another program, which may
            hold anything beside them; all if there are none.

    Raises:
        StructureError: says which group or dataset.
    """
    left, seen, waiting = limit(size), {_address(file.id)}, [("", h5py.h5g.open(file.id, b"/"))]
    while waiting:
        above, group = waiting.pop()
        left -= _attributes(group, above or "/", left, size, read, within)
        for key in group:
            where = f"{above}/{key.decode(errors='replace')}"
            if within and not any(_leads(where, each) for each in within):
                continue
            if group.links.get_info(key).type != h5py.h5l.TYPE_HARD:
                raise StructureError(f"{where} is a link to another place; a recording holds none")
            node = h5py.h5o.open(group, key)
            address = _address(node)
            if address in seen:
                raise StructureError(f"{where} is linked twice; a recording holds each thing once")
            seen.add(address)
            if isinstance(node, h5py.h5g.GroupID):
                waiting.append((where, node))
            elif isinstance(node, h5py.h5d.DatasetID):
                left -= _attributes(node, where, left, size, read, within)
                left -= _dataset(node, where, left, size)
                if left < 0:
                    raise StructureError(f"{where} claims more numbers than a file of {size} bytes explains")
                if read:
                    h5py.Dataset(node)[()]
            else:
                raise StructureError(f"{where} is no group and no dataset")


def _leads(where: str, path: str) -> bool:
    """Whether a place is on the way to a path, or in it."""
    here, there = f"{where}/", f"/{path}/"
    return here.startswith(there) or there.startswith(here)


def _address(node: Any) -> tuple[int, int]:
    found = h5py.h5o.get_info(node)
    return found.fileno, found.addr


def _attributes(node: Any, where: str, left: int, size: int, read: bool, within: Sequence[str]) -> int:
    """The bytes of an object's attributes."""
    total = 0
    for index in range(h5py.h5a.get_num_attrs(node)):
        kept = h5py.h5a.open(node, index=index)
        if kept.get_space().get_simple_extent_type() == h5py.h5s.NULL or not _plain(kept.dtype):
            raise StructureError(f"attribute {kept.name!r} of {where} is neither numbers nor text")
        total += kept.get_storage_size()
        holder = h5py.Group(node) if isinstance(node, h5py.h5g.GroupID) else h5py.Dataset(node)
        if _refers(kept.dtype) and kept.shape == ():
            total += len(holder.attrs[kept.name.decode()])
        elif _refers(kept.dtype) and not within:
            # HDF5 reads all of an attribute at once. No file of bcppl has such a one, and in files of other
            # programs it is read by the process with limits alone.
            total += math.prod(kept.shape) * size
        if total > left:
            raise StructureError(f"attributes of {where} claim more than a file of {size} bytes explains")
        if read:
            holder.attrs[kept.name.decode()]
    return total


def _dataset(node: Any, where: str, left: int, size: int) -> int:
    """The bytes that a dataset's numbers or text take in memory."""
    plan, dtype = node.get_create_plist(), node.dtype
    if node.get_space().get_simple_extent_type() == h5py.h5s.NULL or not _plain(dtype):
        raise StructureError(f"{where} holds neither numbers nor text")
    layout = plan.get_layout()
    if layout == h5py.h5d.VIRTUAL or plan.get_external_count():
        raise StructureError(f"{where} lies in another file; copy its numbers into this one")
    if not {plan.get_filter(k)[0] for k in range(plan.get_nfilters())} <= FILTERS:
        raise StructureError(f"{where} is compressed by a plugin; write it with gzip")
    if layout == h5py.h5d.CHUNKED and (chunk := math.prod(plan.get_chunk()) * dtype.itemsize) > left:
        raise StructureError(f"{where} lies in chunks of {chunk} bytes, more than the file explains")
    if not _refers(dtype):
        return math.prod(node.shape) * dtype.itemsize
    if layout == h5py.h5d.CHUNKED:  # which are read whole for each word that is looked at
        raise StructureError(f"{where} is text in chunks; write it without them")
    return _text(node, left, size)


def _text(node: Any, left: int, size: int) -> int:
    """The bytes of words of any length, counted until they are too many.

    Each is a reference, and a thousand may be to one word of a megabyte: so few are read at a time that they
    could all be as long as the file.
    """
    count = math.prod(node.shape)
    total = count * WORD
    step = max(1, limit(size) // (2 * size))
    for begin in range(0, count, step):
        if total > left:
            break
        space, chosen = node.get_space(), np.arange(begin, min(begin + step, count))
        if node.shape:
            space.select_elements(np.stack(np.unravel_index(chosen, node.shape), axis=1))
        words = np.empty(len(chosen), dtype=node.dtype)
        node.read(h5py.h5s.create_simple(words.shape), space, words)
        total += sum(map(len, words))
    return total


def _plain(dtype: Any) -> bool:
    return (dtype.kind in NUMERIC and dtype.shape == ()) or h5py.check_string_dtype(dtype) is not None


def _refers(dtype: Any) -> bool:
    """Whether values are text of any length, which lies elsewhere in the file."""
    held = h5py.check_string_dtype(dtype)
    return held is not None and held.length is None


def _limited(size: int) -> None:
    """Let this process take no more memory and time than a file of a size may."""
    with contextlib.suppress(ImportError, OSError, ValueError):  # not every system has such limits
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds(size)),) * 2)
        with open("/proc/self/statm") as taken:  # Linux alone counts addresses, and keeps to the limit
            now = int(taken.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + 2 * limit(size),) * 2)


def seconds(size: int) -> float:
    """Seconds of one core in which a file of a size is read."""
    return SECONDS + size / BYTES_A_SECOND


def main(path: str, *within: str) -> int:
    """Read a file, or what is named in it; 0, or 3 with one line on standard output where it is refused."""
    size = os.path.getsize(path)
    _limited(size)
    try:
        with h5py.File(path, "r") as file:
            check(file, size, read=True, within=within)
    except Exception as error:  # h5py has errors of all types
        print(" ".join(str(error).split()) or type(error).__name__)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
