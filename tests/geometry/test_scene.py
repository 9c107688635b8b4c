"""Several parts in one image: the nearest occludes the others, whatever their order and number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch
import trimesh

from bcppl import poses
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.parts import Part
from bcppl.rendering import scene as module
from bcppl.rendering.rasterisation import renderer_for
from bcppl.rendering.ray_casting import RayCaster
from bcppl.rendering.scene import SceneRenderer, background_part, scene_poses
from tests.geometry.rendered_parts import part_of

CAMERA = Camera(
    "above", 40, 30, 45.0, 47.0, 19.2, 15.1, looking_at((0.2, -0.25, 0.3), (0, 0, 0)), near=0.05, far=2.0
)


BOX = part_of(trimesh.creation.box((0.08, 0.05, 0.04)), name="box")
BALL = part_of(trimesh.creation.icosphere(subdivisions=2, radius=0.03), name="ball")
TABLE = part_of(trimesh.creation.box((2.0, 2.0, 0.01)), name="table")
PARTS = [BOX, BALL, TABLE]
UNDER = torch.tensor([0.0, 0, -0.04, 1, 0, 0, 0], dtype=torch.float64)


def around(count: int, seed: int, spread: float = 0.03) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    step = torch.randn(count, 6, generator=generator, dtype=torch.float64) * torch.tensor(
        [spread] * 3 + [0.5] * 3
    )
    return poses.retract(poses.identity(count), step)


def one_by_one(parts: list[Part], pose: torch.Tensor) -> tuple[Array, npt.NDArray[np.int64]]:
    """Every part on its own, then the nearest: (N, H, W) depths and which part."""
    each = np.stack([RayCaster(p).images(CAMERA, pose[:, k]) for k, p in enumerate(parts)])
    return each.min(axis=0), each.argmin(axis=0)


@pytest.mark.parametrize("at_once", [1 << 22, 3000])
def test_the_nearest_part_is_seen(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In any order of the parts, with one at a pose that all particles share, in one batch or in many."""
    monkeypatch.setattr(module, "BATCH", at_once)
    pose = scene_poses(around(9, 0), around(9, 1), UNDER)
    depth, owner = one_by_one(PARTS, pose)
    for order in ([0, 1, 2], [2, 0, 1]):
        renderer = SceneRenderer([PARTS[k] for k in order])
        np.testing.assert_array_equal(renderer.images(CAMERA, pose[:, order]), depth)
        hits = renderer.hits(CAMERA, pose[:, order])
        assert (np.diff(hits.particle * depth[0].size + hits.pixel) > 0).all()
        seen = owner.reshape(9, -1)[hits.particle, hits.pixel]
        assert np.array_equal(np.array(order)[hits.part], seen)
        assert set(seen) == {0, 1, 2}
    # The ball goes behind the box and is gone.
    eye = torch.from_numpy(CAMERA.world_from_camera[:3])
    behind = poses.identity(1)
    behind[:, :3] = -0.05 * eye / eye.norm()
    tall = part_of(trimesh.creation.box((0.15, 0.15, 0.02)), name="plate")
    facing = torch.from_numpy(CAMERA.world_from_camera).clone()
    facing[:3] = 0.0
    hits = SceneRenderer([tall, BALL]).hits(CAMERA, scene_poses(facing, behind))
    assert set(hits.part) == {0}
    assert 1 in set(SceneRenderer([tall, BALL]).hits(CAMERA, scene_poses(facing, poses.inverse(behind))).part)


def test_counted_pixels_only() -> None:
    pose = scene_poses(around(6, 2), around(6, 3), UNDER)
    counted = np.random.default_rng(0).random((30, 40)) < 0.3
    renderer = SceneRenderer(PARTS)
    some, everything = renderer.hits(CAMERA, pose, counted), renderer.hits(CAMERA, pose)
    kept = counted.reshape(-1)[everything.pixel]
    for name in ("particle", "pixel", "depth", "part"):
        np.testing.assert_array_equal(getattr(some, name), getattr(everything, name)[kept])
    nothing = renderer.hits(CAMERA, pose, np.zeros((30, 40), dtype=bool))
    assert len(nothing.depth) == 0 and nothing.part.dtype == np.int64


def test_a_still_part_is_rendered_once() -> None:
    moving, still = SceneRenderer([BALL]), SceneRenderer([BALL, TABLE])
    pose = around(50, 4)
    moving.hits(CAMERA, pose[:, None])
    still.hits(CAMERA, scene_poses(pose, UNDER))
    assert still.effort.amount <= moving.effort.amount + CAMERA.width * CAMERA.height
    assert still.effort.items == 50


def test_a_background_is_the_image_of_a_scene() -> None:
    renderer = SceneRenderer([TABLE])
    image = renderer.background(CAMERA, UNDER[None])
    rendered = renderer.images(CAMERA, UNDER[None])[0]
    assert np.array_equal(np.isfinite(image), np.isfinite(rendered))
    np.testing.assert_array_equal(image[np.isfinite(image)], rendered[np.isfinite(rendered)])
    with pytest.raises(ValueError, match="too many values"):
        renderer.background(CAMERA, UNDER.expand(2, 1, 7))


def test_a_background_as_a_part_is_seen_from_elsewhere() -> None:
    """Exact for planes from any place; open where nothing is known, and across an edge."""
    wide = replace(CAMERA, width=160, height=120, fx=180.0, fy=188.0, cx=78.3, cy=61.9)
    image = SceneRenderer([TABLE]).background(wide, UNDER[None])
    image[:40, :50] = np.nan
    part = background_part(wide, image)
    stated = torch.from_numpy(wide.world_from_camera)
    renderer = RayCaster(part)
    for step in ([0.0] * 6, [0.01, -0.02, 0.005, 0.02, -0.01, 0.03]):
        there = poses.retract(stated, torch.tensor(step, dtype=torch.float64))
        seen = renderer.images(replace(wide, world_from_camera=there.numpy()), stated[None])[0]
        expected = SceneRenderer([TABLE]).images(replace(wide, world_from_camera=there.numpy()), UNDER[None])[
            0
        ]
        both = np.isfinite(seen) & np.isfinite(expected)
        assert both.mean() > 0.6
        np.testing.assert_allclose(seen[both], expected[both], atol=2e-6)
        if not any(step):
            assert not np.isfinite(seen[:36, :44]).any()
    boxed = SceneRenderer([TABLE, BOX]).background(wide, scene_poses(UNDER, poses.identity(1))[0])
    seen = RayCaster(background_part(wide, boxed)).images(wide, stated[None])[0]
    both = np.isfinite(seen)
    assert 0.5 < both.mean() < 1.0
    share = np.abs(seen[both] - boxed[both]) / boxed[both]
    assert share.max() < 0.03, "no triangle spans more than a jump"
    assert (share > 1e-5).mean() < 0.02


def test_bad_input_is_named() -> None:
    renderer = SceneRenderer(PARTS)
    assert renderer.images(CAMERA, poses.identity(0, 3)).shape == (0, 30, 40)
    for shape in ((4, 2, 7), (2, 7), (4, 7)):
        with pytest.raises(InputError, match="3 parts"):
            renderer.hits(CAMERA, poses.identity(*shape[:-1]))
    with pytest.raises(InputError, match="no surface"):
        background_part(CAMERA, np.full((30, 40), np.nan))
    with pytest.raises(InputError, match="shape"):
        background_part(CAMERA, np.ones((40, 30)))
    for wrong in (0, -2, 1.5):
        with pytest.raises(InputError, match=f"stride {wrong}; give a whole number"):
            background_part(CAMERA, np.ones((30, 40)), stride=wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="jump nan"):
        background_part(CAMERA, np.ones((30, 40)), jump=float("nan"))


def test_a_scene_of_either_renderer_sees_through_any_lens() -> None:
    pose = scene_poses(around(5, 1, 0.01), UNDER)
    drawn, cast = SceneRenderer([BOX, TABLE], renderer=renderer_for), SceneRenderer([BOX, TABLE])
    lens = replace(CAMERA, distortion=(-0.15, 0.05, 0.002, -0.001, 0.0))
    through = drawn.images(lens, pose)
    assert np.array_equal(through, cast.images(lens, pose))
    straight, other = drawn.images(CAMERA, pose), cast.images(CAMERA, pose)
    both = np.isfinite(straight) & np.isfinite(other)
    assert both.mean() > 0.9 and np.median(np.abs(straight - other)[both]) < 1e-6
    assert not np.array_equal(straight, other), "rays are cast in single precision, triangles drawn in double"
    assert drawn.effort.amount > cast.effort.amount // 2 > 0
