"""Drawn depth against closed forms, rays, and itself in other portions."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.parts import Part
from bcppl.rendering.choice import MOST_FACES, renderer_for
from bcppl.rendering.rasteriser import DepthRasteriser
from bcppl.rendering.renderer import DepthRenderer, Hits

Array = npt.NDArray[np.float64]

RING = trimesh.creation.annulus(r_min=0.01, r_max=0.03, height=0.03, sections=64)
SPHERE = trimesh.creation.icosphere(subdivisions=5, radius=0.03)  # 20,480 faces, most smaller than a pixel
# A pipe without lids: its inside is seen from behind the outer wall's faces.
PIPE = trimesh.Trimesh(RING.vertices, RING.faces[np.abs(RING.face_normals[:, 2]) < 0.5], process=False)
# Closed, but one of its two boxes is turned inside out: what is seen of that one are faces from behind.
TURNED = trimesh.util.concatenate(
    [
        trimesh.creation.box(bounds=[[0, 0, 0], [0.06, 0.02, 0.02]]),
        trimesh.Trimesh(
            (box := trimesh.creation.box(bounds=[[0, 0.03, 0], [0.02, 0.04, 0.02]])).vertices,
            box.faces[:, ::-1],
            process=False,
        ),
    ]
)
MESHES = {"ring": RING, "sphere": SPHERE, "pipe": PIPE, "turned": TURNED}


def part_of(mesh: trimesh.Trimesh, scale: float = 1.0) -> Part:
    return Part("part", scale * np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


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


def by_trimesh(part: Part, camera: Camera, pose: Array) -> Array:
    """(H * W,) by trimesh's rays in the world, +inf where they miss."""
    eye, turn = camera.world_from_camera[:3], Rotation.from_quat(camera.world_from_camera[[4, 5, 6, 3]])
    vertices = Rotation.from_quat(pose[[4, 5, 6, 3]]).apply(part.vertices) + pose[:3]
    mesh = trimesh.Trimesh(vertices, part.faces, process=False)
    rays = turn.apply(camera.rays())
    points, ray, _ = mesh.ray.intersects_location(np.tile(eye, (len(rays), 1)), rays, multiple_hits=False)
    depth = np.full(len(rays), np.inf)
    depth[ray] = (points - eye) @ turn.apply([0, 0, 1])
    return depth


def beside_edges(image: Array, reach: int = 1) -> npt.NDArray[np.bool_]:
    """(N, H, W) the pixels of which a neighbour misses, or lies 1 mm or more away from the others' plane."""
    finite = np.where(np.isfinite(image), image, 10.0)
    edge = np.zeros(image.shape, dtype=bool)
    for axis in (1, 2):
        step = np.abs(np.diff(finite, 2, axis=axis)) > 1e-3
        inside = [slice(None)] * 3
        for offset in range(2 + reach):
            inside[axis] = slice(offset, image.shape[axis] - 2 + offset) if offset < 3 else slice(0, 0)
            edge[tuple(inside)] |= step
    return edge


def agree(one: Array, other: Array, tolerance: float = 1e-5) -> float:
    """The share of pixels at which two images (N, H, W) differ; away from edges none may."""
    with np.errstate(invalid="ignore"):
        differ = ~((one == other) | (np.abs(one - other) <= tolerance))
    edges = beside_edges(other)
    assert not (differ & ~edges).any(), f"{(differ & ~edges).sum()} pixels differ away from edges"
    return float(differ.mean())


@pytest.mark.parametrize("name", MESHES)
def test_depth_is_that_of_rays(name: str) -> None:
    part, view = part_of(MESHES[name]), camera()
    pose = random_poses(60, 3, 0.02)
    image = DepthRasteriser(part).images(view, pose)
    assert np.isfinite(image).sum() > 3000
    assert agree(image, DepthRenderer(part).images(view, pose)) < 2e-4
    shape = (-1, view.height, view.width)
    other = np.stack([by_trimesh(part, view, p) for p in pose[:8].numpy()]).reshape(shape)
    assert agree(image[:8], other) < 2e-4


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("spread", [0.015, 0.06], ids=["around the camera", "beside and behind"])
def test_parts_that_cross_the_cameras_plane(name: str, spread: float) -> None:
    part, view = part_of(MESHES[name]), camera()
    pose = around_camera(80, 4, spread)
    image, cast = DepthRasteriser(part).images(view, pose), DepthRenderer(part).images(view, pose)
    within = np.isfinite(cast).all(axis=(1, 2)).sum(), np.isinf(cast).all(axis=(1, 2)).sum()
    assert min(within) > 2 if name in ("ring", "sphere") and spread < 0.05 else max(within) > 2
    with np.errstate(invalid="ignore"):
        differ = ~((image == cast) | (np.abs(image - cast) <= 1e-5))
    assert differ.mean() < 5e-4


def test_plane_is_exact_and_whole() -> None:
    """A plane through the camera's own: cut, slanted, in 2000 triangles; no pixel is lost between them."""
    rng = np.random.default_rng(0)
    grid = np.linspace(-1.5, 1.5, 32)
    x, y = np.meshgrid(grid, grid)
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    flat[:, :2] += 0.02 * rng.normal(size=(len(flat), 2))
    corner = (np.arange(31)[:, None] * 32 + np.arange(31)).reshape(-1, 1)
    faces = np.concatenate([corner + np.array([0, 1, 33]), corner + np.array([0, 33, 32])])
    view = replace(camera(), width=320, height=240, cx=160.0, cy=120.0, fx=300.0, fy=310.0)
    pose = poses.identity(1)
    image = DepthRasteriser(Part("plane", flat, faces)).images(view, pose)[0]
    turn = Rotation.from_quat(view.world_from_camera[[4, 5, 6, 3]])
    depth = -view.world_from_camera[2] / turn.apply(view.rays())[:, 2]
    np.testing.assert_allclose(image.reshape(-1), depth, rtol=1e-11)


def test_edges_through_pixel_centres_leave_no_gap() -> None:
    """A fan whose middle and spokes lie exactly on pixels, at a depth that makes every product exact."""
    rim = np.array([[8, -8], [8, 0], [8, 8], [0, 8], [-8, 8], [-8, 0], [-8, -8], [0, -8]]) / 16.0
    vertices = np.concatenate([[[0, 0, 1.0]], np.column_stack([rim, np.ones(8)])])
    faces = np.array([[0, k + 1, (k + 1) % 8 + 1] for k in range(8)])
    view = Camera("exact", 32, 32, 16.0, 16.0, 16.0, 16.0, np.array([0, 0, 0, 1.0, 0, 0, 0]))
    image = DepthRasteriser(Part("fan", vertices, faces)).images(view, poses.identity(1))[0]
    assert np.array_equal(np.argwhere(np.isfinite(image)), np.argwhere(np.ones((16, 16))) + 8)
    assert (image[np.isfinite(image)] == 1.0).all()


@pytest.mark.parametrize("scale", [1e-4, 1.0, 80.0])
def test_size_of_the_part_changes_nothing(scale: float) -> None:
    """A ring of 3 um, and one of 4.8 m: the same picture, depths in proportion."""
    pose = random_poses(6, 5, 0.02)
    reference = DepthRasteriser(part_of(RING)).images(camera(), pose)
    larger = pose.clone()
    larger[:, :3] *= scale
    image = DepthRasteriser(part_of(RING, scale)).images(camera(scale), larger)
    assert agree(image / scale, reference, 1e-9) < 1e-5


def equal(one: Hits, other: Hits) -> bool:
    names = ("particle", "pixel", "depth", "face")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


@pytest.mark.parametrize("name", ["ring", "pipe"])
def test_hits_are_the_images_pixels(name: str) -> None:
    part, view = part_of(MESHES[name]), camera()
    pose = torch.cat([random_poses(20, 6, 0.03), around_camera(10, 7, 0.02)])
    rasteriser = DepthRasteriser(part)
    image, found = rasteriser.images(view, pose).reshape(30, -1), rasteriser.hits(view, pose)
    particle, pixel = np.nonzero(np.isfinite(image))
    assert len(particle) > 3000 and found.face is None
    assert np.array_equal(found.particle, particle) and np.array_equal(found.pixel, pixel)
    assert np.array_equal(found.depth, image[particle, pixel])


@pytest.mark.parametrize("kind", ["scattered", "grid", "rows", "none", "all"])
def test_counted_pixels_are_those_of_the_whole(kind: str) -> None:
    view, pose, rasteriser = camera(), random_poses(20, 8, 0.02), DepthRasteriser(part_of(RING))
    counted = np.zeros((view.height, view.width), dtype=bool)
    if kind == "scattered":
        counted[:] = np.random.default_rng(0).random(counted.shape) < 0.4
    else:
        counted[
            {"grid": np.s_[1::4, 2::3], "rows": np.s_[5:20], "none": np.s_[:0], "all": np.s_[:]}[kind]
        ] = True
    whole = rasteriser.hits(view, pose, faces=True)
    kept = counted.reshape(-1)[whole.pixel]
    assert whole.face is not None
    expected = Hits(whole.particle[kept], whole.pixel[kept], whole.depth[kept], whole.face[kept])
    for mask in (counted, counted.reshape(-1)):
        assert equal(rasteriser.hits(view, pose, counted=mask, faces=True), expected)


@pytest.mark.parametrize("name", ["ring", "turned"])
def test_faces_hold_what_was_hit(name: str) -> None:
    part, view, pose = part_of(MESHES[name]), camera(), random_poses(20, 9, 0.02)
    found = DepthRasteriser(part).hits(view, pose, faces=True)
    assert found.face is not None and len(np.unique(found.face)) > 10
    turn = Rotation.from_quat(view.world_from_camera[[4, 5, 6, 3]])
    seen = turn.apply(view.rays()[found.pixel] * found.depth[:, None]) + view.world_from_camera[:3]
    whose = pose.numpy()[found.particle]
    inside = Rotation.from_quat(whose[:, [4, 5, 6, 3]]).apply(seen - whose[:, :3], inverse=True)
    corners = part.vertices[part.faces[found.face]]
    closest = trimesh.triangles.closest_point(corners, inside)
    assert np.abs(closest - inside).max() < 1e-6


def test_portions_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Order, one at a time, threads, small buffers, little room for hits: the same to the bit."""
    part, view = part_of(RING), camera()
    pose = torch.cat([random_poses(40, 10, 0.03), around_camera(20, 11, 0.03)])
    whole = DepthRasteriser(part, threads=1).hits(view, pose, faces=True)
    image = DepthRasteriser(part, threads=1).images(view, pose)
    order = torch.randperm(60)
    shuffled = DepthRasteriser(part, threads=3).images(view, pose[order])
    assert np.array_equal(shuffled, image[order.numpy()])
    assert np.array_equal(DepthRasteriser(part).images(view, pose[17:18])[0], image[17])
    assert equal(DepthRasteriser(part, threads=4).hits(view, pose, faces=True), whole)
    monkeypatch.setattr("bcppl.rendering.rasteriser.BUFFER", 700)
    monkeypatch.setattr("bcppl.rendering.rasteriser.FEW", 10)
    assert equal(DepthRasteriser(part, threads=2).hits(view, pose, faces=True), whole)


def test_faces_seen_from_behind_are_left_out_only_of_solids() -> None:
    solid = {name: DepthRasteriser(part_of(mesh))._solid for name, mesh in MESHES.items()}
    assert solid == {"ring": True, "sphere": True, "pipe": False, "turned": False}


def test_no_particles_and_no_hits() -> None:
    view, rasteriser = camera(), DepthRasteriser(part_of(RING))
    assert rasteriser.images(view, torch.zeros(0, 7)).shape == (0, view.height, view.width)
    away = poses.identity(2)
    away[:, 2] = 5.0
    for none in (away, torch.zeros(0, 7)):
        found = rasteriser.hits(view, none, faces=True)
        assert len(found.depth) == 0 and found.face is not None and len(found.face) == 0
    assert np.isinf(rasteriser.images(view, away)).all()


def test_effort_counts_images_and_pixels() -> None:
    view, rasteriser = camera(), DepthRasteriser(part_of(RING))
    before = rasteriser.effort.copy()
    found = rasteriser.hits(view, random_poses(5, 1, 0.01))
    spent = rasteriser.effort.since(before)
    assert (spent.calls, spent.items) == (1, 5) and spent.seconds > 0
    assert len(found.depth) <= spent.amount < 3 * len(found.depth)


def test_what_it_cannot_draw_is_refused_in_a_sentence() -> None:
    rasteriser, pose = DepthRasteriser(part_of(RING)), poses.identity(3)
    with pytest.raises(InputError, match="at most 32767"):
        rasteriser.images(replace(camera(), width=40000), pose)
    pose[1, 0] = float("nan")
    with pytest.raises(InputError, match="finite"):
        rasteriser.hits(camera(), pose)
    with pytest.raises(InputError, match="empty mesh"):
        DepthRasteriser(Part("none", np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)))


def test_each_is_chosen_for_what_suits_it() -> None:
    lens = replace(camera(), distortion=(0.1, -0.2, 0.0, 0.0, 0.0))
    fine = SPHERE.subdivide()
    assert len(fine.faces) > MOST_FACES
    assert isinstance(renderer_for(part_of(RING)), DepthRasteriser)
    assert isinstance(renderer_for(part_of(RING), [camera()]), DepthRasteriser)
    assert isinstance(renderer_for(part_of(RING), [camera(), lens]), DepthRenderer)
    assert isinstance(renderer_for(part_of(fine)), DepthRenderer)
    later = renderer_for(part_of(RING))
    pose = random_poses(3, 5, 0.02)
    assert np.array_equal(later.images(camera(), pose), DepthRasteriser(part_of(RING)).images(camera(), pose))
    assert np.array_equal(later.images(lens, pose), DepthRenderer(part_of(RING)).images(lens, pose))
    with pytest.raises(InputError, match="distorts"):
        DepthRasteriser(part_of(RING)).images(lens, poses.identity(1))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_goes_on_rendering() -> None:
    view, rasteriser, pose = camera(), DepthRasteriser(part_of(RING), threads=2), random_poses(40, 12, 0.02)
    image = rasteriser.images(view, pose)
    child = os.fork()
    if child == 0:
        os._exit(0 if np.array_equal(rasteriser.images(view, pose), image) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
