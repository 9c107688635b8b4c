"""What the compiled drawing of triangles is given: a mesh before a camera, and room to work in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


class Grid(NamedTuple):
    """The rows and columns of an image that matter; triangles between them cost next to nothing.

    Attributes:
        row_after, column_after: (H + 1,) and (W + 1,) how many of them lie before each of the image's.
        row_at, column_at: (R,) and (C,) where they are.
    """

    row_after: Numbers
    column_after: Numbers
    row_at: Array
    column_at: Array


class Placed(NamedTuple):
    """A mesh before a camera at N poses.

    Attributes:
        vertices, faces: (3, V) and (3, F).
        rotation, offset: `camera_from_part`, (N, 3, 3) and (N, 3).
        lens: fx, fy, cx, cy.
        near: metres; what is not ahead of it is cut off.
        cull: (N,) whether faces seen from behind can be left out.
        grid: which rows and columns matter.
        bounds: (N, 4) first and last row and column of the grid that may see the mesh, and once it is drawn,
            those drawn into.
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


class Room(NamedTuple):
    """Where one pose is worked on.

    Attributes:
        seen: (3, V) u, v and 1/z of the vertices.
        cells: (2, V) how many rows and columns of the grid lie before them.
        alive: (F,) a flag for each face.
        chosen: (F,) the numbers of faces.
    """

    seen: Array
    cells: Numbers
    alive: Mask
    chosen: npt.NDArray[np.uint32]
