"""The free approach: until the peg can touch the part, its motion is the same whatever the part's pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bcppl.parts import Part
from bcppl.simulators.peg_model import SENSED
from bcppl.simulators.stepping import POSE, Clock, Standing

Array = npt.NDArray[np.float64]

_OUT_OF_REACH = np.array([[0.0, 0.0, 1e3, 1.0, 0.0, 0.0, 0.0]])
_MARGIN = 0.002  # m
_GROUPS = 24  # particles start together at the latest of this many stamps: few, long runs are the fastest


@dataclass(frozen=True, eq=False)
class Approach:
    """A probe in free motion.

    Attributes:
        rows: (T, 13) what is read at the stamps.
        standing: where the simulation stands after 0, 1, ... T stamps.
        on_time: it did not diverge.
    """

    rows: Array
    standing: Standing
    on_time: bool


def free_approach(clock: Clock, stamps: int) -> Approach:
    """Simulate a probe of `stamps` stamps once, with the part out of reach."""
    standing = clock.beginning(1)
    standings, rows = [standing], np.empty((stamps, SENSED))
    for stamp in range(stamps):
        row, standing = clock.read(standing, _OUT_OF_REACH, stamp, stamp + 1)
        rows[stamp] = row[0, 0]
        standings.append(standing)
    return Approach(
        rows,
        Standing(np.concatenate([s.state for s in standings]), np.concatenate([s.tail for s in standings])),
        bool(clock.on_time(standing, stamps)[0]),
    )


def _box(part: Part) -> tuple[Array, Array]:
    points = [part.vertices]
    # A drawn prism may lie within the cylinder that is touched.
    for piece in part.pieces:
        if piece.kind == "hull":
            points.append(np.asarray(piece.size))
        else:
            half = piece.size if piece.kind == "box" else np.asarray(piece.size)[[0, 0, 1]]
            points += [piece.center[None] - half, piece.center[None] + half]
    low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    return 0.5 * (low + high), 0.5 * (high - low)


def first_possible_touch(
    approach: Approach, part: Part, peg: Part, world_from_part: Array
) -> npt.NDArray[np.int64]:
    """The number of stamps (N,) that a probe can be read in free motion, for poses (N, 7) of the part.

    The peg's bounding box, seen in the part's axes and grown by 2 mm and by what it moves until the next
    stamp, does not meet the part's.
    """
    stamps = len(approach.rows)
    if not approach.on_time:
        return np.zeros(len(world_from_part), dtype=np.int64)
    pose = approach.rows[:, POSE]
    turn = Rotation.from_quat(pose[:, [4, 5, 6, 3]])
    peg_center, peg_half = _box(peg)
    part_center, part_half = _box(part)
    radius = float(np.linalg.norm(np.abs(peg_center) + peg_half))
    moved = (
        np.linalg.norm(np.diff(pose[:, :3], axis=0), axis=1)
        + radius * (turn[:-1].inv() * turn[1:]).magnitude()
    )
    grown = _MARGIN + np.append(moved, 0.0) if stamps else np.zeros(0)
    world = Rotation.from_quat(world_from_part[:, [4, 5, 6, 3]]).as_matrix()
    center = pose[:, :3] + turn.apply(peg_center) if stamps else np.zeros((0, 3))
    relative = np.einsum("nji,ntj->nti", world, center[None] - world_from_part[:, None, :3]) - part_center
    rotation = np.abs(np.einsum("nji,tjk->ntik", world, turn.as_matrix()))
    reach = rotation @ peg_half + part_half + grown[None, :, None]
    meets = (np.abs(relative) <= reach).all(axis=-1)
    first = np.where(meets.any(axis=1), meets.argmax(axis=1), stamps)
    stride = max(1, -(-stamps // _GROUPS))
    return np.where(first < stamps, first // stride * stride, stamps)
