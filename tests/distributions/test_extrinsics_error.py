"""Extrinsic errors against finite differences, and regions of interest against rendered parts."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.extrusion import block_with_square_hole
from bcppl.rendering.extrinsics_error import apparent_motion, line_of_sight
from bcppl.rendering.ray_casting import RayCaster
from bcppl.rendering.region_of_interest import region_of_interest
from tests.made_recordings import assert_one_sentence

PART = poses.as_pose([0.03, -0.02, 0.04, 0.5, 0.5, -0.5, 0.5])
SHIFT, TURN = 0.002, 0.009


def camera(eye: tuple[float, float, float], name: str = "camera") -> Camera:
    return Camera(
        name, 160, 120, 160.0, 160.0, 79.5, 59.5, looking_at(eye, (0.0, 0.0, 0.0)), near=0.1, far=2.0
    )


CAMERA = camera((0.3, -0.2, 0.35))


def seen(by: Camera, error: torch.Tensor, part: torch.Tensor = PART) -> torch.Tensor:
    """Where a camera whose true pose is `stated error` places the part, by its stated pose."""
    stated = torch.from_numpy(by.world_from_camera)
    really = poses.compose(stated, poses.retract(poses.identity(), error))
    return poses.compose(stated, poses.compose(poses.inverse(really), part))


def test_covariance_is_that_of_small_errors_of_the_stated_pose() -> None:
    step = 1e-6
    columns = [
        poses.local(seen(CAMERA, -step * axis), seen(CAMERA, step * axis)) / (2.0 * step)
        for axis in torch.eye(6, dtype=torch.float64)
    ]
    scaled = torch.stack(columns, dim=-1) * torch.tensor([SHIFT] * 3 + [TURN] * 3, dtype=torch.float64)
    motion = apparent_motion(CAMERA, PART.expand(2, 7), SHIFT, TURN)
    torch.testing.assert_close(motion @ motion.mT, (scaled @ scaled.T).expand(2, 6, 6), rtol=1e-6, atol=1e-12)


def test_a_part_farther_along_the_line_of_sight_stays_in_its_pixel_and_is_deeper() -> None:
    camera_from_world = poses.inverse(torch.from_numpy(CAMERA.world_from_camera))
    farther = PART[:3] + 0.1 * line_of_sight(CAMERA, PART)
    near, far = poses.transform(camera_from_world, torch.stack([PART[:3], farther])).numpy()
    np.testing.assert_allclose(CAMERA.project(far), CAMERA.project(near), atol=1e-9)
    assert abs(far[2] - near[2] - 0.1) < 1e-12


@pytest.mark.parametrize("by", [CAMERA, camera((-0.1, 0.4, 0.3), "elsewhere")], ids=lambda by: by.name)
def test_an_error_along_and_about_the_camera_s_axes_moves_what_it_sees(by: Camera) -> None:
    error = 1e-5 * torch.tensor([0.4, -0.3, 0.2, 2.0, -1.0, 3.0], dtype=torch.float64)
    computed = apparent_motion(by, PART, 0.5, 2.0) @ (error / torch.tensor([0.5] * 3 + [2.0] * 3))
    assert float((computed - poses.local(PART, seen(by, error))).abs().max()) < 1e-8


def test_a_part_that_may_be_anywhere_within_reach_stays_in_its_region() -> None:
    part, generator = block_with_square_hole(hole=0.016, offset=(0.007, 0.005)), np.random.default_rng(0)
    middle = 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))
    expected = poses.as_pose([0.01, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0])
    left, top, width, height = region_of_interest(CAMERA, part, expected, within=0.02)
    assert width < CAMERA.width and height < CAMERA.height
    camera_from_world = poses.inverse(torch.from_numpy(CAMERA.world_from_camera))
    for turn in Rotation.random(150, random_state=generator):
        shift = generator.normal(size=3)
        shift *= 0.02 / np.linalg.norm(shift)
        points = turn.apply(part.vertices - middle) + middle + expected[:3].numpy() + shift
        u, v = CAMERA.project(poses.transform(camera_from_world, torch.from_numpy(points)).numpy()).T
        inside = (left <= u) & (u <= left + width) & (top <= v) & (v <= top + height)
        outside = (u < 0) | (u > CAMERA.width - 1) | (v < 0) | (v > CAMERA.height - 1)
        assert (inside | outside).all()


def test_a_part_at_the_image_s_edge_fills_as_many_pixels_as_asked_for_and_none_beside_it() -> None:
    part, hidden, edge = block_with_square_hole(hole=0.016), 0, 0
    renderer = RayCaster(part)
    beside = poses.as_pose([0.0, 0, 0, 1, 0, 0, 0])
    for away in np.linspace(0.1, 0.4, 61):
        beside[:2] = torch.tensor([0.2, 0.3], dtype=torch.float64) * float(away) / 0.36
        try:
            left, top, width, height = region_of_interest(CAMERA, part, beside, within=0.02, least=9)
        except InputError as error:
            assert "beside its image" in str(error)
            assert not np.isfinite(renderer.images(CAMERA, beside[None])).any()
            hidden += 1
            continue
        assert not hidden and min(width, height) >= 9
        CAMERA.cropped(left, top, width, height).binned(9)
        rows, columns = np.nonzero(np.isfinite(renderer.images(CAMERA, beside[None])[0]))
        assert ((left <= columns) & (columns < left + width)).all()
        assert ((top <= rows) & (rows < top + height)).all()
        edge += width == 9
    assert hidden > 5 and edge > 0


def test_a_part_that_stays_behind_the_camera_is_refused_with_the_convention() -> None:
    part = block_with_square_hole(hole=0.016)
    expected = torch.tensor([0.01, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    half_a_turn = poses.as_pose([0, 0, 0, 0, 1, 0, 0])
    averted = poses.compose(poses.as_pose(CAMERA.world_from_camera), half_a_turn).numpy()
    camera = dataclasses.replace(CAMERA, world_from_camera=averted)
    with pytest.raises(InputError, match=r"behind it; .* z forward \(OpenGL") as refused:
        region_of_interest(camera, part, expected, within=0.02)
    assert_one_sentence(str(refused.value))
    assert region_of_interest(camera, part, expected, within=1.0) == (0, 0, 160, 120)


def test_the_whole_image_where_the_part_may_be_behind_the_camera() -> None:
    part = block_with_square_hole(hole=0.016)
    assert region_of_interest(CAMERA, part, CAMERA.world_from_camera, within=0.02) == (0, 0, 160, 120)
