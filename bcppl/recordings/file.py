"""The native recording file: one HDF5 file that holds a whole recording.

Layout, schema version 2 (SI units, in each dataset's attribute `units`; frames are in the datasets' names):

    /                         attributes format, schema_version, model, source; sha256: a checksum of the
                              content, which earlier versions did not write, and without which a file is
                              read all the same
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

import hashlib
import os
from pathlib import Path
from urllib.parse import unquote

import h5py

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.recordings.fingerprint import add, fingerprint
from bcppl.recordings.hdf5 import created, opened
from bcppl.recordings.layouts import DEPTH, GUESS, PART, PIECE, POSE
from bcppl.sensors.layout import SharedObjects, link, text
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.protocol import sensor_named, sensor_of

FORMAT = "bcppl recording"
SCHEMA_VERSION = 2
ALWAYS = ("background", "cameras", "probes", "measurements")  # groups that a reader of version 1 asks for
KNOWN = {*ALWAYS, "part", "peg", "guess", "truth"}
CHECKSUM = "sha256"


def save(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording to an HDF5 file, all or nothing.

    A failure leaves an earlier file as it was. A recording may have problems: see `bcppl.recordings.check`.

    Raises:
        InputError: the folder is missing or not writable, two cameras or probes share a name but differ, an
            action is of no known kind, or the recording holds something that is no number.
    """
    with created(path) as file:
        _write(file, recording)
        file.attrs[CHECKSUM] = _checksum(recording)


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
    with opened(path) as file:
        _refuse_header(file)
        recording = _read(file)
        if file.attrs.get(CHECKSUM, _checksum(recording)) != _checksum(recording):
            raise InputError(
                f"{path} was changed after it was saved; make it again, or, if you changed it, delete its "
                f"attribute {CHECKSUM!r}."
            )
    return recording


def is_checked(path: str | os.PathLike[str]) -> bool:
    """Whether a recording's file carries a checksum of its content; those of earlier versions do not."""
    with opened(path) as file:
        return CHECKSUM in file.attrs


def _checksum(recording: Recording) -> str:
    """A checksum of all that a recording's file holds, whoever compressed it and however."""
    labels = [recording.model, recording.source]
    for part in (recording.part, recording.peg):
        labels += [] if part is None else [part.name, part.source]
    truth = None if recording.truth is None else POSE.stored(recording.truth)
    digest = hashlib.sha256()
    add(digest, [fingerprint(recording, len(recording.measurements)), labels, truth])
    return digest.hexdigest()


def _refuse_header(file: h5py.File) -> None:
    if file.attrs.get("format") != FORMAT or "schema_version" not in file.attrs:
        raise InputError("the file is an HDF5 file but not a bcppl recording; give one written by bcppl.")
    version = whole_number("the file has schema version {}", file.attrs["schema_version"])
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
    if unknown := set(file) - KNOWN:
        raise InputError(
            f"the file holds {min(unknown)!r}, which no recording does; remove it, or correct its name."
        )
    for name in ALWAYS:
        if not isinstance(file[name], h5py.Group):
            raise InputError(f"{name} is no group; make the recording again.")
    shared = SharedObjects(file)
    return Recording(
        part=_read_part(file["part"]),
        guess=GUESS.read(file["guess"]),
        measurements=[_read_measurement(group, shared) for group in _numbered(file["measurements"], 6)],
        peg=_read_part(file["peg"]) if "peg" in file else None,
        background={unquote(key): DEPTH.read(file["background"], key) for key in file["background"]},
        truth=POSE.read(file["truth"], "world_from_part") if "truth" in file else None,
        model=text(file.attrs["model"]),
        source=text(file.attrs["source"]),
    )


def _numbered(group: h5py.Group, digits: int) -> list[h5py.Group]:
    """The groups in a group, which are called by their numbers from 0 on.

    Raises:
        KeyError: one is missing.
    """
    return [group[f"{number:0{digits}d}"] for number in range(len(group))]


def _read_part(group: h5py.Group) -> Part:
    pieces = tuple(PIECE.read(piece) for piece in _numbered(group["pieces"], 4))
    return PART.read(group, pieces=pieces)


def _read_measurement(group: h5py.Group, shared: SharedObjects) -> Measurement:
    sensor = sensor_named(text(group.attrs["kind"]))
    return Measurement(
        sensor.action.read(group["action"], shared), sensor.observation.read(group["observation"], shared)
    )
