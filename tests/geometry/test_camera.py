"""Cameras: viewing direction, lens distortion, regions of interest and binning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, bin_depth, looking_at


def test_the_point_is_on_the_optical_axis_and_up_is_up() -> None:
    eye, point = np.array([0.3, -0.2, 0.5]), np.array([0.05, 0.1, 0.02])
    world_from_camera = torch.from_numpy(looking_at(eye, point))
    seen = poses.transform(
        poses.inverse(world_from_camera), torch.from_numpy(np.stack([point, point + np.array([0, 0, 0.1])]))
    )
    assert seen[0].numpy() == pytest.approx([0.0, 0.0, np.linalg.norm(point - eye)])
    assert float(seen[1, 1]) < -0.01, "what is higher is higher in the image: y points down"
    assert float(seen[1, 0]) == pytest.approx(0.0, abs=1e-12)


def test_looking_along_up_is_refused() -> None:
    with pytest.raises(InputError, match="upwards"):
        looking_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    assert np.isfinite(looking_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0], up=(0.0, 1.0, 0.0))).all()


# ---- the lens

STILL = np.array([0.0, 0, 0, 1, 0, 0, 0])
LENSES = [(0.12, -0.25, 0.002, -0.004, 0.08), (-0.3, 0.12, 0.003, -0.005), (0.1, 0.0, 0.0, 0.0)]


def lens(distortion: Sequence[float], width: int = 64, height: int = 48) -> Camera:
    return Camera("lens", width, height, 51.0, 55.0, 30.3, 25.1, STILL, distortion=distortion)


def pixels(camera: Camera) -> Array:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)


@pytest.mark.parametrize("distortion", LENSES)
def test_projections_are_those_of_opencvs_formula(distortion: Sequence[float]) -> None:
    """The formula in OpenCV's documentation of calib3d, one point at a time."""
    camera = lens(distortion)
    k1, k2, p1, p2, k3 = (*distortion, 0.0)[:5]
    for point in np.random.default_rng(0).uniform([-0.4, -0.3, 0.7], [0.4, 0.3, 1.5], (40, 3)):
        x, y = point[0] / point[2], point[1] / point[2]
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = 51.0 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + 30.3
        v = 55.0 * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + 25.1
        np.testing.assert_allclose(camera.project(point), [u, v], rtol=1e-12)


@pytest.mark.parametrize("distortion", [(), *LENSES])
def test_rays_project_to_their_pixels(distortion: Sequence[float]) -> None:
    camera = lens(distortion)
    rays = camera.rays()
    assert (rays[:, 2] == 1.0).all()
    np.testing.assert_allclose(camera.project(rays * 0.7), pixels(camera), atol=1e-8)
    if distortion:
        assert np.abs(rays - lens(()).rays()).max() > 0.01


def test_a_lens_that_folds_the_image_is_refused() -> None:
    for distortion in [(-1.5, 0, 0, 0), (0.0, -2.0, 0, 0), (0, 0, 0.6, 0)]:
        with pytest.raises(InputError, match="folds the image over"):
            lens(distortion).rays()
    with pytest.raises(InputError, match="k1 k2 p1 p2"):
        lens([0.1] * 8).rays()


def test_points_beside_or_behind_the_camera_have_no_projection() -> None:
    """Far off axis the polynomial of a barrel lens decreases and would fold the point into the image."""
    camera = lens((-0.3, 0.0, 0.0, 0.0))
    seen = camera.project([[0, 0, -1.0], [0, 0, 0.0], [1.8, 0, 1.0], [0.1, 0, 1.0]])
    assert np.isnan(seen[:3]).all() and np.isfinite(seen[3]).all()
    folded = 1.8 * (1 - 0.3 * 1.8**2)
    assert abs(folded) < 0.1, "the formula alone projects it near the centre"


@pytest.mark.parametrize("distortion", [(), LENSES[0]])
def test_a_region_has_the_rays_of_the_image(distortion: Sequence[float]) -> None:
    camera = lens(distortion)
    region = camera.cropped(10, 7, 21, 16)
    whole = camera.rays().reshape(48, 64, 3)
    np.testing.assert_allclose(region.rays().reshape(16, 21, 3), whole[7:23, 10:31], rtol=1e-12, atol=1e-14)
    for bad in [(-1, 0, 5, 5), (60, 0, 5, 5), (0, 44, 5, 5), (0, 0, 0, 5), (0.5, 0, 5, 5), (0, 0, 5, 2.5)]:
        with pytest.raises(InputError, match="region"):
            camera.cropped(*bad)


@pytest.mark.parametrize("k", [2, 3, 5])
def test_a_binned_pixel_has_the_ray_of_its_blocks_centre(k: int) -> None:
    """Without distortion the mean of the block's rays; with it, the ray of the pixel at the centre."""
    camera = lens(())
    binned = camera.binned(k)
    assert (binned.width, binned.height) == (64 // k, 48 // k)
    rays = camera.rays().reshape(48, 64, 3)[: 48 // k * k, : 64 // k * k]
    mean = rays.reshape(48 // k, k, 64 // k, k, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(binned.rays().reshape(mean.shape), mean, rtol=1e-12, atol=1e-14)
    if k % 2:
        whole = lens(LENSES[0]).rays().reshape(48, 64, 3)
        middle = whole[k // 2 : 48 // k * k : k, k // 2 : 64 // k * k : k]
        np.testing.assert_allclose(
            lens(LENSES[0]).binned(k).rays().reshape(middle.shape), middle, rtol=1e-11, atol=1e-13
        )


def test_binned_depths_are_readings_and_no_means_across_edges() -> None:
    nan = np.nan
    depth = np.array(
        [
            [0.500, 0.502, 0.5, 0.7, nan, 0.0, 9.0],
            [0.501, 0.503, 0.5, 0.7, -1.0, np.inf, 9.0],
            [0.500, nan, 0.5, 0.7, 0.6, 0.0, 9.0],
            [nan, 0.0, 0.7, 0.7, nan, 3.0, 9.0],
        ]
    )
    binned = bin_depth(depth, 2, far=2.0)
    np.testing.assert_allclose(binned, [[0.5015, 0.5, nan], [0.5, 0.7, 0.6]])
    noisy = np.random.default_rng(0).choice([0.5, 0.7, nan], size=(60, 80))
    read = bin_depth(noisy, 4)
    assert np.isin(read[np.isfinite(read)], [0.5, 0.7]).all()
    for bad in (0, 5, 2.0):
        with pytest.raises(InputError, match="binned"):
            bin_depth(depth, bad)


# ---- the wrist


def test_a_wrist_camera_moves_with_the_arm() -> None:
    hand = np.array([0.05, 0.0, 0.08, np.cos(0.2), 0.0, np.sin(0.2), 0.0])
    camera = replace(lens(()), wrist_from_camera=hand)
    rng = np.random.default_rng(1)
    wrist = poses.retract(poses.identity(), torch.from_numpy(rng.normal(size=6)))
    there = camera.on(wrist, name="lens at 1")
    point = torch.from_numpy(rng.normal(size=(1, 3)))
    through_wrist = poses.transform(wrist, poses.transform(torch.from_numpy(hand), point))
    np.testing.assert_allclose(
        poses.transform(torch.from_numpy(there.world_from_camera), point), through_wrist, atol=1e-12
    )
    assert (there.name, there.instrument) == ("lens at 1", "lens")
    assert there.on(wrist, name="lens at 2").instrument == "lens"
    with pytest.raises(InputError, match="wrist_from_camera"):
        lens(()).on(wrist)
    with pytest.raises(InputError, match="finite"):
        camera.on(np.full(7, np.nan))
