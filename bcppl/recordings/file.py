"""The native recording file: one HDF5 file that holds a whole recording.

Layout, schema version 2 (SI units, in each dataset's attribute `units`; frames are in the datasets' names):

    /                         attributes format, schema_version, model, source
    /part, /peg               attributes name, source; vertices, faces, pieces/0000.. (kind, size, center)
    /guess                    world_from_part, translation, tilt, yaw, angle (absent where tilt and yaw rule)
    /truth                    world_from_part (the group is absent where the truth is unknown)
    /background/NAME          depth of what stands behind the part, by camera name
    /cameras/NAME             width, height, fx, fy, cx, cy, near, far; world_from_camera; since version 2,
                              and only where there is one: distortion (k1 k2 p1 p2 k3), wrist_from_camera,
                              attribute device
    /probes/NAME              command_times, command_world_from_peg, stiffness, damping, stamps
    /measurements/000000..    attribute kind; action and observation

Cameras and probes are written once and referred to by name. Names are percent-encoded where they would
read as HDF5 paths. Depth is float32: values that float32 represents come back exactly, others are rounded
by less than 0.1 micrometre at 1 m. Everything else comes back bit for bit. A file states the lowest version
that holds it, so that an older bcppl reads what it can, and refuses the rest rather than lose it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import h5py
import numpy as np
import numpy.typing as npt

from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.guess import Guess
from bcppl.geometry.parts import Part, Piece
from bcppl.recordings.cameras import camera_version, read_camera, write_camera
from bcppl.recordings.datasets import POSE_UNITS, array, number, put
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors.measurements import DepthImage, Measurement, Push, Recording, View

FORMAT = "bcppl recording"
SCHEMA_VERSION = 2

WRENCH_UNITS = "N N N N m N m N m"
STIFFNESS_UNITS = "N/m N/m N/m N m/rad N m/rad N m/rad"
DAMPING_UNITS = "N s/m N s/m N s/m N m s/rad N m s/rad N m s/rad"

Array = npt.NDArray[np.float64]


def save(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording to an HDF5 file, all or nothing.

    The file is written beside `path` and moved there when it is complete, so a failure leaves what was
    there before. Nothing is checked but that it can be written: see `bcppl.recordings.check`.

    Raises:
        InputError: the folder is missing or not writable, two cameras or probes share a name but differ, or
            the recording holds something that is no number.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {path.parent}; make it first.")
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with h5py.File(beside, "w") as file:
            _write_recording(file, recording)
        os.replace(beside, path)
    except InputError:
        raise
    except (OSError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} cannot be written: {_one_line(error)}.") from error
    finally:
        beside.unlink(missing_ok=True)


def load(path: str | os.PathLike[str]) -> Recording:
    """Read a recording; windows of one probe share one `Probe`, views of one camera one `Camera`.

    Raises:
        InputError: the file is missing, is not a bcppl recording, is cut off or damaged, lacks a group or
            dataset, or was written under a schema that this bcppl does not know.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is not a file; give the path of a recording (.h5).")
    try:
        with h5py.File(path, "r") as file:
            _check_header(file, path)
            return _read_recording(file)
    except InputError:
        raise
    except (KeyError, OSError, RuntimeError, TypeError, ValueError, AttributeError) as error:
        missing = re.search(r"'([^']+)'", str(error)) if isinstance(error, KeyError) else None
        if missing is not None:
            raise InputError(f"{path} lacks {missing.group(1)!r}; make the recording again.") from error
        if not h5py.is_hdf5(path):
            raise InputError(f"{path} is not an HDF5 file; give a recording written by bcppl.") from error
        raise InputError(
            f"{path} is damaged or cut off ({_one_line(error)}); copy or make it again."
        ) from error


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


def _check_header(file: h5py.File, path: Path) -> None:
    if file.attrs.get("format") != FORMAT or "schema_version" not in file.attrs:
        raise InputError(f"{path} is an HDF5 file but not a bcppl recording; give one written by bcppl.")
    version = int(file.attrs["schema_version"])
    if version > SCHEMA_VERSION:
        raise InputError(
            f"{path} has schema version {version}, this bcppl reads version {SCHEMA_VERSION}; upgrade bcppl."
        )
    if version < 1:
        raise InputError(f"{path} has schema version {version}, which never was; make the recording again.")


def _key(name: str) -> str:
    """A name as one HDF5 link: no slash, and neither '.' nor '..', which HDF5 reads as paths."""
    if not name:
        raise InputError("a camera or probe has an empty name; give each a name of its own.")
    return quote(name, safe=" ").replace(".", "%2E")


# ---- writing


def _put_depth(group: h5py.Group, name: str, depth: Array) -> None:
    put(group, name, depth, "m", np.float32)


def _write_recording(file: h5py.File, recording: Recording) -> None:
    file.attrs["format"] = FORMAT
    file.attrs["schema_version"] = _version(recording)
    file.attrs["model"] = recording.model
    file.attrs["source"] = recording.source
    _write_part(file.create_group("part"), recording.part)
    if recording.peg is not None:
        _write_part(file.create_group("peg"), recording.peg)
    _write_guess(file.create_group("guess"), recording.guess)
    if recording.truth is not None:
        put(file.create_group("truth"), "world_from_part", recording.truth, POSE_UNITS)
    background = file.create_group("background")
    for name, depth in recording.background.items():
        _put_depth(background, _key(name), depth)
    actions = [measurement.action for measurement in recording.measurements]
    cameras = file.create_group("cameras")
    for camera in _by_name((a.camera for a in actions if isinstance(a, View)), "cameras").values():
        write_camera(cameras.create_group(_key(camera.name)), camera)
    probes = file.create_group("probes")
    for probe in _by_name((a.probe for a in actions if isinstance(a, ProbeWindow)), "probes").values():
        _write_probe(probes.create_group(_key(probe.name)), probe)
    measurements = file.create_group("measurements")
    for index, measurement in enumerate(recording.measurements):
        _write_measurement(measurements.create_group(f"{index:06d}"), measurement)


def _version(recording: Recording) -> int:
    """The lowest schema version that holds a recording."""
    cameras = (m.action.camera for m in recording.measurements if isinstance(m.action, View))
    return max(map(camera_version, cameras), default=1)


def _by_name(things: Iterable[Any], what: str) -> dict[str, Any]:
    named: dict[str, Any] = {}
    for thing in things:
        if not same(named.setdefault(thing.name, thing), thing):
            raise InputError(f"two different {what} are both called {thing.name!r}; give each its own name.")
    return named


def same(first: Camera | Probe, second: Camera | Probe) -> bool:
    """Whether two cameras, or two probes, agree in every field to the last bit."""
    if first is second:
        return True
    if type(first) is not type(second):
        return False
    ours, theirs = vars(first), vars(second)
    return all(np.array_equal(ours[field], theirs[field]) for field in ours)


def _write_part(group: h5py.Group, part: Part) -> None:
    group.attrs["name"] = part.name
    group.attrs["source"] = part.source
    put(group, "vertices", part.vertices, "m")
    put(group, "faces", part.faces, "1", np.int64)
    pieces = group.create_group("pieces")
    for index, piece in enumerate(part.pieces):
        stored = pieces.create_group(f"{index:04d}")
        stored.attrs["kind"] = piece.kind
        put(stored, "size", piece.size, "m")
        put(stored, "center", piece.center, "m")


def _write_guess(group: h5py.Group, guess: Guess) -> None:
    put(group, "world_from_part", guess.world_from_part, POSE_UNITS)
    put(group, "translation", guess.translation, "m")
    put(group, "tilt", guess.tilt, "rad")
    put(group, "yaw", guess.yaw, "rad")
    if guess.angle is not None:
        put(group, "angle", guess.angle, "rad")


def _write_probe(group: h5py.Group, probe: Probe) -> None:
    put(group, "command_times", probe.command_times, "s")
    put(group, "command_world_from_peg", probe.command, POSE_UNITS)
    put(group, "stiffness", probe.stiffness, STIFFNESS_UNITS)
    put(group, "damping", probe.damping, DAMPING_UNITS)
    put(group, "stamps", probe.stamps, "s")


def _write_measurement(group: h5py.Group, measurement: Measurement) -> None:
    group.attrs["kind"] = measurement.kind
    action = group.create_group("action")
    match measurement.action:
        case View(camera):
            action.attrs["camera"] = camera.name
        case ProbeWindow(probe, first, last):
            action.attrs["probe"] = probe.name
            action.attrs["first"] = first
            action.attrs["last"] = last
        case Push(times, world_from_tip):
            put(action, "times", times, "s")
            put(action, "world_from_tip", world_from_tip, POSE_UNITS)
    observation = group.create_group("observation")
    match measurement.observation:
        case DepthImage(depth, rgb):
            _put_depth(observation, "depth", depth)
            if rgb is not None:
                put(observation, "rgb", rgb, "1", np.uint8)
        case Touch(times, wrench, world_from_peg):
            put(observation, "times", times, "s")
            put(observation, "wrench", wrench, WRENCH_UNITS)
            put(observation, "world_from_peg", world_from_peg, POSE_UNITS)


# ---- reading


def _read_recording(file: h5py.File) -> Recording:
    cameras = {unquote(key): read_camera(unquote(key), group) for key, group in file["cameras"].items()}
    probes = {unquote(key): _read_probe(unquote(key), group) for key, group in file["probes"].items()}
    return Recording(
        part=_read_part(file["part"]),
        guess=_read_guess(file["guess"]),
        measurements=[
            _read_measurement(group, cameras, probes) for _, group in sorted(file["measurements"].items())
        ],
        peg=_read_part(file["peg"]) if "peg" in file else None,
        background={unquote(key): array(file["background"], key) for key in file["background"]},
        truth=array(file["truth"], "world_from_part") if "truth" in file else None,
        model=str(file.attrs["model"]),
        source=str(file.attrs["source"]),
    )


def _read_part(group: h5py.Group) -> Part:
    pieces = [
        Piece(str(stored.attrs["kind"]), array(stored, "size"), array(stored, "center"))
        for _, stored in sorted(group["pieces"].items())
    ]
    return Part(
        name=str(group.attrs["name"]),
        vertices=array(group, "vertices"),
        faces=np.asarray(group["faces"][()], dtype=np.int64),
        pieces=tuple(pieces),
        source=str(group.attrs["source"]),
    )


def _read_guess(group: h5py.Group) -> Guess:
    return Guess(
        world_from_part=array(group, "world_from_part"),
        translation=array(group, "translation"),
        tilt=number(group, "tilt"),
        yaw=number(group, "yaw"),
        angle=number(group, "angle") if "angle" in group else None,
    )


def _read_probe(name: str, group: h5py.Group) -> Probe:
    return Probe(
        name=name,
        command_times=array(group, "command_times"),
        command=array(group, "command_world_from_peg"),
        stiffness=array(group, "stiffness"),
        damping=array(group, "damping"),
        stamps=array(group, "stamps"),
    )


def _read_measurement(
    group: h5py.Group, cameras: Mapping[str, Camera], probes: Mapping[str, Probe]
) -> Measurement:
    kind, action, observation = str(group.attrs["kind"]), group["action"], group["observation"]
    if kind == "view":
        rgb = np.asarray(observation["rgb"][()], dtype=np.uint8) if "rgb" in observation else None
        camera = cameras[str(action.attrs["camera"])]
        return Measurement(View(camera), DepthImage(array(observation, "depth"), rgb))
    touch = Touch(*(array(observation, name) for name in ("times", "wrench", "world_from_peg")))
    if kind == "window":
        first, last = int(action.attrs["first"]), int(action.attrs["last"])
        return Measurement(ProbeWindow(probes[str(action.attrs["probe"])], first, last), touch)
    if kind == "push":
        return Measurement(Push(array(action, "times"), array(action, "world_from_tip")), touch)
    raise ValueError(f"measurement {group.name} is of unknown kind {kind!r}")
