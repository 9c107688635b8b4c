"""The gap between a part and a peg: the least of its vertices' and edges' distances."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.compiled import compiled
from bcppl.devices import is_on_host
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.distance import SignedDistance, Surface
from bcppl.geometry.gap.distance_grid import DistanceGrid, RefinedGrid, distance_grid
from bcppl.geometry.gap.edges import by_edges
from bcppl.geometry.gap.frames import Frames, frames_of
from bcppl.geometry.gap.sharp_edges import SharpEdges, sharp_edges
from bcppl.geometry.gap.solids import Solids, solids_of
from bcppl.geometry.gap.vertices import NEAR, by_vertices
from bcppl.geometry.parts import Part
from bcppl.threads import parallel_sum, thread_count

if TYPE_CHECKING:
    from bcppl.geometry.gap.warp_gap import WarpGap

MARGIN = 0.012  # m around the part that the grid covers
_CHUNK = 8  # particles of a chunk of work, at least
_PAIRS = 2000  # pairs of poses of a chunk, at least: they take milliseconds, and to wake a thread a tenth


class Tables(NamedTuple):
    """What `measured` looks up: the part's grid of distances, surface and sharp edges, the peg's solids."""

    grid: DistanceGrid
    surface: Surface
    edges: SharpEdges
    solids: Solids


@compiled
def measured(
    first: int,
    last: int,
    part: Frames,
    peg: Frames,
    tables: Tables,
    distance: Array,
    witness: Array,
    normal: Array,
) -> int:
    """Set the fields of `Gap`, of particles from `first` to `last`, at frames (N,) and (1 or N, T).

    Returns:
        how many exact distances were searched for.
    """
    grid, surface, edges, solids = tables
    searched = by_vertices(first, last, part, peg, grid, surface, solids, distance, witness, normal)
    by_edges(first, last, part, peg, edges, solids, distance, witness, normal)
    return searched


class Gap(NamedTuple):
    """Minimum distances between a part at N poses and a peg at T, with witness points and normals.

    Attributes:
        distance: (N, T) metres; in penetration minus the depth of the peg's deepest vertex in the part, or of
            the part's deepest edge in the peg.
        witness: (N, T, 3) the witness point, in the part's frame.
        normal: (N, T, 3) the part's outward unit normal there, in its frame.
    """

    distance: Tensor
    witness: Tensor
    normal: Tensor

    def gradient(self, world_from_part: Tensor) -> Tensor:
        """Gradients (N, T, 6) of the distance in the tangent space at poses (N, 7) of the part.

        Metres per metre along the world's axes and per radian about the part's.
        """
        rotation = poses.rotation_matrix(world_from_part)
        along = -(self.normal @ rotation.transpose(-1, -2))
        return torch.cat([along, -torch.linalg.cross(self.witness, self.normal)], dim=-1)


class PegGap:
    """The gap between a part and a peg. Their meshes are closed; a peg that is not convex has convex pieces.

    Polyhedra first touch at a vertex of one of them or where two edges cross. So the gap is the minimum over
    the distances of the peg's vertices to the part and of the part's sharp edges to the peg. Distances of
    vertices are interpolated; near an edge of the part, where that is inexact, those of all vertices that
    may be the closest are computed exactly. The distance of an edge to the peg is that to its closest plane:
    exact in contact, an underestimate beside the peg's own edges and vertices.

    Poses of the part on a GPU are measured there (`on`).

    Attributes:
        part, peg: the solids.
        effort: calls, and pairs of poses as `items`.

    Raises:
        InputError: a mesh is empty, open or not finite, or the peg is not convex and has no convex pieces.
    """

    __caches__: tuple[str, ...] = ("_grid", "_elsewhere")  # of the part

    def __init__(self, part: Part, peg: Part) -> None:
        self.part, self.peg = part, peg
        self.effort = Effort()
        self._signed = SignedDistance(part)
        self._grid: RefinedGrid | None = None
        self._elsewhere: dict[torch.device, WarpGap] = {}
        self._edges = sharp_edges(part)
        self._solids = solids_of(peg)

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gap:
        """Gaps (N, T) at poses (N, 7) of the part and (T, 7) of the peg, or (N, T, 7), one per particle."""
        if not is_on_host(world_from_part):
            return self.on(world_from_part.device)(world_from_part, world_from_peg)
        arrays = self.evaluate(frames_of(world_from_part), frames_of(world_from_peg))
        return Gap(*map(torch.from_numpy, arrays))

    def on(self, device: torch.device) -> WarpGap:
        """What measures the gap at poses on a GPU; its effort is this one's.

        Raises:
            InputError: Warp is not installed.
        """
        if device not in self._elsewhere:
            try:
                from bcppl.geometry.gap.warp_gap import WarpGap
            except ImportError as error:
                raise InputError(
                    f"gaps at poses on {device} are measured by Warp, which is not installed; install "
                    "bcppl[warp], or run on the processor."
                ) from error
            gap = self._elsewhere[device] = WarpGap(self.part, self.peg, device)
            gap.effort = self.effort
        return self._elsewhere[device]

    def evaluate(self, part: Frames, peg: Frames) -> tuple[Array, Array, Array]:
        """The fields of `Gap` as arrays, at frames (N,) of the part and (T,) or (N, T) of the peg."""
        peg = peg if peg.translation.ndim == 3 else Frames(peg.rotation[None], peg.translation[None])
        particles, stamps = len(part.translation), peg.translation.shape[1]
        distance = np.empty((particles, stamps))
        witness, normal = np.empty((particles, stamps, 3)), np.empty((particles, stamps, 3))

        def work(first: int, last: int, tables: Tables) -> int:
            return measured(first, last, part, peg, tables, distance, witness, normal)

        with self.effort.measure(items=particles * stamps):
            self.in_threads(work, particles, max(_CHUNK, _PAIRS // max(1, stamps)))
        return distance, witness, normal

    def in_threads(self, work: Callable[[int, int, Tables], int], particles: int, chunk: int) -> None:
        """Call `work` on chunks of particles, the first and the one after the last of each.

        It measures by `measured`, and returns what that does.
        """
        if self._grid is None:
            self._grid = RefinedGrid(distance_grid(self.part, self._signed, MARGIN), self._signed, NEAR)
        tables = Tables(self._grid.grid, self._signed.surface, self._edges, self._solids)
        searched = parallel_sum(
            lambda first, last: work(first, last, tables), 0, particles, chunk, thread_count()
        )
        self._grid.refine(searched)
