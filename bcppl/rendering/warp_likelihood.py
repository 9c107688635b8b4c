"""The likelihood of a depth image by rays cast with Warp: a sum over pixels, of which no hit is kept.

Many particles have billions of hits; their numbers never leave the device. Rays and triangles are in single
precision, the density of a pixel and its sum in double.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from bcppl import poses, warp_arrays
from bcppl.arrays import Array
from bcppl.devices import on_device_of
from bcppl.geometry.camera import Camera
from bcppl.geometry.distortion import Optics

# Sums of each particle, at least, so that neighbouring threads cast neighbouring rays, and threads in all.
STRIPES, THREADS = 64, 1 << 20
REACH = wp.constant(1e6)  # m, beyond which nothing is hit
UNKNOWN = wp.constant(wp.float64(1e300))  # m: no background


@wp.struct
class Law:
    """As `bcppl.distributions.depth.pixels.PixelLaw`."""

    near: wp.float64
    far: wp.float64
    scale: wp.float64
    outlier: wp.float64


@wp.struct
class Image:
    """The P pixels that count: rays, and as `bcppl.distributions.depth.pixels.Pixels`, I images of them."""

    rays: wp.array[wp.vec3]
    depth: wp.array2d[wp.float64]
    valid: wp.array2d[wp.uint8]
    behind: wp.array[wp.float64]
    without_part: wp.array2d[wp.float64]
    moves: int


@wp.func  # type: ignore[untyped-decorator]
def _log_density(depth: wp.float64, rendered: wp.float64, law: Law) -> wp.float64:
    away = wp.abs(depth - rendered) / law.scale
    if law.outlier == wp.float64(0.0):
        return -away - wp.log(wp.float64(2.0) * law.scale)
    density = wp.exp(-away) * (wp.float64(1.0) - law.outlier) / (wp.float64(2.0) * law.scale)
    return wp.log(density + law.outlier / (law.far - law.near))


@wp.kernel  # type: ignore[untyped-decorator]
def _sum_gains(
    mesh: wp.uint64,
    part_from_camera: wp.array[wp.mat33],
    eye: wp.array[wp.vec3],
    radius: float,
    bias: wp.array[wp.float64],
    image: Image,
    law: Law,
    gains: wp.array2d[wp.float64],
) -> None:
    n, stripe = wp.tid()
    turn = part_from_camera[n]
    origin = eye[n]
    own = wp.min(n, image.depth.shape[0] - 1)
    total = wp.float64(0.0)
    for p in range(stripe, image.rays.shape[0], gains.shape[1]):
        if image.valid[own, p] == wp.uint8(0):
            continue
        ray = turn * image.rays[p]
        length = wp.length(ray)
        if wp.length(wp.cross(origin, ray)) > radius * length:
            continue
        query = wp.mesh_query_ray(mesh, origin, ray / length, REACH)
        if not query.result:
            continue
        # A ray is one metre deep, so that the distance in its lengths is the depth.
        surface = wp.float64(query.t / length) + bias[n]
        depth = image.depth[own, p]
        behind = image.behind[p]
        without = image.without_part[own, p]
        if image.moves != 0:
            without = -wp.log(law.far - law.near)
            if behind < UNKNOWN:
                behind += bias[n]
                without = _log_density(depth, behind, law)
        total += _log_density(depth, wp.min(surface, behind), law) - without
    gains[n, stripe] = total


@wp.kernel  # type: ignore[untyped-decorator]
def _sum_shifted(
    depth: wp.array2d[wp.float64],
    behind: wp.array[wp.float64],
    shift: wp.array[wp.float64],
    law: Law,
    total: wp.array[wp.float64],
) -> None:
    n = wp.tid()
    own = wp.min(n, depth.shape[0] - 1)
    found = wp.float64(0.0)
    for p in range(behind.shape[0]):
        found += _log_density(depth[own, p], behind[p] + shift[n], law)
    total[n] = found


class CastImages:
    """Sums over the pixels of images at which rays meet a part.

    Args:
        mesh: of the part about its middle, Warp's.
        center: (3,) that middle in the part's frame, m.
        radius: of a sphere about it that holds the part, m.
        device: torch's.
    """

    def __init__(self, mesh: Any, center: Array, radius: float, device: torch.device) -> None:
        self._mesh, self._radius, self._device = mesh, radius, device
        self._center = torch.as_tensor(center, dtype=torch.float64, device=device)
        # The numbers of the newest images, which the particles of many calls are compared with. One image may
        # be compared at the rays of several cameras, as where intrinsics are estimated.
        self._images: dict[tuple[int, Optics, bool], tuple[Any, Image]] = {}

    def gains(self, camera: Camera, camera_from_part: Tensor, seen: Any, law: Any, bias: Tensor) -> Tensor:
        """By how much a part at poses (N, 7) changes the log-density of images, (N,).

        Args:
            camera: that took them.
            camera_from_part: (N, 7).
            seen: `bcppl.distributions.depth.pixels.Pixels` of one image, or one for each particle.
            law: of a pixel.
            bias: (N,) added to what is rendered, m.
        """
        turn = poses.rotation_matrix(camera_from_part).transpose(-1, -2)
        offset = camera_from_part[:, :3, None] + turn.transpose(-1, -2) @ self._center[:, None]
        eye = -(turn @ offset)[..., 0]
        stripes = max(STRIPES, THREADS // max(1, len(eye)) // 32 * 32)
        shape = (len(eye), min(stripes, camera.width * camera.height))
        gains = torch.empty(shape, dtype=torch.float64, device=self._device)
        inputs = [
            self._mesh.id,
            (turn.to(torch.float32), wp.mat33),
            (eye.to(torch.float32), wp.vec3),
            self._radius,
            (bias, wp.float64),
            self._image(camera, seen),
            _law_of(law),
        ]
        warp_arrays.launch(_sum_gains, shape, inputs, [(gains, wp.float64)])
        return gains.sum(dim=1)

    def totals(self, depth: Array, behind: Array, shift: Tensor, law: Any) -> Tensor:
        """Log-densities (N,) of pixels (1 or N, P), the background (P,) behind them moved by shifts (N,)."""
        total = torch.empty(len(shift), dtype=torch.float64, device=self._device)
        inputs = [
            (on_device_of(np.ascontiguousarray(depth), shift), wp.float64),
            (on_device_of(np.ascontiguousarray(behind), shift), wp.float64),
            (shift, wp.float64),
            _law_of(law),
        ]
        warp_arrays.launch(_sum_shifted, len(shift), inputs, [(total, wp.float64)])
        return total

    def _image(self, camera: Camera, seen: Any) -> Image:
        key = id(seen.depth), camera.optics, bool(seen.moves)
        known = self._images.get(key)
        if known is not None and known[0] is seen.depth:
            return known[1]
        which = np.flatnonzero(seen.valid.any(axis=0))

        def array(values: Any, kind: Any, number: Any) -> Any:
            given = torch.from_numpy(np.ascontiguousarray(values, dtype=number)).to(self._device)
            return warp_arrays.array_of(given, kind)

        image = Image()
        image.rays = array(camera.rays()[which], wp.vec3, np.float32)
        image.depth = array(np.nan_to_num(seen.depth[:, which]), wp.float64, np.float64)
        image.valid = array(seen.valid[:, which], wp.uint8, np.uint8)
        behind = np.where(np.isfinite(seen.behind), seen.behind, 1e300)
        image.behind = array(behind[which], wp.float64, np.float64)
        image.without_part = array(seen.without_part[:, which], wp.float64, np.float64)
        image.moves = int(seen.moves)
        for old in list(self._images)[:-7]:
            del self._images[old]
        self._images[key] = (seen.depth, image)
        return image


def _law_of(law: Any) -> Law:
    given = Law()
    for name in law._fields:
        setattr(given, name, wp.float64(getattr(law, name)))
    return given
