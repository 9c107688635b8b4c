"""HDF5 files of bcppl: written whole with a checksum of their bytes, and opened only where that is safe.

A file ends with a line that HDF5 does not read, `bcppl sha256 ...`, the checksum of all bytes before it. A
file that has another or none, as of an earlier version or of another program, is first read from end to end
by a process of its own (`bcppl.recordings.structure`), in 0.15 s for a shipped recording.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import h5py

from bcppl.errors import InputError, reason_of
from bcppl.recordings import structure
from bcppl.untrusted.visible_text import visible

MARK = b"\nbcppl sha256 "
SEAL = re.compile(rb"\nbcppl sha256 ([0-9a-f]{64})\n", re.DOTALL)
LENGTH = len(MARK) + 65
WAIT = 10.0  # s on the clock for each second of a core: a machine may be busy
AGAIN = "copy or make it again"

_read_before: set[tuple[str, ...]] = set()  # checksums of files that were read, and what of them


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A new file beside `path`, which is moved there once it is written, and removed if that fails.

    Where `path` is a link, it stays one, and the file that it leads to is replaced.

    Raises:
        InputError: the folder is missing, something else than a file is there, or what is written raises an
            error of the system, type or value.
    """
    path = Path(path)
    place = Path(os.path.realpath(path)) if os.path.islink(path) else path
    if not place.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {place.parent}; make it first.")
    if os.path.exists(path) and not os.path.isfile(path):
        # To replace a device or a pipe would take it from all who use it.
        raise InputError(f"{path} cannot be written: it is a folder, device or pipe; give a file's name.")
    beside = place.with_name(f".{place.name}.{os.getpid()}.part")
    try:
        yield beside
        os.replace(beside, place)
    except InputError:
        raise
    except OSError as error:
        reason = error.strerror or one_line(error)
        raise InputError(f"{path} cannot be written: {reason}; make room, or give another place.") from error
    except (TypeError, ValueError, AttributeError, MemoryError) as error:
        raise InputError(f"{path} cannot be written: {one_line(error)}.") from error
    finally:
        with suppress(OSError, ValueError):  # a name that is too long can be neither made nor removed
            beside.unlink(missing_ok=True)


@contextmanager
def created(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """A new HDF5 file, which lies in memory until it is complete: HDF5 never meets a full disk.

    Raises:
        InputError: it cannot be written; an earlier file is left as it was.
    """
    with replacing(path) as beside:
        with h5py.File(beside, "w", driver="core", backing_store=False) as file:
            yield file
            _bounded(file)
            file.flush()
            image = file.id.get_file_image()
        seal = MARK + hashlib.sha256(image).hexdigest().encode() + b"\n"
        with beside.open("wb") as written:
            written.write(image)
            written.write(seal)


def _bounded(file: h5py.File) -> None:
    """Write numbers that compress so well that the file would be refused as a bomb without compression."""
    sets: list[h5py.Dataset] = []
    file.visititems(lambda _, node: sets.append(node) if isinstance(node, h5py.Dataset) else None)
    if sum(each.nbytes for each in sets) <= structure.ALLOWANCE:
        return
    for each in sets:
        name, attributes, numbers = each.name, dict(each.attrs), each[()]
        if each.compression is not None and each.nbytes > structure.RATIO * each.id.get_storage_size():
            del file[name]
            file.create_dataset(name, data=numbers).attrs.update(attributes)


@contextmanager
def opened(
    path: str | os.PathLike[str], remedy: str = AGAIN, within: Sequence[str] = ()
) -> Iterator[h5py.File]:
    """An HDF5 file for reading. What goes wrong with it is one sentence that names the file.

    Args:
        path: of a file.
        remedy: what to do where it is damaged.
        within: paths of the groups and datasets that the body reads, in a file of another program; what is
            beside them, such as videos, is not looked at. All if there are none.

    Raises:
        InputError: it is no HDF5 file, is damaged, cut off, or was changed after it was saved, holds links
            to other places or claims more numbers than its size explains, or the body raises an error.
    """
    path = Path(path)
    try:
        checksum, sealed = _checksum(path)
        if not sealed and (checksum, *within) not in _read_before:
            _read_elsewhere(path, within)
            _read_before.add((checksum, *within))
        with h5py.File(path, "r") as file:
            structure.check(file, path.stat().st_size, within=within)
            yield file
        if sealed is False:
            raise OSError("its bytes are not those that were saved")
    except InputError as error:
        raise (error if str(path) in str(error) else InputError(f"{path}: {error}")) from error
    except KeyError as error:
        missing = re.search(r"'([^']+)'", str(error))
        raise InputError(f"{path} lacks {missing.group(1) if missing else error!r}; {remedy}.") from error
    except Exception as error:  # whatever a damaged file provokes in h5py and numpy
        if not path.is_file() or not h5py.is_hdf5(path):
            what = f"{path} is not an HDF5 file: it is damaged or no file of bcppl"
            raise InputError(f"{what}; {remedy}.") from error
        raise InputError(f"{path} is damaged or cut off ({one_line(error)}); {remedy}.") from error


def one_line(error: BaseException) -> str:
    """The message of an error in one line that can be printed, without its full stop."""
    return visible(reason_of(error))


def _checksum(path: Path) -> tuple[str, bool | None]:
    """The checksum of a file's bytes, and whether it is the one that the file carries; None for none."""
    left, total = path.stat().st_size, hashlib.sha256()
    with path.open("rb") as file:
        file.seek(max(0, left - LENGTH))
        end = file.read()
        seal = SEAL.fullmatch(end)
        left -= LENGTH if seal else 0
        file.seek(0)
        while block := file.read(min(left, 1 << 20)):
            total.update(block)
            left -= len(block)
    checksum = total.hexdigest()
    if seal:
        return checksum, seal[1].decode() == checksum
    return checksum, False if MARK in end else None


def _read_elsewhere(path: Path, within: Sequence[str]) -> None:
    """Read a file in a process of its own.

    Raises:
        OSError: that was refused, took too much memory, or the process crashed.
        InputError: it took too long.
    """
    command = [sys.executable, "-P", structure.__file__, os.fspath(path.absolute()), *within]
    known = os.pathsep.join(each for each in sys.path if each)
    environment = {**os.environ, "PYTHONPATH": known, "HDF5_PLUGIN_PRELOAD": "::"}
    patience = WAIT * structure.seconds(path.stat().st_size)
    try:
        done = subprocess.run(
            command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, timeout=patience
        )
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{path} was not read in {patience:.0f} s: the machine is busy or the file is damaged; try again."
        ) from None
    if done.returncode == structure.REFUSED:
        raise OSError(done.stdout.decode(errors="replace").strip())
    if done.returncode != 0:
        raise OSError("HDF5 fails on it")
