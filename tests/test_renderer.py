"""Rendered depth against closed forms, another ray caster, and itself without culling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.renderer import DepthRenderer

Array = npt.NDArray[np.float64]

RING = trimesh.creation.annulus(r_min=0.01, r_max=0.03, height=0.03, sections=64)
SPHERE = trimesh.creation.icosphere(subdivisions=5, radius=0.03)
# An L: one corner is missing, so that no flip or turn of the image leaves it as it is.
ELL = trimesh.util.concatenate(
    [
        trimesh.creation.box(bounds=[[0, 0, 0], [0.06, 0.02, 0.02]]),
        trimesh.creation.box(bounds=[[0, 0.02, 0], [0.02, 0.04, 0.02]]),
    ]
)


def part_of(mesh: trimesh.Trimesh) -> Part:
    return Part("part", np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))


def looking(eye: Array, target: Array, roll: float = 0.3) -> Array:
    """`world_from_camera` of a camera at `eye` that looks at `target`, rolled about its axis."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.3, 0.5, 1.0])
    right /= np.linalg.norm(right)
    turn = Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward], axis=1))
    quaternion = (turn * Rotation.from_rotvec([0, 0, roll])).as_quat()
    return np.concatenate([eye, quaternion[[3, 0, 1, 2]]])


def tilted_camera(width: int = 48, height: int = 32) -> Camera:
    """Different focal lengths, an off-centre principal point, neither square nor aligned with anything."""
    pose = looking(np.array([0.10, -0.15, 0.20]), np.array([0.01, 0.01, 0.0]))
    return Camera("tilted", width, height, 55.0, 62.0, 20.3, 17.9, pose)


def random_poses(count: int, seed: int, spread: float) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    quaternion = Rotation.random(count, random_state=seed).as_quat()[:, [3, 0, 1, 2]]
    return torch.from_numpy(np.concatenate([rng.normal(size=(count, 3)) * spread, quaternion], axis=1))


def world_rays(camera: Camera) -> tuple[Array, Array]:
    """The camera's centre (3,) and its pixels' directions (H * W, 3) in the world, by scipy."""
    pose = camera.world_from_camera
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    return pose[:3], Rotation.from_quat(pose[[4, 5, 6, 3]]).apply(rays.reshape(-1, 3))


def moved_vertices(part: Part, pose: Array) -> Array:
    return Rotation.from_quat(pose[[4, 5, 6, 3]]).apply(part.vertices) + pose[:3]


def test_plane_is_as_deep_as_the_plane_equation_says() -> None:
    """A flat part (its hull has no volume) that fills the image, seen at a slant."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 1.5
    part = Part("plane", square, np.array([[0, 1, 2], [0, 2, 3]]))
    camera = tilted_camera()
    pose = random_poses(1, 0, 0.0)[0].numpy()
    pose[3:] = Rotation.from_rotvec([0.2, -0.1, 0.4]).as_quat()[[3, 0, 1, 2]]
    pose[:3] = [0.01, 0.02, -0.03]
    eye, rays = world_rays(camera)
    normal = Rotation.from_quat(pose[[4, 5, 6, 3]]).apply([0, 0, 1])
    depth = ((pose[:3] - eye) @ normal) / (rays @ normal)
    image = DepthRenderer(part).images(camera, pose[None])[0]
    np.testing.assert_allclose(image.reshape(-1), depth, rtol=3e-6)


def test_sphere_is_as_deep_as_the_quadratic_says() -> None:
    camera = tilted_camera()
    center = np.array([0.02, 0.01, 0.005])
    pose = np.concatenate([center, Rotation.from_rotvec([1.0, 2.0, 0.5]).as_quat()[[3, 0, 1, 2]]])
    eye, rays = world_rays(camera)
    a, b, c = (rays**2).sum(1), rays @ (eye - center), ((eye - center) ** 2).sum() - 0.03**2
    root = b**2 - a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.abs(root))) / a, np.inf).reshape(camera.height, camera.width)
    image = DepthRenderer(part_of(SPHERE)).images(camera, pose[None])[0]
    sure = np.abs(root.reshape(depth.shape)) > 0.01 * root.max()  # the facets' silhouette is not the sphere's
    assert np.array_equal(np.isfinite(image)[sure], np.isfinite(depth)[sure])
    both = np.isfinite(image) & np.isfinite(depth) & sure
    assert both.sum() > 80
    difference = np.abs(image[both] - depth[both])
    # The facets lie up to 1e-5 m inside the sphere: more along a slanted ray.
    assert difference.max() < 1e-4
    assert difference.mean() < 2e-5


def other_caster(part: Part, camera: Camera, pose: Array) -> Array:
    """The same image by trimesh in the world's frame, its rays normalised: (H * W,), +inf where they miss."""
    eye, rays = world_rays(camera)
    mesh = trimesh.Trimesh(moved_vertices(part, pose), part.faces, process=False)
    points, ray, _ = mesh.ray.intersects_location(np.tile(eye, (len(rays), 1)), rays, multiple_hits=False)
    forward = Rotation.from_quat(camera.world_from_camera[[4, 5, 6, 3]]).apply([0, 0, 1])
    depth = np.full(len(rays), np.inf)
    depth[ray] = (points - eye) @ forward
    return depth


@pytest.mark.parametrize("mesh", [RING, ELL], ids=["ring", "ell"])
def test_hits_equal_another_caster_in_the_worlds_frame(mesh: trimesh.Trimesh) -> None:
    part, camera = part_of(mesh), tilted_camera()
    pose = random_poses(12, 3, 0.015)
    image = DepthRenderer(part).images(camera, pose).reshape(12, -1)
    expected = np.stack([other_caster(part, camera, p) for p in pose.numpy()])
    seen = np.isfinite(image) & np.isfinite(expected)
    assert seen.sum() > 500
    difference = np.abs(image[seen] - expected[seen])
    assert (difference > 1e-5).mean() < 0.002  # a ray through an edge may meet either side of it
    assert (np.isfinite(image) != np.isfinite(expected)).mean() < 0.0005


def full_frame(part: Part, camera: Camera, pose: torch.Tensor, along: Array | None = None) -> Array:
    """Every pixel cast for every particle, with no culling: (N, H * W), +inf where the ray misses."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    images = []
    eye, rays = world_rays(camera)
    rays = rays if along is None else along
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, part.vertices[part.faces].astype(np.float32))
    for p in pose.numpy():
        turn = Rotation.from_quat(p[[4, 5, 6, 3]]).inv()
        origin = np.tile(turn.apply(eye - p[:3]), (len(rays), 1))
        depth = scene.run(origin.astype(np.float32), turn.apply(rays).astype(np.float32), query="DISTANCE")
        images.append(np.where(depth < 1e30, depth, np.inf))
    return np.stack(images)


@pytest.mark.parametrize("spread", [0.03, 0.3], ids=["in view", "outside, behind and around the camera"])
def test_culling_loses_no_hit(spread: float) -> None:
    """Some poses are cut by the image's border, some lie behind the camera, some hold it inside."""
    part, camera = part_of(RING), tilted_camera()
    pose = random_poses(300, 5, spread)
    near = random_poses(60, 6, 0.02)
    near[:, :3] += torch.from_numpy(camera.world_from_camera[:3])
    pose = torch.cat([pose, near])
    renderer = DepthRenderer(part)
    image = renderer.images(camera, pose).reshape(len(pose), -1)
    expected = full_frame(part, camera, pose)
    wrong = np.isfinite(image) != np.isfinite(expected)
    assert wrong.sum() <= 2e-5 * np.isfinite(expected).sum()  # rays that graze a silhouette
    assert np.isfinite(expected).any(axis=1).sum() > 40
    both = np.isfinite(image) & np.isfinite(expected)
    assert (np.abs(image[both] - expected[both]) > 1e-5).mean() < 1e-4
    assert renderer.effort.amount < 0.5 * image.size


@pytest.mark.parametrize("distortion", [(0.25, -0.3, 0.004, -0.006, 0.1), (-0.3, 0.12, 0.003, -0.005)])
def test_a_lens_loses_no_hit(distortion: tuple[float, ...]) -> None:
    """A slanted plane against its equation along the lens's rays, a ring against every ray cast."""
    camera = replace(tilted_camera(96, 64), fx=70.0, fy=76.0, cx=45.0, cy=33.0, distortion=distortion)
    part, pose = part_of(RING), torch.cat([random_poses(80, 5, 0.03), random_poses(40, 6, 0.3)])
    turn = Rotation.from_quat(camera.world_from_camera[[4, 5, 6, 3]])
    rays, eye = turn.apply(camera.rays()), camera.world_from_camera[:3]
    image = DepthRenderer(part).images(camera, pose).reshape(len(pose), -1)
    expected = full_frame(part, camera, pose, rays)
    assert np.isfinite(expected).sum() > 10000
    assert (np.isfinite(image) != np.isfinite(expected)).sum() <= 2
    both = np.isfinite(image) & np.isfinite(expected)
    assert (np.abs(image[both] - expected[both]) > 1e-5).mean() < 1e-4
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 2.0
    plane = Part("plane", square, np.array([[0, 1, 2], [0, 2, 3]]))
    depth = -eye[2] / rays[:, 2]
    seen = DepthRenderer(plane).images(camera, poses.identity(1))[0].reshape(-1)
    inside = (depth > 0) & (np.abs(eye + depth[:, None] * rays)[:, :2] < 1.9).all(axis=1)
    assert inside.mean() > 0.9
    np.testing.assert_allclose(seen[inside], depth[inside], rtol=3e-6)


def test_counted_pixels_and_order_of_hits() -> None:
    camera, pose = tilted_camera(), random_poses(20, 8, 0.02)
    renderer = DepthRenderer(part_of(RING))
    everything = renderer.hits(camera, pose)
    key = everything.particle * camera.width * camera.height + everything.pixel
    assert (np.diff(key) > 0).all()
    counted = np.random.default_rng(0).random(camera.width * camera.height) < 0.4
    some = renderer.hits(camera, pose, counted=counted)
    kept = counted[everything.pixel]
    np.testing.assert_array_equal(some.pixel, everything.pixel[kept])
    np.testing.assert_array_equal(some.particle, everything.particle[kept])
    np.testing.assert_array_equal(some.depth, everything.depth[kept])


def test_many_batches_equal_one(monkeypatch: pytest.MonkeyPatch) -> None:
    camera, pose = tilted_camera(), random_poses(40, 9, 0.02)
    renderer = DepthRenderer(part_of(RING))
    whole = renderer.hits(camera, pose)
    monkeypatch.setattr("bcppl.rendering.renderer.BATCH", 50)
    cut = renderer.hits(camera, pose)
    for name in ("particle", "pixel", "depth"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(whole, name))


def test_effort_counts_images_and_rays() -> None:
    camera, renderer = tilted_camera(), DepthRenderer(part_of(RING))
    renderer.hits(camera, random_poses(7, 1, 0.01))
    before = renderer.effort.copy()
    found = renderer.hits(camera, random_poses(5, 1, 0.01))
    spent = renderer.effort.since(before)
    assert (spent.calls, spent.items) == (1, 5)
    assert len(found.depth) <= spent.amount < 5 * camera.width * camera.height
    assert spent.seconds > 0


def test_no_particles_and_no_hits() -> None:
    camera, renderer = tilted_camera(), DepthRenderer(part_of(RING))
    assert renderer.images(camera, torch.zeros(0, 7)).shape == (0, camera.height, camera.width)
    away = poses.identity(2)
    away[:, 2] = 5.0
    assert len(renderer.hits(camera, away).depth) == 0


def test_bad_poses_are_refused() -> None:
    pose = poses.identity(3)
    pose[1, 0] = float("nan")
    with pytest.raises(InputError, match="finite"):
        DepthRenderer(part_of(RING)).hits(tilted_camera(), pose)
