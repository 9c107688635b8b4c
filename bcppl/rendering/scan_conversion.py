"""Triangles to pixels, compiled: one mesh at one pose.

A triangle's rows and columns are half open, [first, last), and the crossing of an edge with a row is computed
from its upper end to its lower one, whichever triangle asks. So two triangles that share an edge cover each
pixel along it exactly once, to the bit: nothing shows between them. What is compared is 1/z, which is linear
in the image's rows and columns.
"""

from __future__ import annotations

import numpy as np

from bcppl.compiled import compiled
from bcppl.rendering.placement import Array, Grid, Indices, Numbers, Placed, Room

CLEAR = 1e-6  # pixels squared: outside an edge by more than rounding
SHORT = 6  # pixels: a shorter run is drawn one by one


@compiled
def cell(position: float, after: Numbers) -> np.int32:
    """How many rows (or columns) of the grid lie before a position in the image."""
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
    seen: Array,
    cells: Numbers,
) -> int:
    """Project vertices (3, V) to `seen` and `cells`; see `Room`.

    Returns how many are not ahead of `near`: what is written for those means nothing.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    height, width = np.float64(len(grid.row_after) - 1), np.float64(len(grid.column_after) - 1)
    x, y, z = vertices[0], vertices[1], vertices[2]
    u, v, w = seen[0], seen[1], seen[2]
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
def bound(corners: Array, placed: Placed) -> None:
    """Write `placed.bounds` for a mesh within a box of the given corners (3, 8)."""
    seen, cells = np.empty((3, 8)), np.empty((2, 8), np.int32)
    lens, near, grid, bounds = placed.lens, placed.near, placed.grid, placed.bounds
    rows, columns = grid.row_after[-1], grid.column_after[-1]
    for k in range(len(bounds)):
        behind = project(corners, placed.rotation[k], placed.offset[k], lens, near, grid, seen, cells)
        if behind == 8:
            bounds[k] = 0
        elif behind:  # a corner behind the camera has no projection that bounds the box
            bounds[k, 0], bounds[k, 1], bounds[k, 2], bounds[k, 3] = 0, rows, 0, columns
        else:  # a cell more, for rounding
            bounds[k, 0], bounds[k, 1] = max(cells[0].min() - 1, 0), min(cells[0].max() + 1, rows)
            bounds[k, 2], bounds[k, 3] = max(cells[1].min() - 1, 0), min(cells[1].max() + 1, columns)


@compiled
def fill(
    corner: tuple[float, float, float, float, float, float, float, float, float],
    face: int,
    grid: Grid,
    region: Indices,
    buffer: Array,
    owner: Numbers,
) -> int:
    """Draw a triangle (u, v, 1/z of its three corners) where it is nearest; how many pixels were compared.

    `buffer` holds 1/z of the region's pixels, row by row, 0 where nothing was drawn, and `owner` their faces
    if it has a length.
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
    width, filled = region[3] - region[2], 0
    for i in range(max(cell(v0, row_after), region[0]), min(cell(v2, row_after), region[1])):
        y = row_at[i]
        here = u0 + (y - v0) * along
        there = u0 + (y - v0) * upper if y < v1 else u1 + (y - v1) * lower
        first = max(cell(min(here, there), column_after), region[2])
        last = min(cell(max(here, there), column_after), region[3])
        if first >= last:
            continue
        if not filled:
            area = 1.0 / ((u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0))
            right = ((w1 - w0) * (v2 - v0) - (w2 - w0) * (v1 - v0)) * area
            down = ((u1 - u0) * (w2 - w0) - (u2 - u0) * (w1 - w0)) * area
            # Rounding must not take a sliver's plane further than its corners.
            low, high = min(w0, w1, w2), max(w0, w1, w2)
        filled += last - first
        start = w0 + down * (y - v0) - right * u0
        begin = (i - region[0]) * width + first - region[2]
        if last - first < SHORT:
            for j in range(last - first):
                w = min(max(start + right * column_at[np.uint64(first + j)], low), high)
                if w > buffer[np.uint64(begin + j)]:
                    buffer[np.uint64(begin + j)] = w
                    if len(owner):
                        owner[np.uint64(begin + j)] = face
            continue
        line, across = buffer[begin : begin + last - first], column_at[first:last]
        if len(owner):
            own = owner[begin : begin + last - first]
            for j in range(len(line)):
                w = min(max(start + right * across[j], low), high)
                if w > line[j]:
                    line[j], own[j] = w, face
        else:
            for j in range(len(line)):
                w = min(max(start + right * across[j], low), high)
                line[j] = w if w > line[j] else line[j]
    return filled


@compiled
def cut(ahead: Array, behind: Array, lens: Array, near: float) -> tuple[float, float, float]:
    """Where the edge from a point ahead of the camera's plane to one behind meets `near`, as u, v and 1/z."""
    share = (ahead[2] - near) / (ahead[2] - behind[2])
    x = ahead[0] + share * (behind[0] - ahead[0])
    y = ahead[1] + share * (behind[1] - ahead[1])
    return lens[0] * x / near + lens[2], lens[1] * y / near + lens[3], 1.0 / near


@compiled
def sieve(placed: Placed, cull: bool, room: Room) -> int:
    """Which faces may hold the middle of a pixel: their numbers to the front of `room.chosen`; how many.

    In a fine mesh few do. With `cull`, faces seen from behind are left out.
    """
    u, v, alive, chosen = room.seen[0], room.seen[1], room.alive, room.chosen
    row, column = room.cells[0], room.cells[1]
    first, second, third = placed.faces[0], placed.faces[1], placed.faces[2]
    row_at, column_at = placed.grid.row_at, placed.grid.column_at
    front = -1.0 if placed.lens[0] * placed.lens[1] > 0.0 else 1.0  # v points down
    for n in range(len(first)):
        i, j, k = first[n], second[n], third[n]
        alive[n] = ((row[i] != row[j]) | (row[i] != row[k])) & (
            (column[i] != column[j]) | (column[i] != column[k])
        )
    found = 0
    for n in range(len(first)):
        chosen[found] = n
        found += alive[n]
    for m in range(found):
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
        alive[m] = (not outside) & ((not cull) | (front * area > 0.0))
    kept = 0
    for m in range(found):
        n = chosen[m]
        chosen[kept] = n
        kept += alive[m]
    return kept


@compiled
def draw(placed: Placed, particle: int, room: Room, buffer: Array, owner: Numbers) -> int:
    """Draw the mesh at one pose into a `buffer` that is cleared first; how many pixels were compared."""
    region, grid = placed.bounds[particle], placed.grid
    if region[0] >= region[1] or region[2] >= region[3]:
        region[:] = 0
        return 0
    rotation, offset, lens, near = (
        placed.rotation[particle],
        placed.offset[particle],
        placed.lens,
        placed.near,
    )
    behind = project(placed.vertices, rotation, offset, lens, near, grid, room.seen, room.cells)
    row, column = room.cells[0], room.cells[1]
    if not behind:
        region[0], region[1] = max(region[0], row.min()), min(region[1], row.max())
        region[2], region[3] = max(region[2], column.min()), min(region[3], column.max())
        if region[0] >= region[1] or region[2] >= region[3]:
            region[:] = 0
            return 0
    buffer[: (region[1] - region[0]) * (region[3] - region[2])] = 0.0
    if behind:
        return draw_cut(placed, particle, room, buffer, owner)
    return draw_whole(placed, particle, room, buffer, owner)


@compiled
def draw_whole(placed: Placed, particle: int, room: Room, buffer: Array, owner: Numbers) -> int:
    """Draw a mesh of which all vertices are ahead of the camera."""
    region, grid = placed.bounds[particle], placed.grid
    u, v, w = room.seen[0], room.seen[1], room.seen[2]
    first, second, third, chosen = placed.faces[0], placed.faces[1], placed.faces[2], room.chosen
    filled = 0
    for m in range(sieve(placed, placed.cull[particle], room)):
        n = chosen[m]
        i, j, k = first[n], second[n], third[n]
        corner = (u[i], v[i], w[i], u[j], v[j], w[j], u[k], v[k], w[k])
        filled += fill(corner, n, grid, region, buffer, owner)
    return filled


@compiled
def draw_cut(placed: Placed, particle: int, room: Room, buffer: Array, owner: Numbers) -> int:
    """Draw a mesh of which some vertices are not ahead of the camera: its triangles are cut there."""
    region, grid, lens, near = placed.bounds[particle], placed.grid, placed.lens, placed.near
    rotation, offset = placed.rotation[particle], placed.offset[particle]
    u, v, w = room.seen[0], room.seen[1], room.seen[2]
    point = np.empty((3, 3))
    filled = 0
    for n in range(placed.faces.shape[1]):
        ahead = 0
        for m in range(3):
            vertex = placed.vertices[:, placed.faces[m, n]]
            for axis in range(3):
                turn = rotation[axis]
                point[m, axis] = (
                    turn[0] * vertex[0] + turn[1] * vertex[1] + turn[2] * vertex[2] + offset[axis]
                )
            ahead += point[m, 2] > near
        if ahead == 0:
            continue
        # The odd one out: the only one ahead, or the only one behind.
        odd = 0
        for m in range(3):
            if (point[m, 2] > near) == (ahead == 1):
                odd = m
        left, right = (odd + 1) % 3, (odd + 2) % 3
        i, j, k = placed.faces[odd, n], placed.faces[left, n], placed.faces[right, n]
        a, b, c = (u[i], v[i], w[i]), (u[j], v[j], w[j]), (u[k], v[k], w[k])
        if ahead == 3:
            filled += fill(a + b + c, n, grid, region, buffer, owner)
        elif ahead == 1:
            b, c = cut(point[odd], point[left], lens, near), cut(point[odd], point[right], lens, near)
            filled += fill(a + b + c, n, grid, region, buffer, owner)
        else:
            a, d = cut(point[left], point[odd], lens, near), cut(point[right], point[odd], lens, near)
            filled += fill(a + b + c, n, grid, region, buffer, owner)
            filled += fill(a + d + c, n, grid, region, buffer, owner)
    return filled
