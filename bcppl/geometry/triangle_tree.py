"""The closest point of a triangle mesh, in a tree of boxes that is searched from a triangle nearby."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bcppl.arrays import Array, Indices
from bcppl.compiled import compiled
from bcppl.geometry.bounding_spheres import halves

_LEAF = 2  # triangles, at most


class TriangleTree(NamedTuple):
    """Triangles in a binary tree of boxes, each node before those below it.

    Attributes:
        triangles: (F, 3, 3) the first corner of each, and its edges to the second and the third; those of a
            leaf are contiguous.
        face: (F,) the place of each in the mesh.
        boxes: (K, 2, 3) lowest and highest coordinates at and below a node.
        skip: (K,) the next node that is not below this one.
        first, last: (K,) a leaf's first triangle, and the one after its last; alike at other nodes.
    """

    triangles: Array
    face: Indices
    boxes: Array
    skip: Indices
    first: Indices
    last: Indices


def triangle_tree(vertices: Array, faces: Indices) -> TriangleTree:
    """The tree of a mesh of vertices (V, 3) and faces (F, 3)."""
    corners = vertices[faces]
    lowest, highest, middle = corners.min(axis=1), corners.max(axis=1), corners.mean(axis=1)
    order: list[Indices] = []
    boxes: list[tuple[Array, Array]] = []
    skip: list[int] = []
    ends: list[tuple[int, int]] = []

    def add(members: Indices, first: int) -> None:
        node = len(boxes)
        boxes.append((lowest[members].min(axis=0), highest[members].max(axis=0)))
        skip.append(0)
        ends.append((first, first + len(members) if len(members) <= _LEAF else first))
        if len(members) <= _LEAF:
            order.append(members)
        else:
            for half in halves(middle, members):
                add(half, first)
                first += len(half)
        skip[node] = len(boxes)

    add(np.arange(len(faces)), 0)
    face = np.concatenate(order)
    start, *others = np.moveaxis(corners[face], 1, 0)
    triangles = np.stack([start, *(each - start for each in others)], axis=1)
    first, last = np.array(ends, dtype=np.int64).T
    whole = np.ascontiguousarray(first), np.ascontiguousarray(last)
    return TriangleTree(triangles, face.astype(np.int64), np.array(boxes), np.array(skip), *whole)


@compiled
def closest_triangle(
    x: float, y: float, z: float, tree: TriangleTree, guess: int
) -> tuple[int, float, float, float]:
    """The triangle that is closest to a point, and where: the nearer `guess`, the sooner.

    Returns:
        its place in the tree, the squared distance, and the closest point's shares of its two edges.
    """
    best, (squared, u, v) = guess, _to_triangle(x, y, z, tree.triangles, guess)
    node = 0
    while node < len(tree.skip):
        if _to_box(x, y, z, tree.boxes, node) >= squared:
            node = tree.skip[node]
            continue
        for t in range(tree.first[node], tree.last[node]):
            here, share, other = _to_triangle(x, y, z, tree.triangles, t)
            if here < squared:
                best, squared, u, v = t, here, share, other
        node += 1
    return best, squared, u, v


@compiled
def _to_box(x: float, y: float, z: float, boxes: Array, node: int) -> float:
    """The squared distance of a point to a node's box."""
    x = max(boxes[node, 0, 0] - x, 0.0, x - boxes[node, 1, 0])
    y = max(boxes[node, 0, 1] - y, 0.0, y - boxes[node, 1, 1])
    z = max(boxes[node, 0, 2] - z, 0.0, z - boxes[node, 1, 2])
    return x * x + y * y + z * z


@compiled
def _to_triangle(x: float, y: float, z: float, triangles: Array, t: int) -> tuple[float, float, float]:
    """The squared distance of a point to a triangle, and the closest point's shares of its two edges.

    Source: Ericson, Real-Time Collision Detection, 2005, section 5.1.5.
    """
    x, y, z = x - triangles[t, 0, 0], y - triangles[t, 0, 1], z - triangles[t, 0, 2]
    bx, by, bz = triangles[t, 1, 0], triangles[t, 1, 1], triangles[t, 1, 2]
    cx, cy, cz = triangles[t, 2, 0], triangles[t, 2, 1], triangles[t, 2, 2]
    bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    pb, pc = bx * x + by * y + bz * z, cx * x + cy * y + cz * z
    # Seen from the second corner and from the third, as pb and pc from the first.
    pb_b, pc_b, pb_c, pc_c = pb - bb, pc - bc, pb - bc, pc - cc
    u, v = 0.0, 0.0
    if pb <= 0.0 and pc <= 0.0:
        pass
    elif pb_b >= 0.0 and pc_b <= pb_b:
        u = 1.0
    elif pc_c >= 0.0 and pb_c <= pc_c:
        v = 1.0
    else:
        beside_b = pb * pc_b - pb_b * pc  # times the normal: the part across from the third corner
        beside_c = pb_c * pc - pb * pc_c
        across = pb_b * pc_c - pb_c * pc_b
        if beside_b <= 0.0 and pb >= 0.0 and pb_b <= 0.0:
            u = pb / (pb - pb_b)
        elif beside_c <= 0.0 and pc >= 0.0 and pc_c <= 0.0:
            v = pc / (pc - pc_c)
        elif across <= 0.0 and pc_b - pb_b >= 0.0 and pb_c - pc_c >= 0.0:
            v = (pc_b - pb_b) / ((pc_b - pb_b) + (pb_c - pc_c))
            u = 1.0 - v
        else:
            whole = beside_b + beside_c + across
            u, v = beside_c / whole, beside_b / whole
    x, y, z = x - u * bx - v * cx, y - u * by - v * cy, z - u * bz - v * cz
    return x * x + y * y + z * z, u, v
