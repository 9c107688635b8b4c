"""Depth images of a part at many poses, by drawing its triangles into a depth buffer.

Everything is in double precision, where `bcppl.rendering.renderer.DepthRenderer` casts rays in single. The
work goes with the number of triangles and of pixels drawn into, so it suits all but the finest meshes;
`bcppl.rendering.choice` says when it is used.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import igl
import numpy as np
import numpy.typing as npt
from torch import Tensor

from bcppl import poses
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.drawing import collect, draw_images, draw_regions
from bcppl.rendering.placement import Grid, Placed
from bcppl.rendering.renderer import Hits, counted_pixels
from bcppl.rendering.scan_conversion import bound
from bcppl.threads import parallel_sum, thread_count

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
T = TypeVar("T", bound=np.generic)

BUFFER = 1 << 20  # pixels drawn before they are collected: 8 MB, which stays in the cache of most processors
NEAREST = 1e-6  # of the part's diagonal: what is nearer to the camera's plane is cut off
LARGEST = 32767  # pixels in a row or column
FEW = 1 << 23  # hits that are made room for at first; room that is not used costs nothing
SHARE = 8  # particles at a time that a thread takes


class DepthRasteriser:
    """Renders the depth of one part; used like `bcppl.rendering.renderer.DepthRenderer`.

    Attributes:
        part: the part.
        effort: images asked for, pixels compared and seconds spent so far.
        threads: how many threads share the particles; the result does not hang on it.
    """

    def __init__(self, part: Part, threads: int | None = None) -> None:
        """Prepare the mesh.

        Args:
            part: what is rendered; its mesh may be open.
            threads: None for one on each core, or as many as OMP_NUM_THREADS says.

        Raises:
            InputError: the mesh is empty or not finite.
        """
        part.check(closed=False)
        self.part = part
        self.effort = Effort()
        self.threads = thread_count() if threads is None else threads
        # Vertices that are doubled at seams become one: fewer to project, and a closed mesh is seen to be.
        vertices, which = np.unique(np.asarray(part.vertices, np.float64), axis=0, return_inverse=True)
        faces = which.reshape(-1)[part.faces]
        self._vertices = np.ascontiguousarray(vertices.T)
        self._faces = np.ascontiguousarray(faces.T.astype(np.uint32))
        self._lowest, self._highest = vertices.min(axis=0), vertices.max(axis=0)
        self._diagonal = float(np.linalg.norm(self._highest - self._lowest))
        corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
        box = np.where(corners == 0, self._lowest, self._highest)
        self._corners = np.ascontiguousarray(box.T)
        self._solid = _solid(vertices, faces, 1e-4 * self._diagonal)

    def hits(
        self,
        camera: Camera,
        world_from_part: Tensor | Array,
        counted: Mask | None = None,
        faces: bool = False,
    ) -> Hits:
        """What the camera sees of the part, as the pixels that see it.

        Args:
            camera: the camera.
            world_from_part: (N, 7) the part's poses.
            counted: (H * W,) or (H, W) the pixels that matter; None for all.
            faces: whether to say which face of the mesh is hit.

        Returns:
            The hits. A surface nearer than `camera.near` is a hit too; one behind the camera is none.

        Raises:
            InputError: a pose, the camera's too, is not finite or has no unit quaternion; the camera's
                intrinsics are none or its lens distorts; the counted pixels are not those of its image.
        """
        pose = poses.as_pose(world_from_part, "world_from_part").reshape(-1, 7)
        camera_from_world = self._camera_from_world(camera)
        with self.effort.measure(items=len(pose)) as effort:
            rows, columns = np.arange(camera.height), np.arange(camera.width)
            mask = np.empty((0, 0), dtype=bool)
            if counted is not None:
                mask = counted_pixels(camera, counted).reshape(camera.height, camera.width)
                rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
                mask = mask[np.ix_(rows, columns)]
                if mask.all():
                    mask = np.empty((0, 0), dtype=bool)
            placed = self._placed(camera, poses.compose(camera_from_world, pose), rows, columns)
            first_row, last_row, first_column, last_column = placed.bounds.T
            start = np.concatenate([[0], np.cumsum((last_row - first_row) * (last_column - first_column))])
            found = _Found(int(start[-1]), faces)
            for begin, end in _batches(start):
                effort.amount += self._collect(placed, camera.width, mask, start, begin, end, found)
            return found.hits()

    def images(self, camera: Camera, world_from_part: Tensor | Array) -> Array:
        """Depth images (N, H, W) in metres, +inf where a pixel does not see the part.

        Raises:
            InputError: a pose, the camera's too, is not finite or has no unit quaternion, or the camera's
                intrinsics are none or its lens distorts.
        """
        pose = poses.as_pose(world_from_part, "world_from_part").reshape(-1, 7)
        seen = poses.compose(self._camera_from_world(camera), pose)
        with self.effort.measure(items=len(pose)) as effort:
            placed = self._placed(camera, seen, np.arange(camera.height), np.arange(camera.width))
            images = np.empty((len(pose), camera.height, camera.width))

            def draw(begin: int, end: int) -> int:
                return draw_images(begin, end, placed, images)

            effort.amount += self._shared(draw, 0, len(pose))
        return images

    def _camera_from_world(self, camera: Camera) -> Tensor:
        """The inverse (7,) of where a camera stands that triangles can be drawn for."""
        if camera.is_distorted:
            raise InputError(
                f"camera {camera.name!r} has a lens that distorts, which triangles cannot be drawn through; "
                "give its images to a bcppl.rendering.renderer.DepthRenderer."
            )
        if max(camera.width, camera.height) > LARGEST:
            raise InputError(
                f"camera {camera.name!r} has images of {camera.width} by {camera.height} pixels; "
                f"at most {LARGEST} in a row or column can be drawn."
            )
        return poses.inverse(camera.stated_pose())

    def _placed(self, camera: Camera, camera_from_part: Tensor, rows: Indices, columns: Indices) -> Placed:
        """The mesh at poses (N, 7), before a camera of which these rows and columns matter."""
        rotation = np.ascontiguousarray(poses.rotation_matrix(camera_from_part).numpy())
        offset = np.ascontiguousarray(camera_from_part[:, :3].numpy())
        eye = -np.einsum("nji,nj->ni", rotation, offset)
        outside = ((eye < self._lowest) | (eye > self._highest)).any(axis=1)
        grid = Grid(
            _counts(rows, camera.height),
            _counts(columns, camera.width),
            rows.astype(np.float64),
            columns.astype(np.float64),
        )
        lens, near = np.array([camera.fx, camera.fy, camera.cx, camera.cy]), NEAREST * self._diagonal
        bounds, cull = np.zeros((len(eye), 4), dtype=np.int64), outside & self._solid
        mesh = (self._vertices, self._faces)
        placed = Placed(*mesh, rotation, offset, lens, near, cull, grid, bounds)
        bound(self._corners, placed)
        return placed

    def _collect(
        self,
        placed: Placed,
        width: int,
        mask: Mask,
        start: Indices,
        begin: int,
        end: int,
        found: _Found,
    ) -> int:
        """Draw particles `begin` to `end` and append their hits; how many pixels were compared."""
        own = start - start[begin]
        buffer = np.empty(own[end])
        owner = np.empty(own[end] if found.face is not None else 0, dtype=np.int32)
        count = np.zeros(len(placed.rotation), dtype=np.int64)

        def draw(first: int, last: int) -> int:
            return draw_regions(first, last, placed, mask, own, buffer, owner, count)

        def write(first: int, last: int) -> int:
            drawn = (placed, width, own, buffer, owner, ahead)
            collect(first, last, *drawn, found.particle, found.pixel, found.depth, face)
            return 0

        filled = self._shared(draw, begin, end)
        ahead = found.total + np.cumsum(count) - count
        found.reserve(int(count.sum()))
        face = np.empty(0, dtype=np.int64) if found.face is None else found.face
        self._shared(write, begin, end)
        found.total += int(count.sum())
        return filled

    def _shared(self, work: Callable[[int, int], int], begin: int, end: int) -> int:
        return parallel_sum(work, begin, end, SHARE, self.threads)


class _Found:
    """Hits as they are found, in arrays that grow."""

    def __init__(self, most: int, faces: bool) -> None:
        self.total = 0
        self._most = most
        room = min(most, FEW)
        self.particle, self.pixel = np.empty(room, np.int64), np.empty(room, np.int64)
        self.depth = np.empty(room)
        self.face = np.empty(room, np.int64) if faces else None

    def reserve(self, more: int) -> None:
        """Make room for more hits."""
        needed = self.total + more
        if needed <= len(self.depth):
            return
        room = min(self._most, max(needed, 2 * len(self.depth)))
        self.particle, self.pixel = self._larger(self.particle, room), self._larger(self.pixel, room)
        self.depth = self._larger(self.depth, room)
        if self.face is not None:
            self.face = self._larger(self.face, room)

    def _larger(self, array: npt.NDArray[T], room: int) -> npt.NDArray[T]:
        larger = np.empty(room, array.dtype)
        larger[: self.total] = array[: self.total]
        return larger

    def hits(self) -> Hits:
        """All of them."""
        kept = slice(self.total)
        face = None if self.face is None else self.face[kept]
        return Hits(self.particle[kept], self.pixel[kept], self.depth[kept], face)


def _batches(start: Indices) -> list[tuple[int, int]]:
    """Runs of particles whose pixels fit into the buffer, at least one particle in each."""
    batches, begin, last = [], 0, len(start) - 1
    while begin < last:
        end = int(np.searchsorted(start, start[begin] + BUFFER, side="right")) - 1
        end = min(max(end, begin + 1), last)
        batches.append((begin, end))
        begin = end
    return batches


def _counts(kept: Indices, length: int) -> npt.NDArray[np.int32]:
    """How many of the kept rows (or columns) lie before each, (length + 1,)."""
    is_kept = np.zeros(length + 1, dtype=np.int32)
    is_kept[kept + 1] = 1
    return np.cumsum(is_kept, dtype=np.int32)


def _solid(vertices: Array, faces: Indices, step: float) -> bool:
    """Whether whoever stands outside sees faces from their front only, so that the others need no drawing.

    That is so where the mesh is closed and no point has a negative winding number (Jacobson, Kavan and
    Sorkine-Hornung, Robust inside-outside segmentation, 2013): asked a `step` in front of each face.
    """
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    edges = np.concatenate([faces, np.roll(faces, -1, axis=1)]).reshape(2, -1, 3)
    directed = np.stack([edges[0].ravel(), edges[1].ravel()], axis=1)
    key = directed[:, 0] * len(vertices) + directed[:, 1]
    back = directed[:, 1] * len(vertices) + directed[:, 0]
    if not np.array_equal(np.sort(key), np.sort(back)):
        return False
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    there = size > 0.0
    before = corners.mean(axis=1)[there] + step * normal[there] / size[there, None]
    winding = igl.fast_winding_number(vertices, faces, before)
    return bool((winding > -0.5).all())
