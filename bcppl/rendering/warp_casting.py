"""Depth images of a part at many poses, by ray casting with Warp: on a GPU, or on one core without.

One thread casts one ray of one particle, in the part's frame, where the bounding volume hierarchy is built
once. Triangles, rays and depths are in single precision, as those of `bcppl.rendering.ray_casting.RayCaster`.
Without a GPU the renderer that `bcppl.rendering.rasterisation.renderer_for` gives is faster.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from bcppl import poses, warp_arrays
from bcppl.arrays import Array, Indices, Mask
from bcppl.cached import cached_property
from bcppl.devices import numbers
from bcppl.effort import Effort
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.part_renderer import Hits, PartRenderer
from bcppl.rendering.warp_likelihood import CastImages

RAYS = 1 << 26  # in one launch: 0.5 GB of depths and faces
# In place of a face: of a ray that passes the part's bounding sphere, and of another that hits nothing.
AWAY, MISSED = wp.constant(-2), wp.constant(-1)
REACH = wp.constant(1e6)  # m, beyond which nothing is hit


@wp.kernel  # type: ignore[untyped-decorator]
def _cast(
    mesh: wp.uint64,
    part_from_camera: wp.array[wp.mat33],
    eye: wp.array[wp.vec3],
    rays: wp.array[wp.vec3],
    radius: float,
    depth: wp.array2d[float],
    face: wp.array2d[int],
) -> None:
    n, p = wp.tid()
    ray = part_from_camera[n] * rays[p]
    length = wp.length(ray)
    if wp.length(wp.cross(eye[n], ray)) > radius * length:
        face[n, p] = AWAY
        return
    query = wp.mesh_query_ray(mesh, eye[n], ray / length, REACH)
    if query.result:
        # A ray is one metre deep, so that the distance in its lengths is the depth.
        depth[n, p] = query.t / length
        face[n, p] = query.face
    else:
        face[n, p] = MISSED


class WarpCaster(PartRenderer):
    """Renders the depth of one part by Warp's ray casting, through any lens.

    Args:
        part: the part.
        device: torch's, or as Warp names it: "cpu", "cuda", "cuda:1"; a GPU where there is one unless given.
    """

    __caches__ = ("_mesh", "_images", *PartRenderer.__caches__)  # of the part's mesh

    def __init__(self, part: Part, device: torch.device | str | None = None) -> None:
        super().__init__(part)
        self.device = warp_arrays.warp_device(device)
        vertices = np.asarray(part.vertices, dtype=np.float64)
        # Single precision is finest around zero, so the mesh is centred there.
        self._center = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        self._radius = 1.001 * float(np.linalg.norm(vertices - self._center, axis=1).max())
        self._mesh = wp.Mesh(
            self._array(vertices - self._center, wp.vec3),
            wp.array(np.asarray(part.faces, np.int32).ravel(), dtype=int, device=self.device),
        )

    def _array(self, values: Array, kind: Any) -> Any:
        return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=kind, device=self.device)

    def on(self, device: torch.device) -> WarpCaster:
        """Itself on its own device; else as `PartRenderer.on`."""
        return self if warp_arrays.torch_device(self.device) == device else super().on(device)

    @cached_property
    def _images(self) -> CastImages:
        return CastImages(self._mesh, self._center, self._radius, warp_arrays.torch_device(self.device))

    def gains(self, camera: Camera, world_from_part: Tensor, pixels: Any, law: Any, bias: Tensor) -> Tensor:
        """By how much the part at poses (N, 7) changes the log-density of images, (N,), on the device.

        Args:
            camera: that took them.
            world_from_part: (N, 7) the part's poses, on the device.
            pixels: `bcppl.distributions.depth.pixels.Pixels` of one image, or one for each particle.
            law: `bcppl.distributions.depth.pixels.PixelLaw`.
            bias: (N,) added to what is rendered, m.
        """
        camera_from_part = self._camera_from_part(camera, world_from_part)
        count = int(pixels.valid.any(axis=0).sum())
        with self.effort.measure(items=len(world_from_part), amount=len(world_from_part) * count):
            return self._images.gains(camera, camera_from_part, pixels, law, bias)

    def totals(self, depth: Array, behind: Array, shift: Tensor, law: Any) -> Tensor:
        """Log-densities (N,) of pixels (1 or N, P), the background (P,) behind them moved by shifts (N,)."""
        return self._images.totals(depth, behind, shift, law)

    def _hits(
        self, camera: Camera, camera_from_part: Tensor, counted: Mask | None, faces: bool, effort: Effort
    ) -> Hits:
        rotation = numbers(poses.rotation_matrix(camera_from_part))
        offset = numbers(camera_from_part[:, :3]) + rotation @ self._center
        turn = rotation.transpose(0, 2, 1)
        eye = -np.einsum("nij,nj->ni", turn, offset)
        pixels = np.arange(camera.width * camera.height) if counted is None else np.flatnonzero(counted)
        directions = self._array(camera.rays()[pixels], wp.vec3)
        most = max(1, RAYS // max(1, len(pixels)))
        parts = [
            self._cast(slice(first, first + most), turn, eye, directions, pixels, effort)
            for first in range(0, max(1, len(turn)), most)
        ]
        found = Hits.joined(parts)
        return found if faces else Hits(found.particle, found.pixel, found.depth)

    def _cast(
        self, own: slice, turn: Array, eye: Array, directions: Any, pixels: Indices, effort: Effort
    ) -> Hits:
        """The hits of rays of some particles."""
        turns, eyes = self._array(turn[own], wp.mat33), self._array(eye[own], wp.vec3)
        shape = (len(turns), len(pixels))
        depth = wp.empty(shape, dtype=float, device=self.device)
        face = wp.empty(shape, dtype=int, device=self.device)
        given = [self._mesh.id, turns, eyes, directions, self._radius]
        wp.launch(_cast, dim=shape, inputs=given, outputs=[depth, face], device=self.device)
        hit = face.numpy()
        effort.amount += np.count_nonzero(hit != AWAY)
        particle, pixel = np.nonzero(hit > MISSED)
        there = (particle, pixel)
        return Hits(
            particle + own.start,
            pixels[pixel],
            depth.numpy()[there].astype(np.float64),
            hit[there].astype(np.int64),
        )
