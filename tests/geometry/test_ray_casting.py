"""Ray casting against closed forms and against every ray cast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.ray_casting import RayCaster
from tests.geometry.rendered_parts import (
    RING,
    Array,
    around_camera,
    camera,
    part_of,
    random_poses,
    world_rays,
)

SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def test_plane_is_as_deep_as_its_equation() -> None:
    """A flat part (its hull has no volume) that fills the image, seen at a slant."""
    view = camera()
    quaternion = Rotation.from_rotvec([0.2, -0.1, 0.4]).as_quat()
    pose = np.array([0.01, 0.02, -0.03, *quaternion[[3, 0, 1, 2]]])
    eye, rays = world_rays(view)
    normal = Rotation.from_quat(quaternion).apply([0, 0, 1])
    depth = ((pose[:3] - eye) @ normal) / (rays @ normal)
    plane = Part("plane", 1.5 * SQUARE, np.array([[0, 1, 2], [0, 2, 3]]))
    image = RayCaster(plane).images(view, pose[None])[0]
    np.testing.assert_allclose(image.reshape(-1), depth, rtol=3e-6)


def test_sphere_is_as_deep_as_its_quadratic() -> None:
    view, center = camera(), np.array([0.02, 0.01, 0.005])
    pose = np.concatenate([center, Rotation.from_rotvec([1.0, 2.0, 0.5]).as_quat()[[3, 0, 1, 2]]])
    eye, rays = world_rays(view)
    a, b, c = (rays**2).sum(1), rays @ (eye - center), ((eye - center) ** 2).sum() - 0.03**2
    root = b**2 - a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.abs(root))) / a, np.inf)
    sphere = part_of(trimesh.creation.icosphere(subdivisions=5, radius=0.03))
    image = RayCaster(sphere).images(view, pose[None])[0].reshape(-1)
    sure = np.abs(root) > 0.01 * root.max()  # the facets' silhouette is not the sphere's
    assert np.array_equal(np.isfinite(image)[sure], np.isfinite(depth)[sure])
    seen = np.isfinite(image) & np.isfinite(depth) & sure
    assert seen.sum() > 80
    # The facets lie up to 1e-5 m inside the sphere: more along a slanted ray.
    difference = np.abs(image[seen] - depth[seen])
    assert difference.max() < 1e-4 and difference.mean() < 2e-5


def every_ray(part: Part, view: Camera, pose: torch.Tensor) -> Array:
    """Every pixel cast for every particle, with no culling: (N, H * W), +inf where the ray misses."""
    images = []
    eye, rays = world_rays(view)
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, part.vertices[part.faces].astype(np.float32))
    for p in pose.numpy():
        turn = Rotation.from_quat(p[[4, 5, 6, 3]]).inv()
        origin = np.tile(turn.apply(eye - p[:3]), (len(rays), 1))
        depth = scene.run(origin.astype(np.float32), turn.apply(rays).astype(np.float32), query="DISTANCE")
        images.append(np.where(depth < 1e30, depth, np.inf))
    return np.stack(images)


def lost(image: Array, expected: Array) -> int:
    """How many pixels are hit in one only; where both are, they agree but for rays through edges."""
    seen = np.isfinite(image) & np.isfinite(expected)
    assert (np.abs(image[seen] - expected[seen]) > 1e-5).mean() < 1e-4
    return int((np.isfinite(image) != np.isfinite(expected)).sum())


@pytest.mark.parametrize("spread", [0.03, 0.3], ids=["in view", "outside, behind and around the camera"])
def test_culling_loses_no_hit(spread: float) -> None:
    """Some poses are cut by the image's border, some lie behind the camera, some hold it inside."""
    part, view = part_of(RING), camera()
    pose = torch.cat([random_poses(300, 5, spread), around_camera(60, 6, 0.02)])
    renderer = RayCaster(part)
    image, expected = renderer.images(view, pose).reshape(len(pose), -1), every_ray(part, view, pose)
    assert np.isfinite(expected).any(axis=1).sum() > 40
    assert lost(image, expected) <= 2e-5 * np.isfinite(expected).sum()  # rays that graze a silhouette
    assert renderer.effort.amount < 0.5 * image.size


@pytest.mark.parametrize("distortion", [(0.25, -0.3, 0.004, -0.006, 0.1), (-0.3, 0.12, 0.003, -0.005)])
def test_a_lens_loses_no_hit(distortion: tuple[float, ...]) -> None:
    """A slanted plane against its equation along the lens's rays, a ring against every ray cast."""
    view = replace(camera(width=96, height=64), fx=70.0, fy=76.0, cx=45.0, cy=33.0, distortion=distortion)
    part, pose = part_of(RING), torch.cat([random_poses(80, 5, 0.03), random_poses(40, 6, 0.3)])
    image, expected = RayCaster(part).images(view, pose).reshape(len(pose), -1), every_ray(part, view, pose)
    assert np.isfinite(expected).sum() > 10000
    assert lost(image, expected) <= 2
    plane = Part("plane", 2.0 * SQUARE, np.array([[0, 1, 2], [0, 2, 3]]))
    eye, rays = world_rays(view)
    depth = -eye[2] / rays[:, 2]
    seen = RayCaster(plane).images(view, poses.identity(1))[0].reshape(-1)
    inside = (depth > 0) & (np.abs(eye + depth[:, None] * rays)[:, :2] < 1.9).all(axis=1)
    assert inside.mean() > 0.9
    np.testing.assert_allclose(seen[inside], depth[inside], rtol=3e-6)


def test_many_batches_equal_one(monkeypatch: pytest.MonkeyPatch) -> None:
    view, pose, renderer = camera(), random_poses(40, 9, 0.02), RayCaster(part_of(RING))
    whole = renderer.hits(view, pose)
    monkeypatch.setattr("bcppl.rendering.ray_casting.BATCH", 50)
    cut = renderer.hits(view, pose)
    for name in ("particle", "pixel", "depth"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(whole, name))
