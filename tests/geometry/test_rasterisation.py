"""Rasterised depth against closed forms, ray casting, and itself in other portions."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.part_renderer import Hits
from bcppl.rendering.rasterisation import Rasteriser
from bcppl.rendering.ray_casting import RayCaster
from tests.geometry.rendered_parts import MESHES, RING, agree, around_camera, camera, part_of, random_poses


@pytest.mark.parametrize("name", MESHES)
def test_depth_is_that_of_rays(name: str) -> None:
    part, view, pose = part_of(MESHES[name]), camera(), random_poses(60, 3, 0.02)
    image = Rasteriser(part).images(view, pose)
    assert np.isfinite(image).sum() > 3000
    assert agree(image, RayCaster(part).images(view, pose)) < 2e-4


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("spread", [0.015, 0.06], ids=["around the camera", "beside and behind"])
def test_parts_that_cross_the_cameras_plane(name: str, spread: float) -> None:
    part, view = part_of(MESHES[name]), camera()
    pose = around_camera(80, 4, spread)
    image, cast = Rasteriser(part).images(view, pose), RayCaster(part).images(view, pose)
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
    image = Rasteriser(Part("plane", flat, faces)).images(view, poses.identity(1))[0]
    turn = Rotation.from_quat(view.world_from_camera[[4, 5, 6, 3]])
    depth = -view.world_from_camera[2] / turn.apply(view.rays())[:, 2]
    np.testing.assert_allclose(image.reshape(-1), depth, rtol=1e-11)


def test_edges_through_pixel_centres_leave_no_gap() -> None:
    """A fan whose middle and spokes lie exactly on pixels, at a depth that makes every product exact."""
    rim = np.array([[8, -8], [8, 0], [8, 8], [0, 8], [-8, 8], [-8, 0], [-8, -8], [0, -8]]) / 16.0
    vertices = np.concatenate([[[0, 0, 1.0]], np.column_stack([rim, np.ones(8)])])
    faces = np.array([[0, k + 1, (k + 1) % 8 + 1] for k in range(8)])
    view = Camera("exact", 32, 32, 16.0, 16.0, 16.0, 16.0, np.array([0, 0, 0, 1.0, 0, 0, 0]))
    image = Rasteriser(Part("fan", vertices, faces)).images(view, poses.identity(1))[0]
    assert np.array_equal(np.argwhere(np.isfinite(image)), np.argwhere(np.ones((16, 16))) + 8)
    assert (image[np.isfinite(image)] == 1.0).all()


@pytest.mark.parametrize("scale", [1e-4, 80.0])
def test_size_of_the_part_changes_nothing(scale: float) -> None:
    """A ring of 3 um, and one of 4.8 m: the same picture, depths in proportion."""
    pose = random_poses(6, 5, 0.02)
    reference = Rasteriser(part_of(RING)).images(camera(), pose)
    pose[:, :3] *= scale
    image = Rasteriser(part_of(RING, scale)).images(camera(scale), pose)
    assert agree(image / scale, reference, 1e-9) < 1e-5


def test_wide_images_and_lenses_are_those_of_rays() -> None:
    part, pose, view = part_of(RING), random_poses(3, 5, 0.02), camera()
    wide = replace(view, width=40000, height=6, fx=30000.0, cx=9000.0, cy=3.0)
    assert agree(Rasteriser(part).images(wide, pose), RayCaster(part).images(wide, pose)) < 1e-4
    lens = replace(view, distortion=(0.1, -0.2, 0.0, 0.0, 0.0))
    rasteriser = Rasteriser(part)
    assert np.array_equal(rasteriser.images(lens, pose), RayCaster(part).images(lens, pose))
    assert rasteriser.effort.items == 3 and rasteriser.effort.calls == 1


def test_portions_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Order, one at a time, threads, small buffers, little room for hits: the same to the bit."""

    def same(one: Hits, other: Hits) -> bool:
        names = ("particle", "pixel", "depth", "face")
        return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)

    part, view = part_of(RING), camera()
    pose = torch.cat([random_poses(40, 10, 0.03), around_camera(20, 11, 0.03)])
    whole = Rasteriser(part, threads=1).hits(view, pose, faces=True)
    image = Rasteriser(part, threads=1).images(view, pose)
    order = torch.randperm(60)
    shuffled = Rasteriser(part, threads=3).images(view, pose[order])
    assert np.array_equal(shuffled, image[order.numpy()])
    assert np.array_equal(Rasteriser(part).images(view, pose[17:18])[0], image[17])
    assert same(Rasteriser(part, threads=4).hits(view, pose, faces=True), whole)
    monkeypatch.setattr("bcppl.rendering.rasterisation.BUFFER", 700)
    monkeypatch.setattr("bcppl.rendering.rasterisation.FEW", 10)
    assert same(Rasteriser(part, threads=2).hits(view, pose, faces=True), whole)


def test_back_faces_are_culled_only_of_solids() -> None:
    solid = {name: Rasteriser(part_of(mesh))._solid for name, mesh in MESHES.items()}
    assert solid == {"ring": True, "sphere": True, "pipe": False, "turned": False}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_goes_on_rendering() -> None:
    view, rasteriser, pose = camera(), Rasteriser(part_of(RING), threads=2), random_poses(40, 12, 0.02)
    image = rasteriser.images(view, pose)
    child = os.fork()
    if child == 0:
        os._exit(0 if np.array_equal(rasteriser.images(view, pose), image) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
