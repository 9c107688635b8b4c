"""Depth images of a part at many poses, by ray casting with Embree on one core.

The tree of triangles is built once, in the part's frame, and the rays are brought there. Most pixels never
see the part, so only those within its projected outline are cast, and only what they hit is returned.
Triangles and rays are rounded to single precision, and so are depths;
`bcppl.rendering.rasteriser.DepthRasteriser` draws in double precision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from bcppl import poses
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.distortion import pinhole_shifts, undistorted_rays
from bcppl.geometry.parts import Part

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

BATCH = 1 << 14  # rays in one call of Embree: their origins and directions then stay in the cache
MARGIN = 0.05  # pixels: covers the rounding of the triangles and the rays to single precision
MISS = 1e30  # m: Embree returns 1e37 for a ray that hits nothing


@dataclass(frozen=True, eq=False)
class Hits:
    """The pixels that see the part, for all particles, ordered by particle and then by pixel.

    Attributes:
        particle: (M,) which particle.
        pixel: (M,) which pixel, v * width + u.
        depth: (M,) depth along the optical axis, metres.
        face: (M,) which face of the part's mesh; None unless it was asked for.
    """

    particle: Indices
    pixel: Indices
    depth: Array
    face: Indices | None = None


@dataclass(frozen=True, eq=False)
class _Spans:
    """Runs of pixels that may see the part: at most one for each particle and image row.

    Attributes:
        particle, row: (S,) whose, and in which row.
        first: (S,) column of the first pixel.
        length: (S,) pixels, at least 1.
    """

    particle: Indices
    row: Indices
    first: Indices
    length: Indices

    def __getitem__(self, part: slice) -> _Spans:
        return _Spans(self.particle[part], self.row[part], self.first[part], self.length[part])


class DepthRenderer:
    """Renders the depth of one part.

    Attributes:
        part: the part.
        effort: images asked for, rays cast and seconds spent so far.
    """

    def __init__(self, part: Part, robust: bool = True) -> None:
        """Build the tree.

        Args:
            part: what is rendered; its mesh may be open.
            robust: whether a ray through an edge shared by two triangles surely hits one of them.

        Raises:
            InputError: the mesh is empty or not finite.
        """
        part.check(closed=False)
        self.part = part
        self.effort = Effort()
        vertices = np.asarray(part.vertices, dtype=np.float64)
        lowest, highest = vertices.min(axis=0), vertices.max(axis=0)
        # Single precision is finest around zero, so the tree is centred there.
        self._center = 0.5 * (lowest + highest)
        self._diagonal = float(np.linalg.norm(highest - lowest))
        self._outline = _outline(vertices - self._center)
        self._scene = EmbreeScene(robust=robust)
        TriangleMesh(
            self._scene, np.ascontiguousarray((vertices - self._center)[part.faces], dtype=np.float32)
        )

    def hits(
        self,
        camera: Camera,
        world_from_part: Tensor | Array,
        counted: npt.NDArray[np.bool_] | None = None,
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
                intrinsics are none; the counted pixels are not those of its image.
        """
        pose = poses.as_pose(world_from_part, "world_from_part").reshape(-1, 7)
        camera_from_world = poses.inverse(camera.stated_pose())
        counted = None if counted is None else counted_pixels(camera, counted)
        with self.effort.measure(items=len(pose)) as effort:
            camera_from_part = poses.compose(camera_from_world, pose)
            rotation = poses.rotation_matrix(camera_from_part).numpy()
            offset = camera_from_part[:, :3].numpy() + rotation @ self._center
            spans = self._spans(camera, rotation, offset)
            ends = np.cumsum(spans.length)
            rays = int(ends[-1]) if len(ends) else 0
            particle, pixel, depth = np.empty(rays, np.int64), np.empty(rays, np.int64), np.empty(rays)
            face = np.empty(rays, np.int64) if faces else None
            cuts = np.searchsorted(ends, np.arange(BATCH, rays, BATCH)).tolist()
            total = 0
            for first, last in zip([0, *cuts], [*cuts, len(ends)], strict=True):
                ahead = None if face is None else face[total:]
                free = Hits(particle[total:], pixel[total:], depth[total:], ahead)
                hit, cast = self._cast(camera, rotation, offset, spans[first:last], counted, free)
                total += hit
                effort.amount += cast
            return Hits(
                particle[:total], pixel[:total], depth[:total], None if face is None else face[:total]
            )

    def images(self, camera: Camera, world_from_part: Tensor | Array) -> Array:
        """Depth images (N, H, W) in metres, +inf where a pixel does not see the part.

        Raises:
            InputError: a pose, the camera's too, is not finite or has no unit quaternion, or the camera's
                intrinsics are none.
        """
        pose = poses.as_pose(world_from_part, "world_from_part").reshape(-1, 7)
        camera.stated_pose()  # before an image of its size is made
        image = np.full((len(pose), camera.height * camera.width), np.inf)
        found = self.hits(camera, pose)
        image[found.particle, found.pixel] = found.depth
        return image.reshape(-1, camera.height, camera.width)

    def _spans(self, camera: Camera, rotation: Array, offset: Array) -> _Spans:
        """Runs of pixels inside the part's projected outline, from `camera_from_part` (N, 3, 3) and (N, 3).

        The outline is bounded by sixteen tangent lines at fixed directions: a hit outside them is impossible.
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
            slope = math.tan(angle)
            crossing = u + slope * v
            slanted = slope * rows
            least, most = _shifted(camera, 1.0, slope)
            np.maximum(left, crossing.min(axis=1, keepdims=True) - (slanted + most), out=left)
            np.minimum(right, crossing.max(axis=1, keepdims=True) - (slanted + least), out=right)
        least, most = _shifted(camera, 0.0, 1.0)
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
        counted: npt.NDArray[np.bool_] | None,
        free: Hits,
    ) -> tuple[int, int]:
        """Cast a batch of spans, write its hits to the front of `free`: how many hits, how many rays."""
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
            rays = undistorted_rays(*camera.optics).take(first_pixel.take(span) + along, axis=0)
            directions = np.einsum("mji,mj->mi", turned.take(span, axis=0), rays).astype(np.float32)
        else:
            # These gathers are most of the time outside Embree; `take` is four times as fast as brackets.
            directions = step.astype(np.float32).take(span, axis=0)
            directions *= along.astype(np.float32)[:, None]
            directions += first.astype(np.float32).take(span, axis=0)
        origins = origin.astype(np.float32).take(span, axis=0)
        if free.face is None:
            depth = self._scene.run(origins, directions, query="DISTANCE")
            hit = np.flatnonzero(depth < MISS)
        else:
            found = self._scene.run(origins, directions, query="INTERSECT", output=1)
            depth = found["tfar"]
            hit = np.flatnonzero(depth < MISS)
            free.face[: len(hit)] = found["primID"].take(hit)
        span = span.take(hit)
        spans.particle.take(span, out=free.particle[: len(hit)], mode="clip")
        np.add(first_pixel.take(span), along.take(hit), out=free.pixel[: len(hit)])
        free.depth[: len(hit)] = depth.take(hit)
        return len(hit), len(depth)


def counted_pixels(camera: Camera, counted: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Which pixels count, (H * W,), from a mask (H * W,) or (H, W).

    Raises:
        InputError: it is no mask of the camera's image.
    """
    mask = np.asarray(counted)
    if mask.shape not in ((camera.height, camera.width), (camera.height * camera.width,)):
        raise InputError(
            f"the counted pixels of camera {camera.name!r} have shape {mask.shape}; give a mask of all its "
            f"pixels, {(camera.height, camera.width)}, true where a pixel counts, and no indices."
        )
    return np.ascontiguousarray(mask, dtype=bool).reshape(-1)


def _shifted(camera: Camera, across: float, down: float) -> tuple[Array | float, Array | float]:
    """The least and the most (H,) that distortion moves across * u + down * v in each row, pixels."""
    if not camera.is_distorted:
        return 0.0, 0.0
    shifts = pinhole_shifts(*camera.optics)
    moved = across * shifts[..., 0] + down * shifts[..., 1]
    return moved.min(axis=1), moved.max(axis=1)


def _outline(vertices: Array) -> Array:
    """Points whose hull holds all vertices: their convex hull's, or their box's where the part is flat."""
    try:
        return np.asarray(vertices[ConvexHull(vertices).vertices])
    except QhullError:
        bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
        return np.asarray(bounds[corners, np.arange(3)])
