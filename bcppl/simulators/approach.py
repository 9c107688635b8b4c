"""The free approach: until the peg can touch the part, its motion is the same whatever the part's pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bcppl.parts import Part
from bcppl.simulators.stepping import POSE, Clock, Standing

Array = npt.NDArray[np.float64]

_OUT_OF_REACH = np.array([[0.0, 0.0, 1e3, 1.0, 0.0, 0.0, 0.0]])
_MARGIN = 0.002  # m
_IN_VAIN = 30  # particles times stamps: what costs as much as beginning one more run


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
    rows, standing = clock.followed(_OUT_OF_REACH, stamps)
    return Approach(rows, standing, bool(clock.on_time(standing[-1:], stamps)[0]))


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
    approach: Approach, part: Part, peg: Part, world_from_part: Array, grip_from_peg: Array | None = None
) -> npt.NDArray[np.int64]:
    """The number of stamps (N,) that a probe can be read in free motion, for poses (N, 7) of the part.

    The peg's bounding box, seen in the part's axes and grown by 2 mm and by what it moves until the next
    stamp, does not meet the part's.

    Args:
        approach: the probe in free motion.
        part: what is touched.
        peg: what is held.
        world_from_part: (N, 7).
        grip_from_peg: (N, 7) where the peg is in the hand; None for where it should be.
    """
    stamps = len(approach.rows)
    if not approach.on_time or stamps == 0:
        return np.zeros(len(world_from_part), dtype=np.int64)
    pose = approach.rows[:, POSE]
    turn = Rotation.from_quat(pose[:, [4, 5, 6, 3]])
    peg_center, peg_half = _box(peg)
    part_center, part_half = _box(part)
    held, held_from_peg = peg_center[None], np.eye(3)[None]
    if grip_from_peg is not None:
        held_from_peg = Rotation.from_quat(grip_from_peg[:, [4, 5, 6, 3]]).as_matrix()
        held = grip_from_peg[:, :3] + held_from_peg @ peg_center
    radius = float(np.linalg.norm(held, axis=1).max() + np.linalg.norm(peg_half))
    moved = (
        np.linalg.norm(np.diff(pose[:, :3], axis=0), axis=1)
        + radius * (turn[:-1].inv() * turn[1:]).magnitude()
    )
    grown = _MARGIN + np.append(moved, 0.0)
    world = Rotation.from_quat(world_from_part[:, [4, 5, 6, 3]]).as_matrix()
    part_from_world = world.swapaxes(1, 2)
    # One matrix product for all stamps: (N, 3, 3) times (3, 3 T).
    turns = turn.as_matrix().transpose(1, 0, 2).reshape(3, -1)
    rotation = (part_from_world @ turns).reshape(-1, 3, stamps, 3)
    path = (pose[None, :, :3] - world_from_part[:, None, :3]) @ world
    relative = path + np.einsum("nitk,nk->nti", rotation, np.broadcast_to(held, (len(path), 3))) - part_center
    if grip_from_peg is not None:
        rotation = np.einsum("nitk,nkj->nitj", rotation, held_from_peg)
    reach = (np.abs(rotation) @ peg_half).swapaxes(1, 2) + part_half + grown[None, :, None]
    meets = (np.abs(relative) <= reach).all(axis=-1)
    first = np.where(meets.any(axis=1), meets.argmax(axis=1), stamps)
    return grouped(first.astype(np.int64), stamps)


def grouped(first: npt.NDArray[np.int64], stamps: int) -> npt.NDArray[np.int64]:
    """Starts (N,) moved earlier so that particles start together: few, long runs are the fastest.

    A group is closed when its particles together would run `_IN_VAIN` stamps more than they need.
    """
    starts, counts = np.unique(first[first < stamps], return_counts=True)
    together = np.full(stamps + 1, stamps, dtype=np.int64)
    begin, wasted = 0, np.inf
    for start, count in zip(starts.tolist(), counts.tolist(), strict=True):
        wasted += count * (start - begin)
        if wasted > _IN_VAIN:
            begin, wasted = start, 0
        together[start] = begin
    return together[first]
