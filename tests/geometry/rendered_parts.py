"""Parts, cameras and poses that the renderers are tested with."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
import trimesh
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.parts import Part

RING = trimesh.creation.annulus(r_min=0.01, r_max=0.03, height=0.03, sections=64)
SPHERE = trimesh.creation.icosphere(subdivisions=4, radius=0.03)  # most of its faces are smaller than a pixel
# A pipe without lids: its inside is seen from behind the outer wall's faces.
PIPE = trimesh.Trimesh(RING.vertices, RING.faces[np.abs(RING.face_normals[:, 2]) < 0.5], process=False)
# An L, which no flip or turn of the image leaves as it is.
ELL = trimesh.util.concatenate(
    [
        trimesh.creation.box(bounds=[[0, 0, 0], [0.06, 0.02, 0.02]]),
        trimesh.creation.box(bounds=[[0, 0.03, 0], [0.02, 0.04, 0.02]]),
    ]
)
# Closed, but its second box is turned inside out: its back faces are the ones that are seen.
TURNED = trimesh.Trimesh(ELL.vertices, np.concatenate([ELL.faces[:12], ELL.faces[12:, ::-1]]), process=False)
MESHES = {"ring": RING, "sphere": SPHERE, "pipe": PIPE, "turned": TURNED}


def part_of(mesh: trimesh.Trimesh, scale: float = 1.0, name: str = "part") -> Part:
    return Part(name, scale * np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def camera(scale: float = 1.0, width: int = 57, height: int = 41) -> Camera:
    """Different focal lengths, an off-centre principal point, neither square nor aligned with anything."""
    pose = looking_at(scale * np.array([0.10, -0.15, 0.20]), [0.01 * scale, 0.01 * scale, 0.0], [0.3, 0.5, 1])
    return Camera("tilted", width, height, 65.0, 72.0, 24.3, 22.9, pose)


def random_poses(count: int, seed: int, spread: float) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(count, random_state=seed).as_quat()[:, [3, 0, 1, 2]]
    return torch.from_numpy(np.concatenate([rng.normal(size=(count, 3)) * spread, turn], axis=1))


def around_camera(count: int, seed: int, spread: float) -> torch.Tensor:
    """Poses near the camera's centre: beside it, behind it, across its plane, around it."""
    pose = random_poses(count, seed, spread)
    pose[:, :3] += torch.from_numpy(camera().world_from_camera[:3])
    return pose


def world_rays(camera: Camera) -> tuple[Array, Array]:
    """The camera's centre (3,) and its pixels' rays (H * W, 3) in the world, one metre deep."""
    pose = camera.world_from_camera
    return pose[:3], Rotation.from_quat(pose[[4, 5, 6, 3]]).apply(camera.rays())


def by_trimesh(part: Part, camera: Camera, pose: Array) -> Array:
    """(H, W) by trimesh's rays in the world, +inf where they miss."""
    eye, rays = world_rays(camera)
    vertices = Rotation.from_quat(pose[[4, 5, 6, 3]]).apply(part.vertices) + pose[:3]
    mesh = trimesh.Trimesh(vertices, part.faces, process=False)
    points, ray, _ = mesh.ray.intersects_location(np.tile(eye, (len(rays), 1)), rays, multiple_hits=False)
    depth = np.full(len(rays), np.inf)
    forward = Rotation.from_quat(camera.world_from_camera[[4, 5, 6, 3]]).apply([0, 0, 1])
    depth[ray] = (points - eye) @ forward
    return depth.reshape(camera.height, camera.width)


def beside_edges(image: Array) -> npt.NDArray[np.bool_]:
    """(N, H, W) the pixels of which a neighbour misses, or lies 1 mm or more away from the others' plane."""
    finite = np.where(np.isfinite(image), image, 10.0)
    edge = np.zeros(image.shape, dtype=bool)
    for axis in (1, 2):
        step = np.abs(np.diff(finite, 2, axis=axis)) > 1e-3
        inside = [slice(None)] * 3
        for offset in range(3):
            inside[axis] = slice(offset, image.shape[axis] - 2 + offset)
            edge[tuple(inside)] |= step
    return edge


def agree(one: Array, other: Array, tolerance: float = 1e-5) -> float:
    """The share of pixels at which two images (N, H, W) differ; away from edges none may."""
    with np.errstate(invalid="ignore"):
        differ = ~((one == other) | (np.abs(one - other) <= tolerance))
    edges = beside_edges(other)
    assert not (differ & ~edges).any(), f"{(differ & ~edges).sum()} pixels differ away from edges"
    return float(differ.mean())
