"""Depth buffers of many poses, compiled: the loops of `bcppl.rendering.rasterisation` over particles.

A cached compiled function is compiled again when its own file changes, not when a file that it calls does: an
edit of `scan_conversion` needs one of this file, too.
"""

from __future__ import annotations

import numpy as np

from bcppl.arrays import Array, Indices, Mask, Numbers
from bcppl.compiled import compiled
from bcppl.rendering.scan_conversion import PosedMesh, Workspace, rasterise


@compiled
def workspace_for(mesh: PosedMesh) -> Workspace:
    """A work for one thread."""
    vertices, faces = mesh.vertices.shape[1], mesh.faces.shape[1]
    return Workspace(
        np.empty((3, vertices)),
        np.empty((2, vertices), np.int32),
        np.empty(faces, np.bool_),
        np.empty(faces, np.uint32),
    )


@compiled
def render_images(begin: int, end: int, mesh: PosedMesh, images: Array) -> int:
    """The number of fragments of particles `begin` to `end`, whose depth images (N, H, W) are written."""
    work = workspace_for(mesh)
    buffer, face_buffer = np.empty(images[0].size), np.empty(0, np.int32)
    fragments = 0
    for k in range(begin, end):
        fragments += rasterise(mesh, k, work, buffer, face_buffer)
        region, image = mesh.bounds[k], images[k]
        image[: region[0]] = np.inf
        image[region[1] :] = np.inf
        width = region[3] - region[2]
        for i in range(region[0], region[1]):
            image[i, : region[2]] = np.inf
            image[i, region[3] :] = np.inf
            line, inverse = image[i, region[2] : region[3]], buffer[(i - region[0]) * width :]
            for j in range(len(line)):
                line[j] = 1.0 / inverse[j]
    return fragments


@compiled
def render_regions(
    begin: int,
    end: int,
    mesh: PosedMesh,
    counted: Mask,
    start: Indices,
    buffer: Array,
    face_buffer: Numbers,
    count: Indices,
) -> int:
    """The number of fragments of particles `begin` to `end`; they are written to `buffer` from `start` on.

    `counted` is a mask of the grid's pixels, empty for all of them. Each particle's number of hits is written
    to `count`.
    """
    work = workspace_for(mesh)
    fragments = 0
    for k in range(begin, end):
        region, own = mesh.bounds[k], buffer[start[k] : start[k + 1]]
        fragments += rasterise(
            mesh, k, work, own, face_buffer[start[k] : start[k + 1]] if len(face_buffer) else face_buffer
        )
        width = region[3] - region[2]
        hits = 0
        for i in range(region[0], region[1]):
            line = own[(i - region[0]) * width : (i - region[0] + 1) * width]
            if len(counted):
                mask = counted[i, region[2] : region[3]]
                for j in range(len(line)):
                    line[j] = line[j] if mask[j] else 0.0
            for j in range(len(line)):
                hits += line[j] > 0.0
        count[k] = hits
    return fragments


@compiled
def write_hits(
    begin: int,
    end: int,
    mesh: PosedMesh,
    image_width: int,
    start: Indices,
    buffer: Array,
    face_buffer: Numbers,
    first_hit: Indices,
    particle: Indices,
    pixel: Indices,
    depth: Array,
    face: Indices,
) -> None:
    """Write the hits of the buffers of `render_regions`, each particle's from its `first_hit` on."""
    row_at, column_at = mesh.grid.row_at, mesh.grid.column_at
    for k in range(begin, end):
        first_row, last_row, first_column, last_column = mesh.bounds[k]
        at, place = start[k], first_hit[k]
        for i in range(first_row, last_row):
            before = np.int64(row_at[i]) * image_width
            for j in range(first_column, last_column):
                if buffer[at] > 0.0:
                    particle[place] = k
                    pixel[place] = before + np.int64(column_at[j])
                    depth[place] = 1.0 / buffer[at]
                    if len(face_buffer):
                        face[place] = face_buffer[at]
                    place += 1
                at += 1
