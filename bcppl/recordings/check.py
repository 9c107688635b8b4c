"""Checks a recording before anything is inferred from it: each problem is one sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.distortion import coefficients
from bcppl.geometry.guess import Guess
from bcppl.geometry.parts import LARGEST_EXTENT, Part
from bcppl.poses import as_pose, inverse, transform
from bcppl.recordings.file import same
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.robot.plan import FARTHEST
from bcppl.sensors.measurements import DepthImage, Push, Recording, View

Array = npt.NDArray[np.float64]

MOST_FORCE = 1e4  # N or N m: beyond it a sensor would have been torn off, so the units are wrong
MOST_DEPTH = 100.0  # m: beyond it a median depth is in millimetres
SAME_TIME = 1e-6  # s: two clocks that were copied agree to this
LEAVE_OUT, FILL = "leave that row out", "fill it by interpolation, or cut the recording there"


def problems(recording: Recording) -> list[str]:
    """Everything that is wrong with a recording, one sentence each; empty where nothing is."""
    return list(_problems(recording))


def validate(recording: Recording) -> None:
    """Refuse a recording that has a problem.

    Raises:
        InputError: the first of `problems`.
    """
    for problem in _problems(recording):
        raise InputError(problem)


def notes(recording: Recording) -> list[str]:
    """What is worth knowing about a recording but does not stop inference, one sentence each."""
    if _touched(recording) or not _has_mesh(recording.part) or recording.part.mesh.is_watertight:
        return []
    return [f"part {recording.part.name!r} has an open mesh: it can be looked at, as here, but not touched."]


def _touched(recording: Recording) -> bool:
    return any(not isinstance(m.action, View) for m in recording.measurements)


def _has_mesh(part: Part) -> bool:
    return not list(_part(part, closed=False))


def _problems(recording: Recording) -> Iterator[str]:
    yield from _part(recording.part, closed=_touched(recording))
    if recording.peg is not None:
        yield from _part(recording.peg, closed=True)
    yield from _guess(recording.guess)
    if recording.truth is not None:
        yield from _pose("the truth (world_from_part)", recording.truth)
    if not recording.measurements:
        yield "the recording holds no measurement; record at least one view, probe window or push."
    cameras: dict[str, Camera] = {}
    probes: dict[str, Probe] = {}
    ends: dict[str, int] = {}
    for index, measurement in enumerate(recording.measurements):
        where = f"measurement {index}"
        match measurement.action, measurement.observation:
            case View(camera), DepthImage(depth, rgb):
                if camera.name not in cameras:
                    cameras[camera.name] = camera
                    yield from _camera(f"{where}: camera {camera.name!r}", camera, recording)
                elif not same(cameras[camera.name], camera):
                    yield f"{where}: camera {camera.name!r} differs from an earlier one; name it otherwise."
                yield from _depth(where, depth, camera)
                if rgb is not None and rgb.shape != (camera.height, camera.width, 3):
                    yield f"{where}: the colour image is {rgb.shape}, its camera {_frame(camera)} pixels."
            case ProbeWindow(probe=probe) as window, Touch() as touch:
                if recording.peg is None:
                    yield f"{where} is a probe window but the recording has no peg; say what was held."
                if probe.name not in probes:
                    probes[probe.name] = probe
                    yield from _probe(f"{where}: probe {probe.name!r}", probe)
                elif not same(probes[probe.name], probe):
                    yield f"{where}: probe {probe.name!r} differs from an earlier one; name it otherwise."
                yield from _touch(where, touch, poses=True)
                yield from _window(where, window, touch, ends.get(probe.name, 0))
                ends[probe.name] = max(window.last, ends.get(probe.name, 0))
            case Push() as push, Touch() as touch:
                yield from _push(where, push)
                yield from _touch(where, touch, poses=False)
                yield from _push_covers(where, push, touch)
            case action, observation:
                yield (
                    f"{where} pairs a {type(action).__name__} with a {type(observation).__name__}; "
                    "a view is observed as a depth image, a window or push as a touch."
                )
    for name, depth in recording.background.items():
        if name in cameras and depth.shape != (cameras[name].height, cameras[name].width):
            pixels = _frame(cameras[name])
            yield f"the background of camera {name!r} is {_size(depth)}, the camera {pixels} pixels."


# ---- what is there before any measurement


def _part(part: Part, closed: bool) -> Iterator[str]:
    if (
        part.vertices.ndim != 2
        or part.vertices.shape[1] != 3
        or part.faces.ndim != 2
        or part.faces.shape[1] != 3
    ):
        yield (
            f"part {part.name!r} has vertices {part.vertices.shape} and faces {part.faces.shape}; "
            "give (V, 3) and triangles (F, 3)."
        )
        return
    try:
        part.check(closed=closed)
    except InputError as error:
        yield str(error)


def _guess(guess: Guess) -> Iterator[str]:
    yield from _pose("the guess (world_from_part)", guess.world_from_part)
    widths = np.asarray(guess.translation)
    if widths.shape != (3,) or not np.isfinite(widths).all():
        yield "the guess's translation is not three finite half widths; give them in metres along x, y and z."
    elif (widths < 0).any():
        yield f"the guess has a negative half width ({widths.min():.4g} m); give 0 to hold an axis fixed."
    elif (widths > LARGEST_EXTENT).any():
        yield f"the guess is {widths.max():.4g} m wide, probably in millimetres; scale it by 0.001 to metres."
    for name in ("tilt", "yaw", "angle"):
        limit = getattr(guess, name)
        if limit is None:
            continue
        if not math.isfinite(limit) or limit < 0:
            yield f"the guess's {name} is {limit:.4g}; give a limit of at least 0, in radians."
        elif limit > math.pi + 1e-9:
            yield f"the guess's {name} is {limit:.4g} rad, probably degrees; give radians below pi."


def _pose(what: str, values: Array) -> Iterator[str]:
    """Problems of one pose (7,), or of rows of poses (R, 7)."""
    try:
        as_pose(values, what)
    except InputError as error:
        yield str(error)


def _camera(what: str, camera: Camera, recording: Recording) -> Iterator[str]:
    if camera.width < 1 or camera.height < 1 or not (camera.fx > 0 and camera.fy > 0):
        yield f"{what} has no pixels or no focal length; give its width, height, fx and fy in pixels."
    elif not np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all():
        yield f"{what} has intrinsics that are not finite; give fx, fy, cx and cy in pixels."
    elif camera.distortion:
        yield from _distortion(what, camera)
    if camera.wrist_from_camera is not None:
        yield from _pose(f"{what}'s wrist_from_camera", camera.wrist_from_camera)
    if not 0 <= camera.near < camera.far:
        yield f"{what} sees from {camera.near:.4g} m to {camera.far:.4g} m; give near below far, in metres."
    wrong = list(_pose(f"{what}'s world_from_camera", camera.world_from_camera))
    yield from wrong
    poses_known = not wrong and not list(_pose("guess", recording.guess.world_from_part))
    if poses_known and _has_mesh(recording.part):
        yield from _stands_off(what, camera, recording)


def _distortion(what: str, camera: Camera) -> Iterator[str]:
    try:
        coefficients(tuple(camera.distortion))
        camera.rays()
    except InputError as error:
        yield f"{what}: {error}"


def _stands_off(what: str, camera: Camera, recording: Recording) -> Iterator[str]:
    """Where the camera stands, seen from the part at its guess: neither inside it nor out of its range."""
    part_from_world = inverse(as_pose(recording.guess.world_from_part))
    eye = transform(part_from_world, as_pose(camera.world_from_camera)[None, :3])[0].numpy()
    low, high = recording.part.vertices.min(axis=0), recording.part.vertices.max(axis=0)
    radius, middle = np.linalg.norm(high - low) / 2, (low + high) / 2
    away = np.linalg.norm(eye - middle)
    to_box = np.linalg.norm(np.maximum(0.0, np.maximum(low - eye, eye - high)))
    # A long part fills a wide sphere: only the box tells whether a camera beside it is too near.
    if away <= radius and to_box < max(camera.near, 1e-3):
        yield (
            f"{what} stands {1e3 * away:.0f} mm from the middle of the part at its guess, inside it (radius "
            f"{1e3 * radius:.0f} mm): probably wrong units; give its world_from_camera in metres."
        )
    elif away - radius - np.linalg.norm(recording.guess.translation) > camera.far:
        yield (
            f"{what} stands {away:.4g} m from the part at its guess but sees only to {camera.far:.4g} m: "
            "probably wrong units; give its world_from_camera in metres."
        )


# ---- measurements


def _size(image: Array) -> str:
    return f"{image.shape[1]}×{image.shape[0]}" if image.ndim == 2 else f"of shape {image.shape}"


def _frame(camera: Camera) -> str:
    return f"{camera.width}×{camera.height}"


def _depth(where: str, depth: Array, camera: Camera) -> Iterator[str]:
    if depth.shape != (camera.height, camera.width):
        yield (
            f"{where}: the depth image is {_size(depth)}, camera {camera.name!r} {_frame(camera)} pixels; "
            "give the camera that took it."
        )
        return
    read = depth[np.isfinite(depth) & (depth != 0)]
    if read.size == 0:
        yield f"{where}: the depth image is missing in every pixel; leave the view out."
    elif (read < 0).any():
        yield f"{where}: the depth image has {(read < 0).sum()} negative depths; mark what is missing by NaN."
    elif (middle := float(np.median(read))) > MOST_DEPTH:
        yield f"{where}: the median depth is {middle:.0f}, probably millimetres; scale it by 0.001 to metres."
    elif not ((read >= camera.near) & (read <= camera.far)).any():
        yield (
            f"{where}: no depth lies within the range of camera {camera.name!r}, {camera.near:.4g} to "
            f"{camera.far:.4g} m (median {middle:.4g} m); check the units and the range."
        )


def _times(what: str, times: Array, remedy: str = LEAVE_OUT) -> Iterator[str]:
    if times.ndim != 1 or times.size == 0:
        yield f"{what} has times of shape {times.shape}; give at least one time (T,), in seconds."
    elif not (finite := np.isfinite(times)).all():
        yield f"{what} has a time that is not finite at row {_first(~finite)}; {remedy}."
    elif (np.diff(times) <= 0).any():
        row = _first(np.diff(times) <= 0) + 1
        verb = "stand still" if times[row] == times[row - 1] else "run backwards"
        yield (
            f"{what} has times that {verb} at row {row} ({times[row]:.6f} s after {times[row - 1]:.6f} s); "
            "sort the rows and drop doubles."
        )


def _first(where: npt.ArrayLike) -> int:
    return int(np.argmax(where))


def _rows(what: str, poses: Array, times: Array, remedy: str = LEAVE_OUT) -> Iterator[str]:
    """Poses (R, 7), one for each of R times."""
    if poses.shape != (*times.shape, 7):
        yield f"{what} has {poses.shape} for {times.shape} times; give x y z qw qx qy qz for each time."
        return
    finite = np.isfinite(poses).all(axis=1)
    if not finite.all():
        yield f"{what} has a number that is not finite at row {_first(~finite)}; {remedy}."
        return
    length = np.linalg.norm(poses[:, 3:], axis=1)
    if (np.abs(length - 1) > 1e-3).any():
        row = _first(np.abs(length - 1) > 1e-3)
        yield f"{what} has a quaternion of length {length[row]:.4g} at row {row}; give it unit length."
    away = np.abs(poses[:, :3]).max(axis=1)
    if (away > FARTHEST).any():
        yield (
            f"{what} is {away.max():.4g} m from the world's origin at row {int(away.argmax())}, probably "
            "millimetres; scale x, y and z by 0.001 to metres."
        )


def _probe(what: str, probe: Probe) -> Iterator[str]:
    yield from _times(f"{what}'s command", probe.command_times)
    yield from _rows(f"{what}'s command (world_from_peg)", probe.command, probe.command_times)
    yield from _times(f"{what}'s stamps", probe.stamps, FILL)
    for name, values in (("stiffness", probe.stiffness), ("damping", probe.damping)):
        if values.shape != (6,) or not np.isfinite(values).all() or (values < 0).any():
            yield f"{what} has a {name} that is not six finite numbers of at least 0; give one for each axis."


def _window(where: str, window: ProbeWindow, touch: Touch, end: int) -> Iterator[str]:
    first, last, stamps = window.first, window.last, window.probe.stamps
    span = f"{where}: window {first} to {last} of probe {window.probe.name!r}"
    if stamps.ndim != 1:
        return
    if not 0 <= first < last <= len(stamps):
        yield f"{span} does not lie within its {len(stamps)} stamps; give 0 <= first < last <= {len(stamps)}."
        return
    if first < end:
        yield f"{span} begins before an earlier window ended, at {end}; give them in order, without overlap."
    if first > end:
        yield (
            f"{span} leaves out stamps {end} to {first}; keep every window from the probe's start, "
            "for the first ones tell the sensor's zero."
        )
    if touch.times.shape != (last - first,):
        yield f"{span} holds {touch.times.size} wrench times, not {last - first}; read them at the stamps."
    elif (far := np.abs(touch.times - stamps[first:last]) > SAME_TIME).any():
        row = _first(far)
        yield (
            f"{span} has wrench time {touch.times[row]:.6f} s at row {row} where the probe's stamp is "
            f"{stamps[first + row]:.6f} s; read wrenches at the probe's stamps."
        )


def _push(where: str, push: Push) -> Iterator[str]:
    yield from _times(f"{where}'s finger path", push.times)
    yield from _rows(f"{where}'s finger path (world_from_tip)", push.world_from_tip, push.times)


def _push_covers(where: str, push: Push, touch: Touch) -> Iterator[str]:
    if push.times.ndim != 1 or touch.times.ndim != 1 or 0 in (push.times.size, touch.times.size):
        return
    if touch.times[-1] < push.times[0] or touch.times[0] > push.times[-1]:
        yield (
            f"{where}: wrench times {touch.times[0]:.3f} to {touch.times[-1]:.3f} s do not meet the "
            f"finger path's {push.times[0]:.3f} to {push.times[-1]:.3f} s; give both on one clock."
        )


def _touch(where: str, touch: Touch, poses: bool) -> Iterator[str]:
    # A window is read at an even rate, at its probe's stamps: without a row it would fit neither.
    remedy = FILL if poses else LEAVE_OUT
    yield from _times(f"{where}'s wrench", touch.times, remedy)
    if poses:
        yield from _rows(f"{where}'s peg pose (world_from_peg)", touch.world_from_peg, touch.times, remedy)
    if touch.wrench.shape != (*touch.times.shape, 6):
        yield (
            f"{where} has wrenches {touch.wrench.shape} for {touch.times.shape} times; "
            "give one row of force, then torque, for each time."
        )
        return
    finite = np.isfinite(touch.wrench).all(axis=1)
    if not finite.all():
        yield f"{where} has a wrench that is not finite at row {_first(~finite)}; {remedy}."
        return
    largest = np.abs(touch.wrench).max(axis=1)
    if (largest > MOST_FORCE).any():
        row = _first(largest > MOST_FORCE)
        yield f"{where} has a wrench of {largest[row]:.3g} at row {row}; give newtons and newton metres."
