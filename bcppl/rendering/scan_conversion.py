"""Scan conversion of one mesh at one pose into a depth buffer, compiled.

A triangle's rows and columns are half open, [first, last), and the crossing of an edge with a row is computed
from the edge's upper end to its lower one in both of its triangles. So two triangles that share an edge cover
each pixel along it exactly once, to the bit, and leave no gap. The depth buffer holds 1/z, which is linear in
the image's rows and columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bcppl.arrays import Array, Indices, Mask, Numbers
from bcppl.compiled import compiled

CLEAR = 1e-6  # pixels squared: farther than rounding outside an edge
SHORT = 6  # pixels: a shorter run is drawn one by one


class Grid(NamedTuple):
    """The rows and columns of an image that are rendered; triangles between them cost next to nothing.

    `row_after` (H + 1,) and `column_after` (W + 1,) count those before each one of the image; `row_at` (R,)
    and `column_at` (C,) are their coordinates in the image.
    """

    row_after: Numbers
    column_after: Numbers
    row_at: Array
    column_at: Array


class PosedMesh(NamedTuple):
    """A mesh at N poses in front of a camera.

    Attributes:
        vertices, faces: (3, V) and (3, F).
        rotation, offset: `camera_from_part`, (N, 3, 3) and (N, 3).
        lens: fx, fy, cx, cy.
        near: metres; triangles are clipped at this plane.
        cull: (N,) whether back faces can be left out.
        grid: the rows and columns that are rendered.
        bounds: (N, 4) first and last row and column of the grid that may see the mesh; once it is rasterised,
            of the region that was written.
    """

    vertices: Array
    faces: npt.NDArray[np.uint32]
    rotation: Array
    offset: Array
    lens: Array
    near: float
    cull: Mask
    grid: Grid
    bounds: Indices


class Workspace(NamedTuple):
    """Arrays that the rasterisation of one pose writes into.

    Of the vertices u, v and 1/z (3, V), and how many rows and columns of the grid lie before them (2, V); of
    the faces a flag (F,), and at the front of `chosen` (F,) the indices of those to be drawn.
    """

    projected: Array
    cells: Numbers
    flags: Mask
    chosen: npt.NDArray[np.uint32]


@compiled
def grid_index(position: float, after: Numbers) -> np.int32:
    """The number of rows (or columns) of the grid before a coordinate in the image."""
    up = np.ceil(position)
    up = up if up > 0.0 else 0.0
    last = np.float64(len(after) - 1)
    return after[np.uint32(up if up < last else last)]


@compiled
def project(
    vertices: Array,
    rotation: Array,
    offset: Array,
    lens: Array,
    near: float,
    grid: Grid,
    projected: Array,
    cells: Numbers,
) -> int:
    """The number of vertices (3, V) that are not beyond `near`, whose projections are meaningless.

    All projections are written to `projected` and `cells`; see `Workspace`.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    height, width = np.float64(len(grid.row_after) - 1), np.float64(len(grid.column_after) - 1)
    x, y, z = vertices[0], vertices[1], vertices[2]
    u, v, w = projected[0], projected[1], projected[2]
    row, column = cells[0], cells[1]
    a, b, c = fx * rotation[0, 0], fx * rotation[0, 1], fx * rotation[0, 2]
    d, e, f = fy * rotation[1, 0], fy * rotation[1, 1], fy * rotation[1, 2]
    g, h, i = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    p, q, r = fx * offset[0], fy * offset[1], offset[2]
    behind = 0
    # Each loop becomes vector instructions; as one, or with `cell`, they take eight times as long.
    for k in range(x.shape[0]):
        depth = g * x[k] + h * y[k] + i * z[k] + r
        behind += not depth > near
        w[k] = 1.0 / depth
        u[k] = (a * x[k] + b * y[k] + c * z[k] + p) * w[k] + cx
        v[k] = (d * x[k] + e * y[k] + f * z[k] + q) * w[k] + cy
    for k in range(x.shape[0]):
        up, across = np.ceil(v[k]), np.ceil(u[k])
        up = up if up > 0.0 else 0.0
        up = up if up < height else height
        across = across if across > 0.0 else 0.0
        across = across if across < width else width
        row[k], column[k] = np.int32(up), np.int32(across)
    for k in range(x.shape[0]):
        row[k] = grid.row_after[np.uint32(row[k])]
        column[k] = grid.column_after[np.uint32(column[k])]
    return behind


@compiled
def bound_regions(corners: Array, mesh: PosedMesh) -> None:
    """Write `mesh.bounds` from the projections of a bounding box with corners (3, 8)."""
    projected, cells = np.empty((3, 8)), np.empty((2, 8), np.int32)
    lens, near, grid, bounds = mesh.lens, mesh.near, mesh.grid, mesh.bounds
    rows, columns = grid.row_after[-1], grid.column_after[-1]
    for k in range(len(bounds)):
        behind = project(corners, mesh.rotation[k], mesh.offset[k], lens, near, grid, projected, cells)
        if behind == 8:
            bounds[k] = 0
        elif behind:  # a corner behind the camera has no projection that bounds the box
            bounds[k, 0], bounds[k, 1], bounds[k, 2], bounds[k, 3] = 0, rows, 0, columns
        else:  # one more, for rounding
            bounds[k, 0], bounds[k, 1] = max(cells[0].min() - 1, 0), min(cells[0].max() + 1, rows)
            bounds[k, 2], bounds[k, 3] = max(cells[1].min() - 1, 0), min(cells[1].max() + 1, columns)


@compiled
def fill_triangle(
    corner: tuple[float, float, float, float, float, float, float, float, float],
    face: int,
    grid: Grid,
    region: Indices,
    buffer: Array,
    face_buffer: Numbers,
) -> int:
    """The number of fragments of a triangle (u, v, 1/z of its corners), the nearest of which are written.

    `buffer` holds 1/z of the region's pixels, row by row, 0 where there is none, and `face_buffer` their
    faces, unless it is empty.
    """
    u0, v0, w0, u1, v1, w1, u2, v2, w2 = corner
    row_after, column_after, row_at, column_at = grid
    if v1 < v0:
        u0, v0, w0, u1, v1, w1 = u1, v1, w1, u0, v0, w0
    if v2 < v0:
        u0, v0, w0, u2, v2, w2 = u2, v2, w2, u0, v0, w0
    if v2 < v1:
        u1, v1, w1, u2, v2, w2 = u2, v2, w2, u1, v1, w1
    along, upper, lower = (u2 - u0) / (v2 - v0), (u1 - u0) / (v1 - v0), (u2 - u1) / (v2 - v1)
    right = down = low = high = 0.0
    width, fragments = region[3] - region[2], 0
    for i in range(max(grid_index(v0, row_after), region[0]), min(grid_index(v2, row_after), region[1])):
        y = row_at[i]
        here = u0 + (y - v0) * along
        there = u0 + (y - v0) * upper if y < v1 else u1 + (y - v1) * lower
        first = max(grid_index(min(here, there), column_after), region[2])
        last = min(grid_index(max(here, there), column_after), region[3])
        if first >= last:
            continue
        if not fragments:
            area = 1.0 / ((u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0))
            right = ((w1 - w0) * (v2 - v0) - (w2 - w0) * (v1 - v0)) * area
            down = ((u1 - u0) * (w2 - w0) - (u2 - u0) * (w1 - w0)) * area
            # Rounding must not carry a sliver's plane beyond its corners.
            low, high = min(w0, w1, w2), max(w0, w1, w2)
        fragments += last - first
        start = w0 + down * (y - v0) - right * u0
        begin = (i - region[0]) * width + first - region[2]
        if last - first < SHORT:
            for j in range(last - first):
                w = min(max(start + right * column_at[np.uint64(first + j)], low), high)
                if w > buffer[np.uint64(begin + j)]:
                    buffer[np.uint64(begin + j)] = w
                    if len(face_buffer):
                        face_buffer[np.uint64(begin + j)] = face
            continue
        line, across = buffer[begin : begin + last - first], column_at[first:last]
        if len(face_buffer):
            own = face_buffer[begin : begin + last - first]
            for j in range(len(line)):
                w = min(max(start + right * across[j], low), high)
                if w > line[j]:
                    line[j], own[j] = w, face
        else:
            for j in range(len(line)):
                w = min(max(start + right * across[j], low), high)
                line[j] = w if w > line[j] else line[j]
    return fragments


@compiled
def clip_edge(ahead: Array, behind: Array, lens: Array, near: float) -> tuple[float, float, float]:
    """u, v and 1/z where the edge from a point beyond the near plane to one before it meets that plane."""
    share = (ahead[2] - near) / (ahead[2] - behind[2])
    x = ahead[0] + share * (behind[0] - ahead[0])
    y = ahead[1] + share * (behind[1] - ahead[1])
    return lens[0] * x / near + lens[2], lens[1] * y / near + lens[3], 1.0 / near


@compiled
def cull_faces(mesh: PosedMesh, cull: bool, work: Workspace) -> int:
    """The number of faces that may cover a pixel's centre; their indices are written to `work.chosen`.

    In a fine mesh few do. With `cull`, back faces are left out.
    """
    u, v, flags, chosen = work.projected[0], work.projected[1], work.flags, work.chosen
    row, column = work.cells[0], work.cells[1]
    first, second, third = mesh.faces[0], mesh.faces[1], mesh.faces[2]
    row_at, column_at = mesh.grid.row_at, mesh.grid.column_at
    front = -1.0 if mesh.lens[0] * mesh.lens[1] > 0.0 else 1.0  # v points down
    for n in range(len(first)):
        i, j, k = first[n], second[n], third[n]
        flags[n] = ((row[i] != row[j]) | (row[i] != row[k])) & (
            (column[i] != column[j]) | (column[i] != column[k])
        )
    covering = 0
    for n in range(len(first)):
        chosen[covering] = n
        covering += flags[n]
    for m in range(covering):
        n = chosen[m]
        i, j, k = first[n], second[n], third[n]
        top, bottom = min(row[i], row[j], row[k]), max(row[i], row[j], row[k])
        left, right = min(column[i], column[j], column[k]), max(column[i], column[j], column[k])
        x, y = column_at[np.uint32(left)], row_at[np.uint32(top)]
        area = (u[j] - u[i]) * (v[k] - v[i]) - (u[k] - u[i]) * (v[j] - v[i])
        side = 1.0 if area > 0.0 else -1.0
        ahead = ((u[j] - u[i]) * (y - v[i]) - (v[j] - v[i]) * (x - u[i])) * side
        beside = ((u[k] - u[j]) * (y - v[j]) - (v[k] - v[j]) * (x - u[j])) * side
        beyond = ((u[i] - u[k]) * (y - v[k]) - (v[i] - v[k]) * (x - u[k])) * side
        outside = (
            ((ahead < -CLEAR) | (beside < -CLEAR) | (beyond < -CLEAR))
            & (bottom - top == 1)
            & (right - left == 1)
        )
        flags[m] = (not outside) & ((not cull) | (front * area > 0.0))
    kept = 0
    for m in range(covering):
        n = chosen[m]
        chosen[kept] = n
        kept += flags[m]
    return kept


@compiled
def rasterise(mesh: PosedMesh, particle: int, work: Workspace, buffer: Array, face_buffer: Numbers) -> int:
    """The number of fragments of the mesh at one pose, written to a `buffer` that is cleared first."""
    region, grid = mesh.bounds[particle], mesh.grid
    if region[0] >= region[1] or region[2] >= region[3]:
        region[:] = 0
        return 0
    rotation, offset, lens = mesh.rotation[particle], mesh.offset[particle], mesh.lens
    behind = project(mesh.vertices, rotation, offset, lens, mesh.near, grid, work.projected, work.cells)
    row, column = work.cells[0], work.cells[1]
    if not behind:
        region[0], region[1] = max(region[0], row.min()), min(region[1], row.max())
        region[2], region[3] = max(region[2], column.min()), min(region[3], column.max())
        if region[0] >= region[1] or region[2] >= region[3]:
            region[:] = 0
            return 0
    buffer[: (region[1] - region[0]) * (region[3] - region[2])] = 0.0
    if behind:
        return rasterise_clipped(mesh, particle, work, buffer, face_buffer)
    return rasterise_whole(mesh, particle, work, buffer, face_buffer)


@compiled
def rasterise_whole(
    mesh: PosedMesh, particle: int, work: Workspace, buffer: Array, face_buffer: Numbers
) -> int:
    """The number of fragments of a mesh whose vertices are all beyond the near plane."""
    region, grid = mesh.bounds[particle], mesh.grid
    u, v, w = work.projected[0], work.projected[1], work.projected[2]
    first, second, third, chosen = mesh.faces[0], mesh.faces[1], mesh.faces[2], work.chosen
    fragments = 0
    for m in range(cull_faces(mesh, mesh.cull[particle], work)):
        n = chosen[m]
        i, j, k = first[n], second[n], third[n]
        corner = (u[i], v[i], w[i], u[j], v[j], w[j], u[k], v[k], w[k])
        fragments += fill_triangle(corner, n, grid, region, buffer, face_buffer)
    return fragments


@compiled
def rasterise_clipped(
    mesh: PosedMesh, particle: int, work: Workspace, buffer: Array, face_buffer: Numbers
) -> int:
    """The number of fragments of a mesh that crosses the near plane, at which it is clipped."""
    region, grid, lens, near = mesh.bounds[particle], mesh.grid, mesh.lens, mesh.near
    rotation, offset = mesh.rotation[particle], mesh.offset[particle]
    u, v, w = work.projected[0], work.projected[1], work.projected[2]
    point = np.empty((3, 3))
    fragments = 0
    for n in range(mesh.faces.shape[1]):
        ahead = 0
        for m in range(3):
            vertex = mesh.vertices[:, mesh.faces[m, n]]
            for axis in range(3):
                r = rotation[axis]
                point[m, axis] = r[0] * vertex[0] + r[1] * vertex[1] + r[2] * vertex[2] + offset[axis]
            ahead += point[m, 2] > near
        if ahead == 0:
            continue
        # The odd one out: the only vertex beyond the near plane, or the only one before it.
        odd = 0
        for m in range(3):
            if (point[m, 2] > near) == (ahead == 1):
                odd = m
        left, right = (odd + 1) % 3, (odd + 2) % 3
        i, j, k = mesh.faces[odd, n], mesh.faces[left, n], mesh.faces[right, n]
        a, b, c = (u[i], v[i], w[i]), (u[j], v[j], w[j]), (u[k], v[k], w[k])
        if ahead == 3:
            fragments += fill_triangle(a + b + c, n, grid, region, buffer, face_buffer)
        elif ahead == 1:
            b = clip_edge(point[odd], point[left], lens, near)
            c = clip_edge(point[odd], point[right], lens, near)
            fragments += fill_triangle(a + b + c, n, grid, region, buffer, face_buffer)
        else:
            a = clip_edge(point[left], point[odd], lens, near)
            d = clip_edge(point[right], point[odd], lens, near)
            fragments += fill_triangle(a + b + c, n, grid, region, buffer, face_buffer)
            fragments += fill_triangle(a + d + c, n, grid, region, buffer, face_buffer)
    return fragments
