"""Depth images of a part at many poses, by ray casting with Embree on one core.

The bounding volume hierarchy is built once, in the part's frame, and the rays are transformed there. Rays are
cast only for pixels within the part's projected outline, and only the hits are returned. Triangles, rays and
depths are rounded to single precision; `bcppl.rendering.rasterisation.Rasteriser` works in double precision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array, ArrayRecord, Indices, Mask
from bcppl.effort import Effort
from bcppl.geometry.camera import Camera
from bcppl.geometry.distortion import pinhole_shifts, undistorted_rays
from bcppl.geometry.parts import Part
from bcppl.rendering.part_renderer import Hits, PartRenderer

BATCH = 1 << 14  # rays in one call of Embree: their origins and directions then stay in the cache
MARGIN = 0.05  # pixels: covers the rounding of the triangles and the rays to single precision
MISS = 1e30  # m: Embree returns 1e37 for a ray without a hit


@dataclass(frozen=True, eq=False)
class _Spans(ArrayRecord):
    """Runs of pixels that may see the part, at most one for each particle and image row.

    Of each (S,) the column of its first pixel, and its length in pixels, at least 1.
    """

    particle: Indices
    row: Indices
    first: Indices
    length: Indices


class RayCaster(PartRenderer):
    """Renders the depth of one part by ray casting, through any lens.

    Its time is proportional to the number of pixels and hardly depends on the number of faces.
    """

    __caches__ = ("_scene", *PartRenderer.__caches__)  # of the part's mesh

    def __init__(self, part: Part) -> None:
        super().__init__(part)
        vertices = np.asarray(part.vertices, dtype=np.float64)
        lowest, highest = vertices.min(axis=0), vertices.max(axis=0)
        # Single precision is finest around zero, so the mesh is centred there.
        self._center = 0.5 * (lowest + highest)
        self._diagonal = float(np.linalg.norm(highest - lowest))
        self._outline = _outline(vertices - self._center)
        # Robust: a ray through an edge that two triangles share hits one of them.
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(
            self._scene, np.ascontiguousarray((vertices - self._center)[part.faces], dtype=np.float32)
        )

    def _hits(
        self, camera: Camera, camera_from_part: Tensor, counted: Mask | None, faces: bool, effort: Effort
    ) -> Hits:
        rotation = poses.rotation_matrix(camera_from_part).numpy()
        offset = camera_from_part[:, :3].numpy() + rotation @ self._center
        spans = self._spans(camera, rotation, offset)
        ends = np.cumsum(spans.length)
        rays = int(ends[-1]) if len(ends) else 0
        cuts = np.searchsorted(ends, np.arange(BATCH, rays, BATCH)).tolist()
        return Hits.joined(
            [
                self._cast(camera, rotation, offset, spans[first:last], counted, faces, effort)
                for first, last in zip([0, *cuts], [*cuts, len(ends)], strict=True)
            ]
        )

    def _spans(self, camera: Camera, rotation: Array, offset: Array) -> _Spans:
        """Runs of pixels inside the part's projected outline, from `camera_from_part` (N, 3, 3) and (N, 3).

        The outline is bounded by sixteen tangent lines in fixed directions: a hit outside them is impossible.
        """
        points = self._outline @ rotation.transpose(0, 2, 1) + offset[:, None]
        depth = points[..., 2]
        nearest = depth.min(axis=1)
        # A corner beside or behind the camera has no projection that bounds the part.
        unbounded = nearest < 1e-3 * self._diagonal
        depth = np.where(unbounded[:, None], 1.0, depth)
        u = camera.fx * points[..., 0] / depth + camera.cx
        v = camera.fy * points[..., 1] / depth + camera.cy

        rows = np.arange(camera.height, dtype=np.float64)
        left = np.full((len(points), camera.height), -np.inf)
        right = np.full((len(points), camera.height), np.inf)
        for angle in np.arange(-3, 4) * (math.pi / 8):
            slant = math.tan(angle)
            crossing = u + slant * v
            slanted = slant * rows
            least, most = _distortion_shift(camera, 1.0, slant)
            np.maximum(left, crossing.min(axis=1, keepdims=True) - (slanted + most), out=left)
            np.minimum(right, crossing.max(axis=1, keepdims=True) - (slanted + least), out=right)
        least, most = _distortion_shift(camera, 0.0, 1.0)
        outside = (rows + most < v.min(axis=1, keepdims=True) - MARGIN) | (
            rows + least > v.max(axis=1, keepdims=True) + MARGIN
        )
        left = np.where(unbounded[:, None], 0.0, np.ceil(left - 1.5 * MARGIN))
        right = np.where(unbounded[:, None], camera.width - 1.0, np.floor(right + 1.5 * MARGIN))
        outside &= ~unbounded[:, None]
        outside |= (points[..., 2].max(axis=1) <= 0.0)[:, None]
        first = np.clip(left, 0, camera.width).astype(np.int64)
        length = np.clip(right, -1, camera.width - 1).astype(np.int64) - first + 1
        length[outside] = 0
        particle, row = np.nonzero(length > 0)
        return _Spans(particle, row, first[particle, row], length[particle, row])

    def _cast(
        self,
        camera: Camera,
        rotation: Array,
        offset: Array,
        spans: _Spans,
        counted: Mask | None,
        faces: bool,
        effort: Effort,
    ) -> Hits:
        """The hits of the rays of some spans."""
        span = np.repeat(np.arange(len(spans.length)), spans.length)
        along = np.arange(len(span)) - (np.cumsum(spans.length) - spans.length).take(span)
        first_pixel = spans.row * camera.width + spans.first
        if counted is not None:
            kept = np.flatnonzero(counted.take(first_pixel.take(span) + along))
            span, along = span.take(kept), along.take(kept)
        # The ray of a pixel, z = 1 in the camera, is linear in its column: first + along * step.
        turned = rotation.take(spans.particle, axis=0)
        step = turned[:, 0] / camera.fx
        first = (
            ((spans.first - camera.cx) / camera.fx)[:, None] * turned[:, 0]
            + ((spans.row - camera.cy) / camera.fy)[:, None] * turned[:, 1]
            + turned[:, 2]
        )
        origin = -np.einsum("nji,nj->ni", turned, offset.take(spans.particle, axis=0))
        if camera.is_distorted:
            rays = undistorted_rays(camera.optics).take(first_pixel.take(span) + along, axis=0)
            directions = np.einsum("mji,mj->mi", turned.take(span, axis=0), rays).astype(np.float32)
        else:
            # These gathers are most of the time outside Embree; `take` is four times as fast as brackets.
            directions = step.astype(np.float32).take(span, axis=0)
            directions *= along.astype(np.float32)[:, None]
            directions += first.astype(np.float32).take(span, axis=0)
        origins = origin.astype(np.float32).take(span, axis=0)
        effort.amount += len(origins)
        if faces:
            intersection = self._scene.run(origins, directions, query="INTERSECT", output=1)
            depth = intersection["tfar"]
        else:
            depth = self._scene.run(origins, directions, query="DISTANCE")
        hit = np.flatnonzero(depth < MISS)
        span = span.take(hit)
        return Hits(
            spans.particle.take(span),
            first_pixel.take(span) + along.take(hit),
            depth.take(hit).astype(np.float64),
            intersection["primID"].take(hit).astype(np.int64) if faces else None,
        )


def _distortion_shift(camera: Camera, across: float, down: float) -> tuple[Array | float, Array | float]:
    """The least and the largest shift (H,) of across * u + down * v by distortion in each row, pixels."""
    if not camera.is_distorted:
        return 0.0, 0.0
    shifts = pinhole_shifts(camera.optics)
    moved = across * shifts[..., 0] + down * shifts[..., 1]
    return moved.min(axis=1), moved.max(axis=1)


def _outline(vertices: Array) -> Array:
    """Vertices of the convex hull; the corners of the bounding box where the part is flat."""
    try:
        return np.asarray(vertices[ConvexHull(vertices).vertices])
    except QhullError:
        bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
        return np.asarray(bounds[corners, np.arange(3)])
