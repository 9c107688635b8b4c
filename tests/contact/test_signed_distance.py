"""Signed distances, against libigl's tree and winding numbers, and what a grid of them says of its errors."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch
import trimesh

from bcppl.compiled import compiled
from bcppl.geometry.distance import SignedDistance, closed_mesh
from bcppl.geometry.gap.distance_grid import DistanceGrid, RefinedGrid, distance_grid, inexact, interpolated
from bcppl.geometry.parts import Part
from bcppl.models.worlds.bench.parts import bench_part

PARTS = ["D 10 mm", "round tray"]
NEAR = 0.004


def part_of(name: str) -> Part:
    if name == "sphere":
        mesh = trimesh.creation.icosphere(3, 0.02)
        return Part(name, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return bench_part(name).part


def points_about(part: Part, count: int) -> np.ndarray:
    """In the part, around it, on its surface, at its vertices and on its edges."""
    rng, mesh = np.random.default_rng(0), closed_mesh(part)
    corners = mesh.vertices[mesh.faces[:300]]
    inside = rng.uniform(part.vertices.min(axis=0) - 0.01, part.vertices.max(axis=0) + 0.01, (count, 3))
    return np.concatenate([inside, corners.mean(axis=1), corners[:, 0], corners[:, :2].mean(axis=1)])


@pytest.mark.long
@pytest.mark.parametrize("name", ["sphere", *PARTS])
def test_distances_are_those_of_libigl_and_negative_inside(name: str) -> None:
    part = part_of(name)
    mesh, points = closed_mesh(part), points_about(part, 2000)
    vertices, faces = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces)
    tree = igl.AABB()
    tree.init(vertices, faces)
    squared = tree.squared_distance(vertices, faces, points)[0].reshape(-1)
    found = SignedDistance(part)(torch.from_numpy(points))
    np.testing.assert_allclose(found.distance.abs(), np.sqrt(squared), atol=1e-9)
    to_closest = np.linalg.norm(points - found.closest.numpy(), axis=1)
    np.testing.assert_allclose(to_closest, np.sqrt(squared), atol=1e-9)
    clear = squared > 1e-12
    winding = igl.winding_number(vertices, faces, points[clear])
    assert ((found.distance.numpy()[clear] < 0.0) == (winding > 0.5)).all()
    np.testing.assert_allclose(found.normal.norm(dim=1), 1.0, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", PARTS)
def test_interpolation_is_nowhere_farther_off_than_the_grid_states(name: str) -> None:
    part = part_of(name)
    signed, rng = SignedDistance(part), np.random.default_rng(1)
    refined = RefinedGrid(distance_grid(part, signed, 0.012), signed, NEAR)
    coarse = refined.grid
    refined.measure()
    grid = refined.grid
    points = rng.uniform(part.vertices.min(axis=0) - NEAR, part.vertices.max(axis=0) + NEAR, (100_000, 3))
    exact = signed(torch.from_numpy(points)).distance.numpy()
    here, stated = looked_up(points, grid)
    near = np.abs(exact) < NEAR
    assert (np.abs(looked_up(points, coarse)[0] - exact) <= looked_up(points, coarse)[1] + 2e-6).all()
    off = np.abs(here - exact)
    assert (off <= stated + 2e-6).all()  # a cell whose corners are in a plane to 1e-6 counts as exact
    # Where something may be missed it is stated closely: a coarse bound costs exact distances.
    assert np.median(stated[near & (stated > 0.0)]) < 0.15 * grid.spacing
    assert (stated[near] > 1e-7).mean() > 0.05


@compiled
def _look_up(points: np.ndarray, grid: DistanceGrid, here: np.ndarray, stated: np.ndarray) -> None:
    for p in range(len(points)):
        x, y, z = points[p]
        here[p], stated[p] = interpolated(x, y, z, grid), inexact(x, y, z, grid)


def looked_up(points: np.ndarray, grid: DistanceGrid) -> tuple[np.ndarray, np.ndarray]:
    here, stated = np.empty(len(points)), np.empty(len(points))
    _look_up(points, grid, here, stated)
    return here, stated
