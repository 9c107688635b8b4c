"""Free motion: until the peg can touch the part, its motion does not depend on the part's pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array, Indices, Mask, Rows
from bcppl.contact.stepping import SimulationState, Stepper
from bcppl.geometry.parts import Part

_OUT_OF_REACH = np.array([[0.0, 0.0, 1e3, 1.0, 0.0, 0.0, 0.0]])
_MARGIN = 0.0001  # m: for the rounding of a mesh
_STRIDE = 8  # steps that are tested together
_IN_VAIN = 30  # particles times stamps that cost as much as one more run


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """A probe in free motion: sensor rows (T, 16) at the stamps, and whether it did not diverge.

    States and the number of steps (T+1,) are those after 0, 1, ... T stamps; the path (S, 7) is the peg's at
    all steps, at which alone contacts are detected.
    """

    rows: Array
    states: SimulationState
    path: Array
    after: Indices
    on_time: bool


def simulate_free_motion(stepper: Stepper, stamps: int) -> FreeMotion:
    """A probe of `stamps` stamps, simulated once with the part out of reach."""
    rows, states, path = stepper.trajectory(_OUT_OF_REACH, stamps)
    after = np.array([stepper.step_after(count) for count in range(stamps + 1)])
    return FreeMotion(rows, states, path, after, bool(stepper.on_time(states[-1:], stamps)[0]))


def _box(part: Part) -> tuple[Array, Array]:
    """Centre (3,) and half sides (3,) of a part's bounding box, of mesh and pieces."""
    # A drawn prism may lie within the cylinder that is touched.
    points = np.concatenate([part.vertices, *(piece.bounds for piece in part.pieces)])
    low, high = points.min(axis=0), points.max(axis=0)
    return 0.5 * (low + high), 0.5 * (high - low)


def first_possible_contact(
    free: FreeMotion, part: Part, peg: Part, world_from_part: Array, grip_from_peg: Array | None = None
) -> Indices:
    """The number of stamps (N,) of free motion, for poses (N, 7) of the part and of the peg in the hand.

    Up to there the peg's bounding box does not overlap the part's at any step: an axis of the one or of the
    other separates them.
    """
    stamps = len(free.rows)
    if not free.on_time or stamps == 0:
        return np.zeros(len(world_from_part), dtype=np.int64)
    first = _first_overlap(free.path, _Boxes(_box(part), _box(peg), world_from_part, grip_from_peg))
    # The state at the step of the first overlap is still that of free motion.
    return grouped(np.searchsorted(free.after, first, side="right") - 1, stamps)


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes of the part and of the peg in the hand, centre (3,) and half sides (3,) in each one's frame."""

    part: tuple[Array, Array]
    peg: tuple[Array, Array]
    world_from_part: Array
    grip_from_peg: Array | None

    def overlap(self, members: Rows, path: Array, grown: Array) -> Mask:
        """Whether they may overlap (M, S), for some particles, at poses (M or 1, S, 7) of the grip.

        The peg's box is grown by (S,) metres on all sides.
        """
        world = _rotation(self.world_from_part[members]).as_matrix()
        turns = _rotation(path.reshape(-1, 7)).as_matrix().reshape(*path.shape[:2], 3, 3)
        center, grown = self.peg[0], grown[..., None] + _MARGIN
        if self.grip_from_peg is not None:
            held = self.grip_from_peg[members]
            turned = _rotation(held).as_matrix()[:, None]
            place = path[..., :3] + np.einsum("msij,mj->msi", turns, held[:, :3] + turned[:, 0] @ center)
            turns = turns @ turned
        else:
            place = path[..., :3] + turns @ center
        rotation = np.einsum("mji,msjk->msik", world, np.broadcast_to(turns, (len(world), *turns.shape[1:])))
        away = (place - self.world_from_part[members][:, None, :3]) @ world - self.part[0]
        size = np.abs(rotation)
        overlaps = (np.abs(away) <= size @ self.peg[1] + self.part[1] + grown).all(axis=-1)
        # Along the peg's own axes, too: along the part's alone, a long peg that leans is a wide one.
        along = np.abs(np.einsum("msik,msi->msk", rotation, away))
        overlaps &= (along <= np.einsum("msik,i->msk", size, self.part[1]) + self.peg[1] + grown).all(axis=-1)
        return np.asarray(overlaps)


def _first_overlap(path: Array, boxes: _Boxes) -> Indices:
    """The step (N,) at which the boxes may first overlap, the number of steps where they never do.

    Every `_STRIDE`-th step is tested with a box grown by the peg's motion until the next one; where that
    overlaps, the steps between are tested.
    """
    steps, particles = len(path), len(boxes.world_from_part)
    padded = np.concatenate([path, np.repeat(path[-1:], -steps % _STRIDE, axis=0)])
    spans = padded.reshape(-1, _STRIDE, 7)
    shifts = np.zeros((1, 3)) if boxes.grip_from_peg is None else boxes.grip_from_peg[:, :3]
    # No point of the peg is farther than this from the grip's origin, whatever its rotation in the hand.
    reach = np.linalg.norm(np.abs(boxes.peg[0]) + boxes.peg[1])
    radius = float(np.linalg.norm(shifts, axis=1).max() + reach)
    turn = _rotation(padded)
    angle = (turn[np.arange(len(padded)) // _STRIDE * _STRIDE].inv() * turn).magnitude()
    shift = np.linalg.norm(spans[:, :, :3] - spans[:, :1, :3], axis=-1)
    moved = (shift + radius * angle.reshape(-1, _STRIDE)).max(axis=1)
    near = boxes.overlap(slice(None), spans[None, :, 0], moved)
    first = np.full(particles, steps, dtype=np.int64)
    undecided = np.flatnonzero(near.any(axis=1))
    while len(undecided):
        span = near[undecided].argmax(axis=1)
        overlaps = boxes.overlap(undecided, spans[span], np.zeros(_STRIDE))
        decided = overlaps.any(axis=1)
        first[undecided[decided]] = np.minimum(
            span[decided] * _STRIDE + overlaps[decided].argmax(axis=1), steps
        )
        near[undecided, span] = False
        undecided = undecided[~decided]
        undecided = undecided[near[undecided].any(axis=1)]
    return first


def grouped(first: Indices, stamps: int) -> Indices:
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


def _rotation(pose: Array) -> Rotation:
    return Rotation.from_quat(pose[..., [4, 5, 6, 3]])
