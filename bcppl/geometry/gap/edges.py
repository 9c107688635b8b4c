"""The distances of a part's sharp edges to a peg."""

from __future__ import annotations

import numpy as np

from bcppl.arrays import Array
from bcppl.compiled import compiled
from bcppl.geometry.gap.frames import Frames, relative
from bcppl.geometry.gap.sharp_edges import (
    SharpEdges,
    dot,
    is_separated,
    may_be_nearer,
    segment_distance,
    to_peg_frame,
)
from bcppl.geometry.gap.solids import Solids
from bcppl.geometry.gap.vertices import FADING, NEAR


@compiled
def by_edges(
    first: int,
    last: int,
    part: Frames,
    peg: Frames,
    edges: SharpEdges,
    solids: Solids,
    distance: Array,
    witness: Array,
    normal: Array,
) -> None:
    """The distances of the part's edges to the peg, where these are less than those of its vertices."""
    if not len(edges.groups):
        return
    planes, box, gradient = solids.planes, solids.box, np.empty(3)
    start, stop, middle = np.empty(3), np.empty(3), np.empty(3)
    turn, shift, rows = np.empty((3, 3)), np.empty(3), np.empty((len(planes), 2))
    closest_group = 0
    for n in range(first, last):
        own = n if len(peg.rotation) > 1 else 0
        for t in range(peg.rotation.shape[1]):
            relative(part, n, peg, own, t, turn, shift)
            # A farther edge cannot be in contact.
            of_vertices = distance[n, t]
            nearer, first_group = min(of_vertices, NEAR), closest_group
            for k in range(-1, len(edges.groups)):
                # The group that was closest at the pose before comes first: hardly any other is looked into.
                g = first_group if k < 0 else k
                if k == first_group or not may_be_nearer(edges.groups, g, turn, shift, box, nearer):
                    continue
                for e in range(edges.stops[g - 1] if g else 0, edges.stops[g]):
                    if not may_be_nearer(edges.spheres, e, turn, shift, box, nearer):
                        continue
                    to_peg_frame(turn, shift, edges.spheres, e, middle)
                    to_peg_frame(turn, shift, edges.ends[:, 0], e, start)
                    to_peg_frame(turn, shift, edges.ends[:, 1], e, stop)
                    begin = 0
                    for s in range(len(solids.ends)):
                        solid = planes[begin : solids.ends[s]]
                        begin = solids.ends[s]
                        if is_separated(middle, solid, edges.spheres[e, 3] + nearer):
                            continue
                        inside, share = segment_distance(start, stop, solid, nearer, rows, gradient)
                        if inside < nearer:
                            nearer, closest_group = inside, g
                            distance[n, t] = inside
                            witness[n, t] = edges.ends[e, 0] + share * (edges.ends[e, 1] - edges.ends[e, 0])
                            for axis in range(3):
                                normal[n, t, axis] = -dot(turn[axis], gradient)
            if FADING < distance[n, t] < of_vertices < np.inf:
                share = (distance[n, t] - FADING) / (NEAR - FADING)
                distance[n, t] += share * (of_vertices - distance[n, t])
