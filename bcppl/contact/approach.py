"""The free approach: until the peg can touch the part, its motion is the same whatever the part's pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bcppl.contact.stepping import Clock, Rows, Standing
from bcppl.geometry.parts import Part

Array = npt.NDArray[np.float64]

_OUT_OF_REACH = np.array([[0.0, 0.0, 1e3, 1.0, 0.0, 0.0, 0.0]])
_MARGIN = 0.0001  # m: for what rounding there is in a mesh
_STRIDE = 8  # steps that are looked at together
_IN_VAIN = 30  # particles times stamps: what costs as much as beginning one more run


@dataclass(frozen=True, eq=False)
class Approach:
    """A probe in free motion.

    Attributes:
        rows: (T, 13) what is read at the stamps.
        standing: where the simulation stands after 0, 1, ... T stamps.
        path: (S, 7) the peg's poses at all steps: contacts are looked for at these and nowhere between.
        after: (T+1,) the step at which it stands after 0, 1, ... T stamps.
        on_time: it did not diverge.
    """

    rows: Array
    standing: Standing
    path: Array
    after: npt.NDArray[np.int64]
    on_time: bool


def free_approach(clock: Clock, stamps: int) -> Approach:
    """Simulate a probe of `stamps` stamps once, with the part out of reach."""
    rows, standing, path = clock.followed(_OUT_OF_REACH, stamps)
    after = np.array([clock.step_after(count) for count in range(stamps + 1)])
    return Approach(rows, standing, path, after, bool(clock.on_time(standing[-1:], stamps)[0]))


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

    Until then the peg's bounding box does not meet the part's at any step: along an axis of the one or of the
    other they are apart.

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
    first = _first_meeting(approach.path, _box(part), _box(peg), world_from_part, grip_from_peg)
    # The state at the step at which they meet is still that of free motion.
    return grouped(np.searchsorted(approach.after, first, side="right") - 1, stamps)


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes of the part and of the peg in the hand, centre (3,) and half sides (3,) in each one's frame."""

    part: tuple[Array, Array]
    peg: tuple[Array, Array]
    world_from_part: Array
    grip_from_peg: Array | None

    def meet(self, members: Rows, path: Array, grown: Array) -> npt.NDArray[np.bool_]:
        """Whether they may meet (M, S), for some particles, at poses (M or 1, S, 7) of the grip.

        The peg's box is grown by (S,) metres on all sides.
        """
        world = Rotation.from_quat(self.world_from_part[members][:, [4, 5, 6, 3]]).as_matrix()
        flat = path.reshape(-1, 7)
        turns = Rotation.from_quat(flat[:, [4, 5, 6, 3]]).as_matrix().reshape(*path.shape[:2], 3, 3)
        center, grown = self.peg[0], grown[..., None] + _MARGIN
        if self.grip_from_peg is not None:
            held = self.grip_from_peg[members]
            turned = Rotation.from_quat(held[:, [4, 5, 6, 3]]).as_matrix()[:, None]
            place = path[..., :3] + np.einsum("msij,mj->msi", turns, held[:, :3] + turned[:, 0] @ center)
            turns = turns @ turned
        else:
            place = path[..., :3] + turns @ center
        rotation = np.einsum("mji,msjk->msik", world, np.broadcast_to(turns, (len(world), *turns.shape[1:])))
        away = (place - self.world_from_part[members][:, None, :3]) @ world - self.part[0]
        size = np.abs(rotation)
        meets = (np.abs(away) <= size @ self.peg[1] + self.part[1] + grown).all(axis=-1)
        # Along the peg's own axes as well: the part sees a long peg that leans as a wide one.
        along = np.abs(np.einsum("msik,msi->msk", rotation, away))
        meets &= (along <= np.einsum("msik,i->msk", size, self.part[1]) + self.peg[1] + grown).all(axis=-1)
        return np.asarray(meets)


def _first_meeting(
    path: Array,
    part: tuple[Array, Array],
    peg: tuple[Array, Array],
    world_from_part: Array,
    grip_from_peg: Array | None,
) -> npt.NDArray[np.int64]:
    """The step (N,) at which the boxes may meet first, the number of steps where they never do.

    Every `_STRIDE`-th step is looked at with a box grown by what the peg moves until the next one;
    where that meets, the steps between are looked at.
    """
    steps, particles = len(path), len(world_from_part)
    boxes = _Boxes(part, peg, world_from_part, grip_from_peg)
    padded = np.concatenate([path, np.repeat(path[-1:], -steps % _STRIDE, axis=0)])
    spans = padded.reshape(-1, _STRIDE, 7)
    shifts = np.zeros((1, 3)) if grip_from_peg is None else grip_from_peg[:, :3]
    # No point of the peg is farther than this from the grip's origin, whichever way it is turned in the hand.
    radius = float(np.linalg.norm(shifts, axis=1).max() + np.linalg.norm(np.abs(peg[0]) + peg[1]))
    turn = Rotation.from_quat(padded[:, [4, 5, 6, 3]])
    angle = (turn[np.arange(len(padded)) // _STRIDE * _STRIDE].inv() * turn).magnitude()
    shift = np.linalg.norm(spans[:, :, :3] - spans[:, :1, :3], axis=-1)
    moved = (shift + radius * angle.reshape(-1, _STRIDE)).max(axis=1)
    near = boxes.meet(slice(None), spans[None, :, 0], moved)
    first = np.full(particles, steps, dtype=np.int64)
    undecided = np.flatnonzero(near.any(axis=1))
    while len(undecided):
        span = near[undecided].argmax(axis=1)
        meets = boxes.meet(undecided, spans[span], np.zeros(_STRIDE))
        found = meets.any(axis=1)
        first[undecided[found]] = np.minimum(span[found] * _STRIDE + meets[found].argmax(axis=1), steps)
        near[undecided, span] = False
        undecided = undecided[~found]
        undecided = undecided[near[undecided].any(axis=1)]
    return first


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
