"""Whether a recording's truth is true: the gap between peg and part at the measured poses, by geometry alone.

Of a right recording it is zero, but for penetration and the encoders' noise, wherever the recorded force says
that the peg stands against the part, and positive wherever the peg is free.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from trimesh.proximity import signed_distance

from bcppl.arrays import Array
from bcppl.geometry.parts import Part
from bcppl.sensors.measurements import Recording
from bcppl.sensors.probe import ProbeWindow

PRESSED, SLOW = 2.0, 0.02  # N and m/s: a stamp with more force and less speed is one of contact
FREE = 0.004  # m: beyond it a gap is not computed exactly
REST = 0.3  # s at the start, in which the wrench is the sensor's zero
CUTS = 40  # of an edge, each by a third: to within a nanometre


class Gaps(NamedTuple):
    """Gaps (T,) in metres, negative in penetration, at most `FREE`; which stamps (T,) are of contact."""

    gap: Array
    contact: npt.NDArray[np.bool_]


def gaps_of(recording: Recording) -> Gaps:
    """The gaps of the recording's first probe at the recording's truth."""
    windows = [m for m in recording.measurements if isinstance(m.action, ProbeWindow)]
    windows = [m for m in windows if m.action.probe.name == windows[0].action.probe.name]
    times, wrench, pose = (
        np.concatenate([getattr(m.observation, name) for m in windows])
        for name in ("times", "wrench", "world_from_peg")
    )
    force = wrench[:, :3] - np.median(wrench[times < times[0] + REST, :3], axis=0)
    # The differences of neighbouring stamps are mostly the encoders' noise: over 20 ms they are a speed.
    apart = max(1, round(0.01 / np.median(np.diff(times))))
    before, after = (
        np.maximum(np.arange(len(times)) - apart, 0),
        np.minimum(np.arange(len(times)) + apart, len(times) - 1),
    )
    speed = np.linalg.norm(pose[after, :3] - pose[before, :3], axis=1) / (times[after] - times[before])
    contact = (np.linalg.norm(force, axis=1) > PRESSED) & (speed < SLOW)
    turn = Rotation.from_quat(recording.truth[3:], scalar_first=True).inv()
    place = turn.apply(pose[:, :3] - recording.truth[:3])
    rotation = turn * Rotation.from_quat(pose[:, 3:], scalar_first=True)
    gap = np.array([_gap(recording.part, recording.peg, p, r) for p, r in zip(place, rotation, strict=True)])
    return Gaps(gap, contact)


def _gap(part: Part, peg: Part, place: Array, rotation: Rotation) -> float:
    """The gap of a convex peg at a place in the part's frame; beyond the nearest features a lower bound.

    Of two polyhedra that meet, a vertex of the one is in the other, or an edge of the other in the one.
    """
    normals = np.unique(np.round(peg.mesh.face_normals, 6), axis=0)
    levels = (normals @ peg.vertices.T).max(axis=1)
    ends = rotation.inv().apply(part.vertices - place)[part.mesh.edges_unique]
    middle, reach = ends.mean(axis=1), 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    near = (middle @ normals.T - levels).max(axis=1) - reach < FREE
    gap = FREE
    if near.any():
        gap = min(gap, float(_least(ends[near], normals, levels).min()))
    vertices = rotation.apply(peg.vertices) + place
    low, high = part.vertices.min(axis=0) - FREE, part.vertices.max(axis=0) + FREE
    vertices = vertices[((vertices > low) & (vertices < high)).all(axis=1)]
    if len(vertices):
        gap = min(gap, -float(signed_distance(part.mesh, vertices).max()))
    return gap


def _least(ends: Array, normals: Array, levels: Array) -> Array:
    """The least height (E,) of points of edges (E, 2, 3) above a convex body's planes, by ternary search."""
    low, high = np.zeros(len(ends)), np.ones(len(ends))
    starts, along = ends[:, 0] @ normals.T - levels, (ends[:, 1] - ends[:, 0]) @ normals.T
    for _ in range(CUTS):
        first, second = low + (high - low) / 3.0, high - (high - low) / 3.0
        left, right = ((starts + t[:, None] * along).max(axis=1) for t in (first, second))
        low, high = np.where(left > right, first, low), np.where(left > right, high, second)
    return np.asarray((starts + (0.5 * (low + high))[:, None] * along).max(axis=1))


COLUMNS = ("contact stamps", "5 % um", "median um", "95 % um", "worst um", "free stamps", "least um")


def summary(several: Sequence[Gaps]) -> list[float]:
    """For `COLUMNS`: gaps of stamps in contact, and the least gap of the others, over recordings."""
    gap, contact = (np.concatenate(column) for column in zip(*several, strict=True))
    pressed, free = 1e6 * gap[contact], 1e6 * gap[~contact]
    worst = pressed[np.abs(pressed).argmax()]
    return [
        int(contact.sum()),
        *np.quantile(pressed, [0.05, 0.5, 0.95]),
        worst,
        int((~contact).sum()),
        free.min(),
    ]
