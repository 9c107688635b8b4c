"""The native recording file: one HDF5 file that holds a whole recording.

Layout, schema version 2 (SI units, in each dataset's attribute `units`; frames are in the datasets' names):

    /                         attributes format, schema_version, model, source
    /part, /peg               attributes name, source; vertices, faces, pieces/0000.. (kind, size, center)
    /guess                    world_from_part, translation, tilt, yaw, angle (absent where tilt and yaw rule)
    /truth                    world_from_part (the group is absent where the truth is unknown)
    /background/NAME          depth of the scene without the part, by camera name
    /measurements/000000..    attribute kind; action and observation, as the kind's layouts state them
    /cameras/NAME             width, height, fx, fy, cx, cy, near, far; world_from_camera; since version 2,
                              and only where there is one: distortion (k1 k2 p1 p2 k3), wrist_from_camera,
                              attribute device
    /probes/NAME              command_times, command_world_from_peg, stiffness, damping, stamps

Cameras, probes and other shared objects are written once and referred to by name. Names are percent-encoded
where they would read as HDF5 paths. Depth is float32: values that float32 represents come back exactly,
others are rounded by less than 0.1 micrometre at 1 m. Everything else comes back bit for bit. A file states
the lowest version that holds it, so that an older bcppl reads what it can, and refuses the rest rather than
lose it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import unquote

import h5py
import numpy as np

from bcppl.errors import InputError
from bcppl.geometry.parts import Guess, Part, Piece
from bcppl.sensors.layout import POSE_UNITS, TEXT, Layout, SharedObjects, link, number, numbers
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.protocol import sensor_named, sensor_of

FORMAT = "bcppl recording"
SCHEMA_VERSION = 2
ALWAYS = ("background", "cameras", "probes", "measurements")  # groups that a reader of version 1 asks for

PART = Layout(Part, {"name": TEXT, "source": TEXT, "vertices": numbers("m"), "faces": numbers("1", np.int64)})
PIECE = Layout(Piece, {"kind": TEXT, "size": numbers("m"), "center": numbers("m")})
GUESS = Layout(
    Guess,
    {
        "world_from_part": numbers(POSE_UNITS),
        "translation": numbers("m"),
        **{name: number("rad") for name in ("tilt", "yaw", "angle")},
    },
    optional={"angle": 1},
)
POSE = numbers(POSE_UNITS)
DEPTH = numbers("m", np.float32)


def save(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording to an HDF5 file, all or nothing.

    A failure leaves an earlier file as it was. A recording may have problems: see `bcppl.recordings.check`.

    Raises:
        InputError: the folder is missing or not writable, two cameras or probes share a name but differ, an
            action is of no known kind, or the recording holds something that is no number.
    """
    with replacing(path) as beside, h5py.File(beside, "w") as file:
        _write(file, recording)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A new file beside `path`, which is moved there once it is written, and removed if that fails.

    Raises:
        InputError: the folder is missing, or what is written raises an error of the system, type or value.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {path.parent}; make it first.")
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield beside
        os.replace(beside, path)
    except InputError:
        raise
    except (OSError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} cannot be written: {_one_line(error)}.") from error
    finally:
        with suppress(OSError, ValueError):  # a name that is too long can be neither made nor removed
            beside.unlink(missing_ok=True)


def load(path: str | os.PathLike[str]) -> Recording:
    """Read a recording; windows of one probe share one `Probe`, views of one camera one `Camera`.

    Raises:
        InputError: the file is missing, is not a bcppl recording, is cut off or damaged, lacks a group or
            dataset, holds a kind of measurement that is not installed, or was written under a schema that
            this bcppl does not know.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is not a file; give the path of a recording (.h5).")
    try:
        with h5py.File(path, "r") as file:
            _refuse_header(file)
            return _read(file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (KeyError, OSError, RuntimeError, TypeError, ValueError, AttributeError) as error:
        missing = re.search(r"'([^']+)'", str(error)) if isinstance(error, KeyError) else None
        if missing is not None:
            raise InputError(f"{path} lacks {missing.group(1)!r}; make the recording again.") from error
        if not h5py.is_hdf5(path):
            raise InputError(f"{path} is not an HDF5 file; give a recording written by bcppl.") from error
        what = f"{path} is damaged or cut off ({_one_line(error)})"
        raise InputError(f"{what}; copy or make it again.") from error


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


def _refuse_header(file: h5py.File) -> None:
    if file.attrs.get("format") != FORMAT or "schema_version" not in file.attrs:
        raise InputError("the file is an HDF5 file but not a bcppl recording; give one written by bcppl.")
    version = int(file.attrs["schema_version"])
    if not 1 <= version <= SCHEMA_VERSION:
        known = f"this bcppl reads versions 1 to {SCHEMA_VERSION}"
        raise InputError(f"the file has schema version {version}, {known}; upgrade bcppl.")


def _write(file: h5py.File, recording: Recording) -> None:
    file.attrs.update(format=FORMAT, model=recording.model, source=recording.source)
    _write_part(file.create_group("part"), recording.part)
    if recording.peg is not None:
        _write_part(file.create_group("peg"), recording.peg)
    GUESS.write(file.create_group("guess"), recording.guess)
    if recording.truth is not None:
        POSE.write(file.create_group("truth"), "world_from_part", recording.truth)
    for name in ALWAYS:
        file.create_group(name)
    for name, depth in recording.background.items():
        DEPTH.write(file["background"], link(name), depth)
    shared, version = SharedObjects(file), 1
    for index, measurement in enumerate(recording.measurements):
        sensor = sensor_of(measurement.action)
        group = file.create_group(f"measurements/{index:06d}")
        group.attrs["kind"] = sensor.kind
        for name, layout in (("action", sensor.action), ("observation", sensor.observation)):
            content = getattr(measurement, name)
            layout.write(group.create_group(name), content, shared)
            version = max(version, layout.version(content))
    file.attrs["schema_version"] = version


def _write_part(group: h5py.Group, part: Part) -> None:
    PART.write(group, part)
    pieces = group.create_group("pieces")
    for index, piece in enumerate(part.pieces):
        PIECE.write(pieces.create_group(f"{index:04d}"), piece)


def _read(file: h5py.File) -> Recording:
    shared = SharedObjects(file)
    return Recording(
        part=_read_part(file["part"]),
        guess=GUESS.read(file["guess"]),
        measurements=[_read_measurement(group, shared) for _, group in sorted(file["measurements"].items())],
        peg=_read_part(file["peg"]) if "peg" in file else None,
        background={unquote(key): DEPTH.read(file["background"], key) for key in file["background"]},
        truth=POSE.read(file["truth"], "world_from_part") if "truth" in file else None,
        model=str(file.attrs["model"]),
        source=str(file.attrs["source"]),
    )


def _read_part(group: h5py.Group) -> Part:
    pieces = tuple(PIECE.read(piece) for _, piece in sorted(group["pieces"].items()))
    return PART.read(group, pieces=pieces)


def _read_measurement(group: h5py.Group, shared: SharedObjects) -> Measurement:
    sensor = sensor_named(str(group.attrs["kind"]))
    return Measurement(
        sensor.action.read(group["action"], shared), sensor.observation.read(group["observation"], shared)
    )
