"""Depth images of a part above a table by cameras that are off, ray by ray, with noise of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.parts import Part
from bcppl.sensors.depth import DepthImage, View
from bcppl.sensors.measurements import Measurement

OFF, TURNED = 0.002, np.radians(0.5)  # root mean square of a camera's whole error: m, rad
BIAS = 0.002  # m, standard deviation of an image's range bias
NOISE = 0.0012  # m, scale of the Laplace distribution of a pixel's error half a metre away
LOST, LOST_AT_EDGES, FLYING = 0.02, 0.25, 0.5  # shares of pixels; the last two of those at a depth edge
EDGE = 0.008  # m, smallest difference of neighbouring depths at a depth edge
BELOW = 0.06  # m, of the table below the part's origin


def views(
    part: Part, truth: Array, around: Array, generator: np.random.Generator
) -> tuple[list[Measurement], dict[str, Array]]:
    """Two views of a part at its true pose (7,), and the measured backgrounds by camera name.

    Args:
        part: its mesh is seen; its highest face is at z = 0.
        truth: (7,) world_from_part.
        around: (3,) the point that the cameras look at, metres.
        generator: of random numbers.
    """
    vertices = Rotation.from_quat(truth[3:], scalar_first=True).apply(part.vertices) + truth[:3]
    triangles, table = vertices[part.faces], around[2] - BELOW
    heading = generator.uniform(0.0, 2.0 * np.pi)
    measurements, backgrounds = list[Measurement](), dict[str, Array]()
    for k in range(2):
        azimuth = heading + k * generator.uniform(1.2, 2.2)
        height, distance = generator.uniform(0.7, 1.15), generator.uniform(0.38, 0.5)
        flat = np.cos(height)
        eye = around + distance * np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)])
        pose = np.asarray(looking_at(eye, around + generator.normal(0.0, 0.008, 3)))
        stated = Camera(f"side_{k}", 160, 120, 190.0, 190.0, 79.5, 59.5, pose, near=0.1, far=2.0)
        real = replace(stated, world_from_camera=perturbed(pose, OFF, TURNED, generator))
        bias = generator.normal(0.0, BIAS)
        plain = rendered(real, np.zeros((0, 3, 3)), table)
        seen = np.fmin(plain, rendered(real, triangles))
        backgrounds[stated.name] = _measured(plain, bias, 0.1 * NOISE, generator, edges=False)
        measurements.append(
            Measurement(View(stated), DepthImage(_measured(seen, bias, NOISE, generator, edges=True)))
        )
    return measurements, backgrounds


def perturbed(pose: Array, off: float, turned: float, generator: np.random.Generator) -> Array:
    """A pose (7,) with a normal error of these root mean square lengths, about its own origin."""
    turn = Rotation.from_rotvec(generator.normal(0.0, turned / np.sqrt(3.0), 3))
    rotation = Rotation.from_quat(pose[3:], scalar_first=True) * turn
    place = pose[:3] + generator.normal(0.0, off / np.sqrt(3.0), 3)
    return np.append(place, rotation.as_quat(scalar_first=True))


def rendered(camera: Camera, triangles: Array, table: float | None = None) -> Array:
    """Depths (H, W) of triangles (F, 3, 3) in the world, and of a table at a height; NaN where nothing is.

    Möller and Trumbore, Fast, minimum storage ray-triangle intersection, 1997.
    """
    turn = Rotation.from_quat(camera.world_from_camera[3:], scalar_first=True)
    eye = np.asarray(camera.world_from_camera[:3])
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    rays = turn.apply(rays.reshape(-1, 3))  # their third optical coordinate is 1: lengths are depths
    depth = np.full(len(rays), np.nan)
    if table is not None:
        down = rays[:, 2] < 0.0
        depth[down] = (table - eye[2]) / rays[down, 2]
    for corner, second, third in triangles:
        one, two, away = second - corner, third - corner, eye - corner
        across = np.cross(rays, two)
        volume = across @ one
        with np.errstate(divide="ignore", invalid="ignore"):
            first = across @ away / volume
            turned = np.cross(away, one)
            second_share, far = rays @ turned / volume, two @ turned / volume
            hit = (first >= 0.0) & (second_share >= 0.0) & (first + second_share <= 1.0) & (far > 0.0)
        depth[hit] = np.fmin(depth[hit], far[hit])
    return depth.reshape(camera.height, camera.width)


def _measured(depth: Array, bias: float, noise: float, generator: np.random.Generator, edges: bool) -> Array:
    """An image with bias, Laplace errors, lost pixels and, at depth edges, flying pixels."""
    scale = noise * (depth / 0.5) ** 2
    image = depth + bias + scale * generator.laplace(0.0, 1.0, depth.shape)
    filled = np.where(np.isfinite(depth), depth, np.nanmax(depth))
    near, far = minimum_filter(filled, 3), maximum_filter(filled, 3)
    edge = (far - near > EDGE) & edges
    flying = edge & (generator.random(depth.shape) < FLYING)
    image = np.where(flying, near + generator.random(depth.shape) * (far - near) + bias, image)
    lost = generator.random(depth.shape) < np.where(edge, LOST_AT_EDGES, LOST)
    return np.where(lost, np.nan, image).astype(np.float32)
