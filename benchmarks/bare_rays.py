"""A kernel of Warp's that casts the rays of a camera at many poses and writes their depths, and no more."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from bcppl import poses, warp_arrays


@wp.kernel
def _cast(
    mesh: wp.uint64,
    turn: wp.array[wp.mat33],
    eye: wp.array[wp.vec3],
    rays: wp.array[wp.vec3],
    depth: wp.array2d[float],
) -> None:
    n, p = wp.tid()
    query = wp.mesh_query_ray(mesh, eye[n], turn[n] * rays[p], 1.0e6)
    depth[n, p] = wp.where(query.result, query.t, 0.0)


def cast(caster: Any, camera: Any, camera_from_part: Tensor, rays: Tensor) -> Callable[[], None]:
    """What casts all rays of a camera at poses (N, 7): arrays are made beforehand."""
    turn = poses.rotation_matrix(camera_from_part).transpose(-1, -2)
    center = torch.as_tensor(caster._center, dtype=torch.float64, device=turn.device)
    offset = camera_from_part[:, :3, None] + turn.transpose(-1, -2) @ center[:, None]
    rays = torch.nn.functional.normalize(rays, dim=1).to(turn)
    given = [
        caster._mesh.id,
        (turn.to(torch.float32), wp.mat33),
        (-(turn @ offset)[..., 0].to(torch.float32), wp.vec3),
        (rays.to(torch.float32), wp.vec3),
    ]
    shape = (len(turn), len(rays))
    depth = (torch.empty(shape, dtype=torch.float32, device=turn.device), wp.float32)
    return lambda: warp_arrays.launch(_cast, shape, given, [depth])
