"""Depth alignment: a part moved so that its rendered points meet the measured depth."""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within, whole_number
from bcppl.arrays import Array, Indices
from bcppl.distributions.depth import ClutteredDepth, LaplaceDepth, RobustDepth
from bcppl.distributions.support import freedom_of
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.inference.proposals.least_squares import (
    Alignment,
    Equations,
    aligned,
    alignment_proposal,
    check_pose,
    matching,
)
from bcppl.inference.proposals.proposal import Fittable
from bcppl.poses import FREE, Freedom
from bcppl.rendering.part_renderer import Hits
from bcppl.traces import Trace

FARTHEST = 10.0  # the largest scale of residuals, in scales of the depth's noise
ENOUGH = 200  # pixels of an image, for each particle: more hardly change the step
GRAZING = 0.3  # the cosine of incidence below which the weight of a surface's depth grows no further


def depth_alignment(address: str, sites: str = "depth_*", *, steps: int = 1, reach: float = 1.0) -> Fittable:
    """A proposal about the pose at which the part's rendered points meet the measured depth.

    Gauss-Newton on point to plane distances along the pixels' rays, the planes those of the faces that are
    hit. Large residuals are downweighted (Geman and McClure's weights, their scale the particle's own median
    error), so that pixels of other things do not count. The proposal is a mixture of normals about the
    solution, of the fit's covariance and multiples. It renders once for each step, forward and backward.

    Args:
        address: of the pose.
        sites: a pattern of the addresses of its depth images, `LaplaceDepth`, `RobustDepth` or
            `ClutteredDepth`.
        steps: of Gauss-Newton.
        reach: the steps are damped by a normal prior at the old pose, with the particles' covariance times
            this squared.

    Raises:
        InputError: fewer than one step; when it is run: no address matches, or a site is no depth image or
            of another pose than that at `address`.
    """
    steps = whole_number("depth_alignment is given {} steps", steps)
    reach = number_within("depth_alignment is given reach {}", reach, above=0.0)

    def align(trace: Trace, damping: Tensor, freedom: Freedom) -> Alignment:
        return depth_aligned(trace, address, damping, sites, steps=steps)

    return alignment_proposal(address, reach, align)


def depth_aligned(
    trace: Trace, address: str, damping: Tensor, sites: str = "depth_*", *, steps: int = 1
) -> Alignment:
    """The alignment of each particle, about which `depth_alignment` proposes.

    The damping (d, d) is the precision over the free axes of the normal prior at the start of a step.
    """
    images = matching(trace, "depth_alignment", [sites])
    freedom = freedom_of(trace.distributions[address]) or FREE
    pose = trace[address]
    for _ in range(steps):
        each = [_equations(trace, address, image, pose) for image in images]
        equations, information = (reduce(add, terms) for terms in zip(*each, strict=True))
        alignment = aligned(pose, equations, damping, freedom, information)
        pose = alignment.pose
    return alignment


def _equations(trace: Trace, address: str, image: str, pose: Tensor) -> tuple[Equations, Tensor]:
    """The equations of one depth image for poses (N, 7), and its information (N, 6, 6)."""
    site: Any = trace.distributions[image]
    renderer: Any = getattr(site, "renderer", None)
    of_one_part = isinstance(getattr(renderer, "part", None), Part)
    if not isinstance(site, ClutteredDepth | LaplaceDepth | RobustDepth) or not of_one_part:
        raise InputError(
            f"depth_alignment is given the site {image!r}, which is a {type(site).__name__} and no depth "
            "image; give those that are as `sites`."
        )
    same = torch.allclose(site.pose, trace[address], rtol=0.0, atol=1e-9)
    check_pose("depth_alignment", address, image, same)
    seen, camera = site.observed(trace[image]), site.camera
    hits = renderer.hits(camera, pose, counted=np.asarray(seen.valid.any(axis=0)), faces=True)
    hits, multiplicity = _thinned(hits, len(pose))
    assert hits.face is not None
    own = hits.pixel + hits.particle * seen.depth.shape[1] if len(seen.depth) > 1 else hits.pixel
    error = seen.depth.take(own) - hits.depth
    known = seen.valid.take(own) & (hits.depth < seen.behind.take(hits.pixel))

    camera_from_part = poses.compose(poses.inverse(torch.as_tensor(camera.world_from_camera)), pose)
    turn = poses.rotation_matrix(camera_from_part).numpy()
    row, column = np.divmod(hits.pixel, camera.width)
    ray = np.stack(
        [(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(row))], axis=1
    )
    normal = np.asarray(renderer.part.mesh.face_normals).take(hits.face, axis=0)
    at = ray * hits.depth[:, None] - camera_from_part[:, :3].numpy().take(hits.particle, axis=0)
    turned = turn.take(hits.particle, axis=0)
    point = np.einsum("mji,mj->mi", turned, at)
    # The derivative of the plane's position along its normal by its depth along the ray.
    slope = np.einsum("mji,mj,mi->m", turned, ray, normal)
    scale = _scales(error, known, hits.particle, len(pose), site.scale).take(hits.particle)
    weight = np.where(known, (1.0 + (0.5 * error / scale) ** 2) ** -2, 0.0)
    weight *= multiplicity.take(hits.particle) / (scale * np.maximum(np.abs(slope), GRAZING)) ** 2
    equations = Equations.of_planes(
        pose,
        *(torch.from_numpy(np.asarray(x)) for x in (hits.particle, point, normal, error * slope, weight)),
    )
    return equations, torch.from_numpy(seen.power)[:, None, None] * equations.precision


def _thinned(hits: Hits, particles: int) -> tuple[Hits, Array]:
    """Every k-th hit of each particle, so that at most `ENOUGH` remain, and k (N,)."""
    count = np.bincount(hits.particle, minlength=particles)
    rank = np.arange(len(hits.particle)) - (np.cumsum(count) - count).take(hits.particle)
    stride = np.maximum(-(-count // ENOUGH), 1)
    kept = np.flatnonzero(rank % stride.take(hits.particle) == 0)
    face = None if hits.face is None else hits.face.take(kept)
    thinned = Hits(hits.particle.take(kept), hits.pixel.take(kept), hits.depth.take(kept), face)
    return thinned, stride.astype(np.float64)


def _scales(
    error: Array, known: npt.NDArray[np.bool_], particle: Indices, particles: int, noise: float
) -> Array:
    """Each particle's robust scale of the errors (N,), from their median absolute value, clipped."""
    size = np.where(known, np.abs(error), np.inf)
    order = np.lexsort((size, particle))
    first = np.searchsorted(particle, np.arange(particles))
    count = np.bincount(particle, weights=known, minlength=particles).astype(np.int64)
    middle = size[order].take(np.minimum(first + count // 2, len(order) - 1)) if len(order) else size
    middle = np.where(count > 0, middle, 0.0) if len(order) else np.zeros(particles)
    # A normal's median absolute value is 0.674 standard deviations; a Laplace has 1.41 scales in one.
    return np.asarray(np.clip(1.483 * middle, np.sqrt(2.0) * noise, FARTHEST * noise))
