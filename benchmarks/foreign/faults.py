"""The same recording cut and read otherwise, and faults: functions from a good recording to another one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import label, median_filter
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part, Piece
from bcppl.sensors.depth import DepthImage, View
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.probe import Probe, ProbeWindow, Touch
from foreign.world import windows

Fault = Callable[[Recording], Recording]

SEEN = 0.004  # m: a pixel nearer than the background by more shows the part
FELT, APART = 1.5, 0.05  # N beyond the zero, and s from a stamp at which so much is felt: the peg is free


# ---- the same probe, cut and read otherwise


def recut(recording: Recording, seconds: float) -> Recording:
    """The same probes, cut into windows of this length (at least one stamp)."""

    def cut(probe: Probe, touch: Touch) -> list[Measurement]:
        step = float(np.median(np.diff(probe.stamps)))
        return windows(probe, touch, max(1, round(seconds / step)))

    return _probed(recording, cut)


def resampled(recording: Recording, hertz: float) -> Recording:
    """The same motions, read at every k-th stamp, in windows as long as before.

    Raises:
        InputError: the rate does not divide that of the recording.
    """
    longest = max(float(np.ptp(m.observation.times)) for m in _windows(recording))

    def thinned(probe: Probe, touch: Touch) -> list[Measurement]:
        rate = 1.0 / float(np.median(np.diff(probe.stamps)))
        every = round(rate / hertz)
        if every < 1 or abs(every * hertz - rate) > 1e-3 * rate:
            raise InputError(
                f"probe {probe.name!r} is read at {rate:.4g} Hz; {hertz:g} Hz does not divide it."
            )
        fewer = Touch(*(column[::every] for column in _columns(touch)))
        return windows(replace(probe, stamps=probe.stamps[::every]), fewer, max(1, round(longest * hertz)))

    return _probed(recording, thinned)


# ---- faults


def part_moved(recording: Recording, distance: float = 0.02, heading: float = 0.7) -> Recording:
    """The part is moved along the table halfway through the touches: so is all that is met from then on.

    The peg's path is displaced smoothly while it is free. The truth is that of the first half.

    Raises:
        InputError: the peg is nowhere free for long enough between two touches.
    """
    shift = distance * np.array([np.cos(heading), np.sin(heading), 0.0])

    def moved(probe: Probe, touch: Touch) -> list[Measurement]:
        force = touch.wrench[:, :3] - np.median(touch.wrench[touch.times < touch.times[0] + 0.3, :3], axis=0)
        felt = touch.times[np.linalg.norm(force, axis=1) > FELT]
        # Moved before the first touch, all touches would agree, and cameras that are off explain it.
        between = np.linspace(*felt[[0, -1]], 1001) if len(felt) else felt
        away = np.array([np.abs(felt - t).min() for t in between])
        if away.max(initial=0.0) < APART:
            raise InputError("the peg is nowhere free between two touches; take another recording.")
        free = np.flatnonzero(away >= APART)
        nearest = free[np.abs(free - 0.5 * len(between)).argmin()]
        middle, lasts = between[nearest], away[nearest]

        def displaced(poses: Array, times: Array) -> Array:
            share = np.clip((times - middle) / lasts + 0.5, 0.0, 1.0)
            smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
            return np.hstack([poses[:, :3] + smooth[:, None] * shift, poses[:, 3:]])

        path = displaced(touch.world_from_peg, touch.times)
        commanded = replace(probe, command=displaced(probe.command, probe.command_times))
        return windows(commanded, replace(touch, world_from_peg=path), _step(recording))

    return _probed(recording, moved)


def truth_outside(recording: Recording, beyond: float = 0.01, axis: int = 0) -> Recording:
    """The guess is shifted so that the truth is outside its box, by `beyond` along an axis of the world."""
    place = np.array(recording.guess.world_from_part)
    side = 1.0 if recording.truth[axis] >= place[axis] else -1.0
    place[axis] = recording.truth[axis] - side * (recording.guess.translation[axis] + beyond)
    return replace(recording, guess=replace(recording.guess, world_from_part=place))


def truth_at_edge(recording: Recording) -> Recording:
    """The guess is shifted so that the truth is just within a face of its box."""
    return truth_outside(recording, beyond=-1e-4)


def part_mirrored(recording: Recording) -> Recording:
    """The part's mesh and pieces are those of its mirror image in the y-z plane of its frame."""
    return replace(recording, part=mapped(recording.part, np.diag([-1.0, 1.0, 1.0])))


def part_turned(recording: Recording) -> Recording:
    """The part's mesh and pieces are turned by 90 degrees about z in their frame, not the part itself."""
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return replace(recording, part=mapped(recording.part, turned))


def part_scaled(recording: Recording, factor: float = 1.1) -> Recording:
    """The part's mesh and pieces are larger than the part by a factor, about their frame's origin."""
    return replace(recording, part=mapped(recording.part, factor * np.eye(3)))


def view_repeated(recording: Recording, times: int = 10) -> Recording:
    """The first view is given so many times, the same image of the same camera; nothing else changes."""
    first, *rest = recording.measurements
    return replace(recording, measurements=[first] * times + rest)


def touches_repeated(recording: Recording, times: int = 2) -> Recording:
    """All windows of every probe are given so many times, from the second time on under another name."""

    def repeated(probe: Probe, touch: Touch) -> list[Measurement]:
        names = [probe.name, *(f"{probe.name}, again {k}" for k in range(1, times))]
        return [m for name in names for m in windows(replace(probe, name=name), touch, _step(recording))]

    return _probed(recording, repeated)


def camera_off(recording: Recording, distance: float = 0.015) -> Recording:
    """The first view's camera is stated beside its place, by `distance` along the image's rows."""
    first, *rest = recording.measurements
    camera: Camera = first.action.camera
    pose = np.array(camera.world_from_camera)
    pose[:3] += distance * Rotation.from_quat(pose[3:], scalar_first=True).apply([1.0, 0.0, 0.0])
    moved = Measurement(View(replace(camera, world_from_camera=pose)), first.observation)
    return replace(recording, measurements=[moved, *rest])


def part_occluded(recording: Recording, share: float = 1.0 / 3.0) -> Recording:
    """A box stands before the part in the first view and hides the left share of its pixels.

    Raises:
        InputError: the first view's background is unknown, or the part is not seen.
    """
    first, *rest = recording.measurements
    name, depth = first.action.camera.name, np.array(first.observation.depth)
    before = recording.background.get(name, depth) - depth
    pieces, count = label(median_filter(np.nan_to_num(before), 3) > SEEN)
    if count == 0:
        raise InputError(f"view {name!r} shows no part before a known background; take another recording.")
    part = pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:])  # the largest: others are noise
    rows, columns = np.nonzero(part)
    last = round(float(np.quantile(columns, share)))
    block = np.s_[max(rows.min() - 8, 0) : rows.max() + 9, max(columns.min() - 8, 0) : last]
    front = np.nanquantile(depth[part], 0.02) - 0.05
    noise = np.random.default_rng(0).laplace(0.0, 0.001, depth.shape).astype(depth.dtype)
    depth[block] = front + noise[block]
    hidden = Measurement(first.action, DepthImage(depth, first.observation.rgb))
    return replace(recording, measurements=[hidden, *rest])


FAULTS: dict[str, Fault] = {
    "part moved by 20 mm halfway": part_moved,
    "truth 10 mm outside the guess": truth_outside,
    "truth at the guess's edge": truth_at_edge,
    "part's mesh mirrored": part_mirrored,
    "part's mesh turned by 90 deg": part_turned,
    "part's mesh scaled by 1.1": part_scaled,
    "first view given ten times": view_repeated,
    "probe given twice": touches_repeated,
    "first camera 15 mm off": camera_off,
    "a third of the part occluded": part_occluded,
}


def mapped(part: Part, linear: Array) -> Part:
    """The part under a linear map (3, 3): each piece becomes a hull."""
    faces = part.faces if np.linalg.det(linear) > 0.0 else part.faces[:, ::-1]
    pieces = [Piece("hull", _corners(piece) @ linear.T) for piece in part.pieces]
    return replace(part, vertices=part.vertices @ linear.T, faces=faces, pieces=pieces)


def _corners(piece: Piece) -> Array:
    if piece.kind == "hull":
        return piece.size
    if piece.kind != "box":
        raise InputError(f"a {piece.kind} among the part's pieces has no corners; give boxes and hulls.")
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return np.asarray(signs * piece.size + piece.center)


def _windows(recording: Recording) -> list[Measurement]:
    return [m for m in recording.measurements if isinstance(m.action, ProbeWindow)]


def _columns(touch: Touch) -> tuple[Array, Array, Array]:
    return touch.times, touch.wrench, touch.world_from_peg


def _step(recording: Recording) -> int:
    """Stamps of a window: the most of any."""
    return max(m.action.last - m.action.first for m in _windows(recording))


def _probed(recording: Recording, remade: Callable[[Probe, Touch], Sequence[Measurement]]) -> Recording:
    """The recording with each probe's windows replaced, after all that is no window."""
    others = [m for m in recording.measurements if not isinstance(m.action, ProbeWindow)]
    by_name: dict[str, list[Measurement]] = {}
    for measurement in _windows(recording):
        by_name.setdefault(measurement.action.probe.name, []).append(measurement)
    made: list[Measurement] = []
    for several in by_name.values():
        whole = zip(*(_columns(m.observation) for m in several), strict=True)
        made += remade(several[0].action.probe, Touch(*(np.concatenate(column) for column in whole)))
    return replace(recording, measurements=[*others, *made])
