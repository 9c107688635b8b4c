"""Renderers of one part, by rays and by triangles: hits, masks, faces, effort, and refusals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.rasterisation import MOST_FACES, Rasteriser, renderer_for
from bcppl.rendering.ray_casting import RayCaster
from bcppl.rendering.scene import SceneRenderer
from tests.geometry.rendered_parts import (
    ELL,
    MESHES,
    RING,
    Array,
    agree,
    around_camera,
    by_trimesh,
    camera,
    part_of,
    random_poses,
)

KINDS: list[Callable[[Part], PartRenderer]] = [RayCaster, Rasteriser]
if find_spec("warp"):  # an optional group
    from bcppl.rendering.warp_casting import WarpCaster

    KINDS.append(WarpCaster)
every = pytest.mark.parametrize("kind", KINDS)


@every
@pytest.mark.parametrize("mesh", [*MESHES.values(), ELL], ids=[*MESHES, "ell"])
def test_depth_is_that_of_another_ray_caster(
    kind: Callable[[Part], PartRenderer], mesh: trimesh.Trimesh
) -> None:
    part, view, pose = part_of(mesh), camera(), random_poses(4, 3, 0.015)
    image = kind(part).images(view, pose)
    assert np.isfinite(image).sum() > 300
    assert agree(image, np.stack([by_trimesh(part, view, p) for p in pose.numpy()])) < 6e-4


@every
def test_hits_are_the_images_pixels_in_order(kind: Callable[[Part], PartRenderer]) -> None:
    for name in ("ring", "pipe"):
        renderer, view = kind(part_of(MESHES[name])), camera()
        pose = torch.cat([random_poses(20, 6, 0.03), around_camera(10, 7, 0.02)])
        image, hits = renderer.images(view, pose).reshape(30, -1), renderer.hits(view, pose)
        particle, pixel = np.nonzero(np.isfinite(image))
        assert len(particle) > 3000 and hits.face is None
        assert np.array_equal(hits.particle, particle) and np.array_equal(hits.pixel, pixel)
        assert np.array_equal(hits.depth, image[particle, pixel])


MASKS = {"grid": np.s_[1::4, 2::3], "rows": np.s_[5:20], "none": np.s_[:0], "all": np.s_[:]}


@every
def test_counted_pixels_are_those_of_the_whole(kind: Callable[[Part], PartRenderer]) -> None:
    view, pose, renderer = camera(), random_poses(20, 8, 0.02), kind(part_of(RING))
    whole = renderer.hits(view, pose, faces=True)
    assert whole.face is not None
    for name in ("scattered", *MASKS):
        counted = np.zeros((view.height, view.width), dtype=bool)
        if name == "scattered":
            counted[:] = np.random.default_rng(0).random(counted.shape) < 0.4
        else:
            counted[MASKS[name]] = True
        kept = counted.reshape(-1)[whole.pixel]
        for mask in (counted, counted.reshape(-1)):
            hits = renderer.hits(view, pose, counted=mask, faces=True)
            for column in ("particle", "pixel", "depth", "face"):
                np.testing.assert_array_equal(getattr(hits, column), getattr(whole, column)[kept])


@every
@pytest.mark.parametrize("name", ["ring", "turned"])
def test_faces_contain_the_hits(kind: Callable[[Part], PartRenderer], name: str) -> None:
    part, view, pose = part_of(MESHES[name]), camera(), random_poses(20, 9, 0.02)
    hits = kind(part).hits(view, pose, faces=True)
    assert hits.face is not None and len(np.unique(hits.face)) > 10
    turn = Rotation.from_quat(view.world_from_camera[[4, 5, 6, 3]])
    points = turn.apply(view.rays()[hits.pixel] * hits.depth[:, None]) + view.world_from_camera[:3]
    own = pose.numpy()[hits.particle]
    inside = Rotation.from_quat(own[:, [4, 5, 6, 3]]).apply(points - own[:, :3], inverse=True)
    closest = trimesh.triangles.closest_point(part.vertices[part.faces[hits.face]], inside)
    assert np.abs(closest - inside).max() < 1e-6


@every
def test_effort_counts_images_and_rays(kind: Callable[[Part], PartRenderer]) -> None:
    view, renderer = camera(), kind(part_of(RING))
    renderer.hits(view, random_poses(7, 1, 0.01))
    before = renderer.effort.copy()
    hits = renderer.hits(view, random_poses(5, 1, 0.01))
    spent = renderer.effort.since(before)
    assert (spent.calls, spent.items) == (1, 5) and spent.seconds > 0
    assert len(hits.depth) <= spent.amount < 3 * len(hits.depth)


@every
def test_no_particles_and_no_hits(kind: Callable[[Part], PartRenderer]) -> None:
    view, renderer = camera(), kind(part_of(RING))
    assert renderer.images(view, torch.zeros(0, 7)).shape == (0, view.height, view.width)
    away = poses.identity(2)
    away[:, 2] = 5.0
    for none in (away, torch.zeros(0, 7)):
        hits = renderer.hits(view, none, faces=True)
        assert len(hits.depth) == 0 and hits.face is not None and len(hits.face) == 0
    assert np.isinf(renderer.images(view, away)).all()


@pytest.mark.parametrize("make", [RayCaster, Rasteriser, lambda part: SceneRenderer([part])])
def test_poses_parts_masks_and_cameras_that_make_no_sense_are_refused(make: Callable[[Part], Any]) -> None:
    renderer, view, pose = make(part_of(RING)), camera(), random_poses(4, 0, 0.02)
    several = isinstance(renderer, SceneRenderer)
    pose = pose[:, None] if several else pose
    image, standing = renderer.images(view, pose), view.world_from_camera

    def turned(length: float) -> Array:
        return np.concatenate([standing[:3], length * standing[3:]])

    rounded = renderer.images(replace(view, world_from_camera=turned(1.0 + 1e-5)), pose)
    np.testing.assert_allclose(rounded, image, rtol=1e-6)
    for wrong, message in [
        ({"world_from_camera": turned(2.0)}, "world_from_camera of 'tilted' .* length 2"),
        ({"world_from_camera": turned(0.5)}, "length 0.5"),
        ({"world_from_camera": np.full(7, np.nan)}, "not finite"),
        ({"world_from_camera": np.stack([standing, standing])}, "one pose"),
        ({"fx": -45.0}, "fx -45.0"),
        ({"fy": np.nan}, "fy nan"),
        ({"cx": np.inf}, "cx inf"),
        ({"width": 0}, "0 pixels wide"),
    ]:
        for call in (renderer.images, renderer.hits):
            with pytest.raises(InputError, match=message):
                call(replace(view, **wrong), pose)
    for counted in (np.ones((10, 57), dtype=bool), np.arange(7), np.ones((57, 41), dtype=bool)):
        with pytest.raises(InputError, match="give a mask of all its pixels"):
            renderer.hits(view, pose, counted=counted)
    bad = pose.clone()
    bad[1, ..., 0] = torch.nan
    with pytest.raises(InputError, match="finite"):
        renderer.hits(view, bad)
    with pytest.raises(InputError, match="empty mesh"):
        make(Part("none", np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)))


def test_the_choice_depends_on_the_number_of_faces() -> None:
    assert isinstance(renderer_for(part_of(RING)), Rasteriser)
    flat = trimesh.creation.box((0.1, 0.1, 0.0))
    many = Part("fine", flat.vertices, np.tile(flat.faces, (MOST_FACES // len(flat.faces) + 1, 1)))
    assert isinstance(renderer_for(many), RayCaster)
