"""Depth images of a part at many poses, by rasterising its triangles into a depth buffer.

All numbers are in double precision, where `bcppl.rendering.ray_casting.RayCaster` works in single. The time
is proportional to the numbers of triangles and of fragments, so it suits all but the finest meshes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import igl
import numpy as np
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array, Indices, Mask, Numbers
from bcppl.cached import cached_property
from bcppl.devices import is_on_host
from bcppl.effort import Effort
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.depth_buffers import render_images, render_regions, write_hits
from bcppl.rendering.part_renderer import Hits, PartRenderer
from bcppl.rendering.ray_casting import RayCaster
from bcppl.rendering.scan_conversion import Grid, PosedMesh, bound_regions
from bcppl.threads import parallel_sum, thread_count

BUFFER = 1 << 20  # pixels rendered before hits are collected: 8 MB, which fits most processors' caches
NEAREST = 1e-6  # of the part's diagonal: the near plane
FEW = 1 << 23  # hits that are allocated at first; memory that is not written costs nothing
SHARE = 8  # particles in one run of a thread
MOST_FACES = 30_000  # of a part that is rasterised


class Rasteriser(PartRenderer):
    """Renders the depth of one part by rasterisation, through a distorting lens by ray casting.

    Attributes:
        threads: how many threads share the particles, without an effect on the result; None for one on each
            core, or the number in OMP_NUM_THREADS.
    """

    def __init__(self, part: Part, threads: int | None = None) -> None:
        super().__init__(part)
        self.threads = thread_count() if threads is None else threads
        vertices, faces, self._solid = _merged(part)
        self._vertices = np.ascontiguousarray(vertices.T)
        self._faces = np.ascontiguousarray(faces.T.astype(np.uint32))
        self._lowest, self._highest = vertices.min(axis=0), vertices.max(axis=0)
        self._diagonal = float(np.linalg.norm(self._highest - self._lowest))
        corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
        self._corners = np.ascontiguousarray(np.where(corners == 0, self._lowest, self._highest).T)

    @cached_property
    def _ray_caster(self) -> RayCaster:
        return RayCaster(self.part)

    def _hits(
        self, camera: Camera, camera_from_part: Tensor, counted: Mask | None, faces: bool, effort: Effort
    ) -> Hits:
        if camera.is_distorted:
            return self._ray_caster._hits(camera, camera_from_part, counted, faces, effort)
        rows, columns = np.arange(camera.height), np.arange(camera.width)
        mask = np.empty((0, 0), dtype=bool)
        if counted is not None:
            mask = counted.reshape(camera.height, camera.width)
            rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            mask = mask[np.ix_(rows, columns)]
            if mask.all():
                mask = np.empty((0, 0), dtype=bool)
        mesh = self._posed(camera, camera_from_part, rows, columns)
        first_row, last_row, first_column, last_column = mesh.bounds.T
        start = np.concatenate([[0], np.cumsum((last_row - first_row) * (last_column - first_column))])
        hits = _GrowingHits(int(start[-1]), faces)
        for begin, end in _batches(start):
            effort.amount += self._collect(mesh, camera.width, mask, start, begin, end, hits)
        return Hits(*(column[: hits.total] for column in hits.columns))

    def images(self, camera: Camera, world_from_part: Tensor | Array) -> Array:
        """As `PartRenderer.images`, without collecting hits."""
        camera_from_part = self._camera_from_part(camera, world_from_part)
        if camera.is_distorted or not is_on_host(camera_from_part):
            return super().images(camera, world_from_part)
        with self.effort.measure(items=len(camera_from_part)) as effort:
            rows, columns = np.arange(camera.height), np.arange(camera.width)
            mesh = self._posed(camera, camera_from_part, rows, columns)
            images = np.empty((len(camera_from_part), camera.height, camera.width))
            effort.amount += self._shared(
                lambda begin, end: render_images(begin, end, mesh, images), 0, len(images)
            )
        return images

    def _posed(self, camera: Camera, camera_from_part: Tensor, rows: Indices, columns: Indices) -> PosedMesh:
        """The mesh at poses (N, 7) in front of a camera of which these rows and columns are rendered."""
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
        mesh = PosedMesh(self._vertices, self._faces, rotation, offset, lens, near, cull, grid, bounds)
        bound_regions(self._corners, mesh)
        return mesh

    def _collect(
        self,
        mesh: PosedMesh,
        width: int,
        mask: Mask,
        start: Indices,
        begin: int,
        end: int,
        hits: _GrowingHits,
    ) -> int:
        """The number of fragments of particles `begin` to `end`, whose hits are appended."""
        own = start - start[begin]
        faces = len(hits.columns) == 4
        buffer, face_buffer = np.empty(own[end]), np.empty(own[end] if faces else 0, dtype=np.int32)
        count = np.zeros(len(mesh.rotation), dtype=np.int64)

        def render(first: int, last: int) -> int:
            return render_regions(first, last, mesh, mask, own, buffer, face_buffer, count)

        def write(first: int, last: int) -> int:
            write_hits(first, last, mesh, width, own, buffer, face_buffer, first_hit, *columns)
            return 0

        fragments = self._shared(render, begin, end)
        first_hit = hits.total + np.cumsum(count) - count
        hits.reserve(int(count.sum()))
        columns = hits.columns if faces else [*hits.columns, np.empty(0, dtype=np.int64)]
        self._shared(write, begin, end)
        hits.total += int(count.sum())
        return fragments

    def _shared(self, work: Callable[[int, int], int], begin: int, end: int) -> int:
        return parallel_sum(work, begin, end, SHARE, self.threads)


class _GrowingHits:
    """Columns of hits (particle, pixel, depth and perhaps face) that grow by doubling."""

    def __init__(self, most: int, faces: bool) -> None:
        self.total, self._most = 0, most
        kinds = (np.int64, np.int64, np.float64, *([np.int64] if faces else []))
        self.columns: list[Any] = [np.empty(min(most, FEW), kind) for kind in kinds]

    def reserve(self, more: int) -> None:
        """Make room for more hits."""
        size = len(self.columns[0])
        if self.total + more > size:
            rest = min(self._most, max(self.total + more, 2 * size)) - self.total
            self.columns = [np.append(c[: self.total], np.empty(rest, c.dtype)) for c in self.columns]


def _batches(start: Indices) -> list[tuple[int, int]]:
    """Runs of particles whose pixels fit into the buffer, at least one particle in each."""
    batches, begin, last = [], 0, len(start) - 1
    while begin < last:
        end = int(np.searchsorted(start, start[begin] + BUFFER, side="right")) - 1
        end = min(max(end, begin + 1), last)
        batches.append((begin, end))
        begin = end
    return batches


def _counts(rendered: Indices, length: int) -> Numbers:
    """The number of rendered rows (or columns) before each one of the image, (length + 1,)."""
    is_rendered = np.zeros(length + 1, dtype=np.int32)
    is_rendered[rendered + 1] = 1
    return np.cumsum(is_rendered, dtype=np.int32)


@lru_cache(maxsize=8)
def _merged(part: Part) -> tuple[Array, Indices, bool]:
    """A part's vertices (V, 3) without doubles, its faces (F, 3), and whether it is `_solid`."""
    # Vertices that are doubled at seams are merged: fewer to project, and a closed mesh tests as closed.
    vertices, which = np.unique(np.asarray(part.vertices, np.float64), axis=0, return_inverse=True)
    faces = which.reshape(-1)[part.faces]
    return vertices, faces, _solid(vertices, faces, 1e-4 * float(np.linalg.norm(part.extent)))


def _solid(vertices: Array, faces: Indices, step: float) -> bool:
    """Whether only front faces can be seen from outside, so that back faces can be culled.

    That is so where the mesh is closed and no point has a negative winding number (Jacobson, Kavan and
    Sorkine-Hornung, Robust inside-outside segmentation, 2013), which is evaluated a `step` in front of each
    face.
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


def renderer_for(part: Part) -> PartRenderer:
    """The faster renderer of a part: `Rasteriser` up to 30,000 faces, `RayCaster` above.

    Both take the same calls, and their depths agree to single precision. On one core rasterisation was faster
    than ray casting by factors of 8 to 32 for a ring of 512 faces and of 2.3 to 4.3 for a drill of 16,000
    (75 poses, 128 x 128 to 640 x 480, `benchmarks/render.py`). It is compiled on its first use, once for an
    installation: 11 s, then 0.6 s to load the code in every process; a run saves more.
    """
    return RayCaster(part) if len(part.faces) > MOST_FACES else Rasteriser(part)
