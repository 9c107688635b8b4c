"""Many poses drawn, compiled: the loops of `bcppl.rendering.rasteriser` over particles and pixels.

Compiled code that is kept on disk is made anew when its own file changes, not when a file that it calls does:
whoever edits `scan_conversion` has to touch this file, too.
"""

from __future__ import annotations

import numpy as np

from bcppl.compiled import compiled
from bcppl.rendering.placement import Array, Indices, Mask, Numbers, Placed, Room
from bcppl.rendering.scan_conversion import draw


@compiled
def room_for(placed: Placed) -> Room:
    """Room to work in, one for each thread."""
    vertices, faces = placed.vertices.shape[1], placed.faces.shape[1]
    return Room(
        np.empty((3, vertices)),
        np.empty((2, vertices), np.int32),
        np.empty(faces, np.bool_),
        np.empty(faces, np.uint32),
    )


@compiled
def draw_images(begin: int, end: int, placed: Placed, images: Array) -> int:
    """Depth images (N, H, W) of particles `begin` to `end`; how many pixels were compared."""
    room = room_for(placed)
    buffer, owner = np.empty(images[0].size), np.empty(0, np.int32)
    filled = 0
    for k in range(begin, end):
        filled += draw(placed, k, room, buffer, owner)
        region, image = placed.bounds[k], images[k]
        image[: region[0]] = np.inf
        image[region[1] :] = np.inf
        width = region[3] - region[2]
        for i in range(region[0], region[1]):
            image[i, : region[2]] = np.inf
            image[i, region[3] :] = np.inf
            line, drawn = image[i, region[2] : region[3]], buffer[(i - region[0]) * width :]
            for j in range(len(line)):
                line[j] = 1.0 / drawn[j]
    return filled


@compiled
def draw_regions(
    begin: int,
    end: int,
    placed: Placed,
    counted: Mask,
    start: Indices,
    buffer: Array,
    owner: Numbers,
    count: Indices,
) -> int:
    """Draw particles `begin` to `end` into `buffer`, each from its `start`, and count each one's hits.

    `counted` holds the pixels of the grid that matter; all do if it has no length.
    """
    room = room_for(placed)
    filled = 0
    for k in range(begin, end):
        region, own = placed.bounds[k], buffer[start[k] : start[k + 1]]
        filled += draw(placed, k, room, own, owner[start[k] : start[k + 1]] if len(owner) else owner)
        width = region[3] - region[2]
        found = 0
        for i in range(region[0], region[1]):
            line = own[(i - region[0]) * width : (i - region[0] + 1) * width]
            if len(counted):
                mask = counted[i, region[2] : region[3]]
                for j in range(len(line)):
                    line[j] = line[j] if mask[j] else 0.0
            for j in range(len(line)):
                found += line[j] > 0.0
        count[k] = found
    return filled


@compiled
def collect(
    begin: int,
    end: int,
    placed: Placed,
    image_width: int,
    start: Indices,
    buffer: Array,
    owner: Numbers,
    ahead: Indices,
    particle: Indices,
    pixel: Indices,
    depth: Array,
    face: Indices,
) -> None:
    """Write what `draw_regions` drew as hits, each particle's from its place `ahead` on."""
    row_at, column_at = placed.grid.row_at, placed.grid.column_at
    for k in range(begin, end):
        first_row, last_row, first_column, last_column = placed.bounds[k]
        at, place = start[k], ahead[k]
        for i in range(first_row, last_row):
            before = np.int64(row_at[i]) * image_width
            for j in range(first_column, last_column):
                if buffer[at] > 0.0:
                    particle[place] = k
                    pixel[place] = before + np.int64(column_at[j])
                    depth[place] = 1.0 / buffer[at]
                    if len(owner):
                        face[place] = owner[at]
                    place += 1
                at += 1
