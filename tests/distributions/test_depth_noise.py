"""Simulated sensor noise against its stated rates, scales and places."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.rendering.depth_noise import KINECT, REALSENSE_D435, DepthNoise

STILL = np.array([0.0, 0, 0, 1, 0, 0, 0])
CAMERA = Camera("sensor", 160, 120, 160.0, 160.0, 79.5, 59.5, STILL, near=0.1, far=2.0)
SILENT = DepthNoise(scale=0.0, step=0.0, dropout=0.0, flying=0.0, edge_dropout=0.0)
FLAT = np.full((120, 160), 0.5)


def slanted(angle: float, depth: float = 0.5) -> Array:
    """A plane whose normal is turned by an angle about the image's y axis, through the axis at a depth."""
    rays = CAMERA.rays().reshape(120, 160, 3)
    return np.asarray(depth * math.cos(angle) / (rays @ [math.sin(angle), 0.0, math.cos(angle)]))


def step_image() -> Array:
    """A box before a table: an edge between columns 79 and 80, and nothing in the last twenty columns."""
    image = np.full((120, 160), 0.6)
    image[:, :80], image[:, 140:] = 0.5, np.inf
    return image


def test_without_noise_nothing_changes() -> None:
    np.testing.assert_array_equal(SILENT.sample(CAMERA, FLAT, 0), FLAT)
    seen = SILENT.sample(CAMERA, step_image(), 0)
    assert np.isnan(seen[:, 140:]).all()
    np.testing.assert_array_equal(seen[:, :140], step_image()[:, :140])
    for angle in (0.3, 0.7):
        assert np.isfinite(SILENT.sample(CAMERA, slanted(angle), 0)).all()


def test_noise_has_the_stated_scale_and_grows_with_the_square_of_the_range() -> None:
    for z in (0.3, 0.8, 1.5):
        laplace = replace(SILENT, scale=0.002).sample(CAMERA, z * np.ones((120, 160)), 1) - z
        assert abs(np.abs(laplace).mean() - 0.002) < 5 * 0.002 / math.sqrt(laplace.size)
        stereo = replace(SILENT, scale=0.001, growth=0.004, growth_from=0.2, gaussian=True)
        error = stereo.sample(CAMERA, z * np.ones((120, 160)), 1) - z
        expected = 0.001 + 0.004 * (z - 0.2) ** 2
        assert abs(error.std() / expected - 1.0) < 5 / math.sqrt(2 * error.size)


def test_depth_is_read_in_steps() -> None:
    true = np.random.default_rng(0).uniform(0.3, 1.5, (120, 160))
    metres = replace(SILENT, step=0.001, edge=10.0).sample(CAMERA, true, 0)
    np.testing.assert_allclose(metres / 0.001, np.round(metres / 0.001), atol=1e-9)
    assert np.nanmax(np.abs(metres - true)) <= 0.0005 + 1e-12
    disparity = replace(SILENT, inverse_step=0.002, edge=10.0, grazing_to=math.pi, grazing_from=3.0)
    inverse = 1.0 / disparity.sample(CAMERA, true, 0)
    np.testing.assert_allclose(inverse / 0.002, np.round(inverse / 0.002), atol=1e-8)
    np.testing.assert_allclose(inverse, 1.0 / true, atol=0.001 + 1e-12)


def test_pixels_drop_out_at_the_stated_rate() -> None:
    lost = np.isnan(replace(SILENT, dropout=0.05).sample(CAMERA, FLAT, 2)).mean()
    assert abs(lost - 0.05) < 5 * math.sqrt(0.05 * 0.95 / FLAT.size)


def test_grazing_surfaces_are_lost() -> None:
    """Halfway between the two angles half of the pixels are; a plane's angle differs from ray to ray."""
    noise = replace(SILENT, grazing_from=math.radians(50), grazing_to=math.radians(80))
    image = slanted(math.radians(60))
    rays = CAMERA.rays() / np.linalg.norm(CAMERA.rays(), axis=1, keepdims=True)
    angle = np.arccos(np.abs(rays @ [math.sin(math.radians(60)), 0.0, math.cos(math.radians(60))]))
    expected = np.clip((np.degrees(angle) - 50) / 30, 0, 1).reshape(120, 160)
    seen = (image > CAMERA.near) & (image < CAMERA.far)
    lost = np.mean([np.isnan(noise.sample(CAMERA, image, seed)) for seed in range(25)], axis=0)
    assert 0.1 < expected[seen].mean() < 0.9
    assert abs(lost[seen].mean() - expected[seen].mean()) < 0.01
    for low, high in ((0.0, 0.2), (0.4, 0.6), (0.8, 1.0)):
        some = seen & (expected >= low) & (expected < high)
        assert some.sum() > 100 and abs(lost[some].mean() - expected[some].mean()) < 0.01


def test_flying_pixels_lie_between_the_two_sides_of_an_edge_only() -> None:
    noise = replace(SILENT, flying=0.5)
    images = np.stack([noise.sample(CAMERA, step_image(), seed) for seed in range(20)])
    true = step_image()
    off = (images != true) & np.isfinite(images)
    assert set(np.flatnonzero(off.any(axis=(0, 1)))) == {79, 80}
    flown = images[:, :, 79:81][off[:, :, 79:81]]
    assert flown.min() > 0.5 and flown.max() < 0.6 and abs(flown.mean() - 0.55) < 0.002
    assert abs(off[:, :, 79:81].mean() - 0.5) < 0.02
    for angle in (0.5, 1.0, 1.2):  # a slanted plane has no edge, however steep
        assert np.array_equal(
            noise.sample(CAMERA, slanted(angle), 0), SILENT.sample(CAMERA, slanted(angle), 0), True
        )


def test_edges_lose_pixels_also_where_nothing_stands_behind() -> None:
    lost = np.mean(
        [
            np.isnan(replace(SILENT, edge_dropout=0.3).sample(CAMERA, step_image(), seed))
            for seed in range(25)
        ],
        axis=(0, 1),
    )
    assert (lost[140:] == 1.0).all()
    at_edge = [79, 80, 139]
    assert np.abs(lost[at_edge] - 0.3).max() < 0.03
    assert (np.delete(lost, [*at_edge, *range(140, 160)]) == 0.0).all()


def test_the_range_ends() -> None:
    image = np.full((120, 160), 0.05)
    image[:, 80:] = 2.5
    assert np.isnan(SILENT.sample(CAMERA, image, 0)).all()


def test_a_seed_determines_the_image_and_images_come_in_batches() -> None:
    for noise in (DepthNoise(), REALSENSE_D435, KINECT):
        first, again, other = (noise.sample(CAMERA, step_image(), seed) for seed in (3, 3, 4))
        assert np.array_equal(first, again, equal_nan=True)
        assert not np.array_equal(first, other, equal_nan=True)
        several = noise.sample(CAMERA, np.stack([step_image(), FLAT]), np.random.default_rng(3))
        assert several.shape == (2, 120, 160) and not np.array_equal(several[0], several[1], equal_nan=True)
        assert 0.0005 < np.nanstd(several[1] - FLAT) < 0.004


def test_bad_input_is_named() -> None:
    for changes, message in [
        ({"scale": -1.0}, "scale"),
        ({"dropout": 1.5}, "dropout"),
        ({"growth": math.nan}, "growth"),
        ({"grazing_from": 80.0, "grazing_to": 85.0}, "radians"),
    ]:
        with pytest.raises(InputError, match=message):
            DepthNoise(**changes)
    with pytest.raises(InputError, match="not camera 'sensor'"):
        DepthNoise().sample(CAMERA, FLAT.T, 0)
