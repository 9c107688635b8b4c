"""The gap between a peg and a part, against closed forms, brute force, finite differences and MuJoCo."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters, build_model
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, block_with_hole, box_peg, peg_for
from bcppl.geometry.gap import PegGap
from bcppl.geometry.outlines import named_outline, round_outline
from bcppl.geometry.parts import Part
from bcppl.models.worlds.bench.parts import bench_part

SIZE = np.array([0.06, 0.06, 0.025])  # of the block, m; its top is z = 0
BASE = np.array([-0.5 * SIZE[0], -0.5 * SIZE[1], -SIZE[2]])
HALF, LENGTH = 0.008, 0.05  # of the peg, m
LOW = np.array([-HALF, -HALF, -LENGTH])
HIGH = np.array([HALF, HALF, 0.0])


@functools.cache
def box_gap() -> PegGap:
    return PegGap(block(tuple(SIZE)), box_peg(2 * HALF, LENGTH))


@functools.cache
def in_a_hole() -> tuple[PegGap, float]:
    hole, clearance = round_outline(0.016), 0.0005
    return PegGap(block_with_hole(hole, offset=(0.007, 0.005)), peg_for(hole, clearance, 0.08)), clearance


def pose(place: np.ndarray, turn: Rotation) -> Tensor:
    return torch.from_numpy(np.concatenate([place, turn.as_quat()[[3, 0, 1, 2]]]))


def anyhow(count: int, seed: int, shift: float = 0.3) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.stack(
        [pose(rng.uniform(-shift, shift, 3), turn) for turn in Rotation.random(count, rng=rng)]
    )


def box_distance(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Signed distances of points (..., 3) to a box."""
    out = np.abs(points - 0.5 * (low + high)) - 0.5 * (high - low)
    outside = np.linalg.norm(np.maximum(out, 0.0), axis=-1)
    return np.asarray(outside + np.minimum(out.max(axis=-1), 0.0))


def corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])


@functools.cache
def along_edges(apart: float) -> np.ndarray:
    """Points on the block's edges."""
    ends = corners(BASE, BASE + SIZE)
    points = []
    for a in range(8):
        for b in range(a + 1, 8):
            if bin(a ^ b).count("1") == 1:
                steps = int(np.linalg.norm(ends[b] - ends[a]) / apart) + 2
                points.append(ends[a] + np.linspace(0, 1, steps)[:, None] * (ends[b] - ends[a]))
    return np.concatenate(points)


@functools.cache
def near_contact() -> Tensor:
    """Poses (60, 7) of a tilted peg whose tip, or side, is within 1 mm of the block's top, or its edge."""
    rng, chosen = np.random.default_rng(2), []
    for k in range(60):
        turn = Rotation.from_rotvec([*rng.uniform(-0.4, 0.4, 2), rng.uniform(-3, 3)])
        if k % 2:  # pressed from the side, an upright edge on the block's top edge
            place = np.array([0.5 * SIZE[0] + HALF, rng.uniform(-0.01, 0.01), 0.5 * LENGTH])
        else:
            place = np.array([*rng.uniform(-0.035, 0.035, 2), LENGTH])
        direction = np.array([1.0, 0.0, 0.0]) if k % 2 else np.array([0.0, 0.0, 1.0])
        # Shifted towards the part until up to 1 mm deep, by the exact vertices and edges.
        shifts = np.linspace(-0.012, 0.012, 41)
        gaps = np.array([brute_force(pose(place + s * direction, turn), 1e-3) for s in shifts])
        near = shifts[np.abs(gaps - rng.uniform(-0.001, 0.001)).argmin()]
        chosen.append(pose(place + (near + rng.uniform(-1e-4, 1e-4)) * direction, turn))
    return torch.stack(chosen)


def brute_force(world_from_peg: Tensor, apart: float = 2e-5) -> float:
    """The minimum distance of the peg's vertices to the block or of the block's edges to the peg's planes."""
    turn = Rotation.from_quat(world_from_peg[[4, 5, 6, 3]].numpy())
    place = world_from_peg[:3].numpy()
    ends = box_distance(turn.apply(corners(LOW, HIGH)) + place, BASE, BASE + SIZE).min()
    edge = turn.inv().apply(along_edges(apart) - place)
    planes = np.maximum(LOW - edge, edge - HIGH).max(axis=1).min()
    return float(min(ends, planes))


@pytest.mark.parametrize("tilt", [0.0, 0.02, 0.3])
def test_over_a_plane_it_is_the_height_of_the_lowest_corner(tilt: float) -> None:
    heights = np.array([0.004, 0.0004, 0.0, -0.0001, -0.003, -0.009])
    turn = Rotation.from_rotvec([tilt, 0.5 * tilt, 0.0])
    down = turn.apply(corners(LOW, HIGH))[:, 2].min()
    peg = torch.stack([pose(np.array([0.003, -0.002, h - down]), turn) for h in heights])
    part = anyhow(3, 0)
    for n in range(3):
        gap = box_gap()(part[n : n + 1], poses.compose(part[n], peg))
        # At 2 mm of penetration and more, distances have the grid's single precision.
        np.testing.assert_allclose(gap.distance[0].numpy(), heights, atol=2e-9)
        np.testing.assert_allclose(gap.normal[0, 1:4].numpy(), [[0.0, 0.0, 1.0]] * 3, atol=1e-6)
        np.testing.assert_allclose(gap.witness[0, :, 2].numpy(), heights, atol=1e-9)


def test_vertices_and_crossing_edges_are_those_of_brute_force() -> None:
    peg = near_contact()
    gap = box_gap()(poses.identity(1), peg)
    exact = np.array([brute_force(p) for p in peg])
    touching, computed = exact < 0.0, gap.distance[0].numpy()
    crossing = (np.abs(gap.witness[0, :, :2].numpy()) - 0.5 * SIZE[:2]).max(axis=-1) > -1e-9
    assert 10 < touching.sum() < 50 and (crossing & touching).sum() >= 5
    assert np.abs(computed - exact)[~crossing].max() < 1.2e-5
    # Where edges cross the depth is along their common normal: up to the diagonal of the depth by one plane.
    share = (computed / exact)[crossing & touching & (exact < -1e-4)]
    assert share.min() > 0.98 and share.max() < math.sqrt(2.0) + 0.02 and share.max() > 1.05


def test_it_is_mujocos_contact_distance_between_boxes() -> None:
    peg = near_contact()
    model = build_model(box_gap().part, box_gap().peg, ContactParameters())
    data, theirs = mujoco.MjData(model), []
    geoms = [int(model.body_geomadr[model.body(name).id]) for name in ("part", "peg")]
    for p in peg.numpy():
        data.qpos[:] = p
        mujoco.mj_forward(model, data)
        theirs.append(mujoco.mj_geomDistance(model, data, *geoms, 0.1, None))
    gap = box_gap()(poses.identity(1), peg)
    ours, others = gap.distance[0].numpy(), np.array(theirs)
    clear = np.abs(others) > 2e-5
    assert np.all(np.sign(ours[clear]) == np.sign(others[clear])) and 10 < (others < 0).sum() < 50
    share = (ours / others)[clear & (others < 0)]
    assert (np.abs(share - 1.0) < 0.01).mean() > 0.8 and share.max() < 1.02
    beside_it = clear & (others > 0) & (others < 0.0015)  # farther edges are not evaluated
    assert beside_it.sum() > 5 and np.all(ours[beside_it] < others[beside_it] + 1e-5)


@pytest.mark.long
@pytest.mark.parametrize("name", ["round tray", "D 10 mm", "hexagon 12 mm"])
def test_pegs_in_and_over_the_holes_of_the_bench_touch_where_mujocos_do(name: str) -> None:
    """Part and peg in many convex pieces, near contact in the hole, on its rim and on the top."""
    kind, rng = bench_part(name), np.random.default_rng(3)
    peg = kind.peg(0.0005)
    hole = torch.from_numpy(kind.part_from_hole)
    into = rng.choice([-0.006, 0.0002, 0.0], 40)
    where = np.stack([*rng.uniform(-4e-4, 4e-4, (2, 40)), into + 0.08 + rng.uniform(-2e-4, 2e-4, 40)], axis=1)
    where[::4, 0] += 0.012
    turns = Rotation.from_rotvec(rng.uniform(-0.01, 0.01, (40, 3)))
    world_from_peg = torch.stack([poses.compose(hole, pose(p, t)) for p, t in zip(where, turns, strict=True)])
    ours = PegGap(kind.part, peg)(poses.identity(1), world_from_peg).distance[0].numpy()
    model = build_model(kind.part, peg, ContactParameters())
    data, theirs = mujoco.MjData(model), []
    for p in world_from_peg.numpy():
        data.qpos[:] = p
        mujoco.mj_forward(model, data)
        theirs.append(min((c.dist for c in data.contact), default=math.inf))
    apart = np.isinf(theirs)
    assert 5 < apart.sum() < 35
    assert ours[apart].min() > -1e-5
    # MuJoCo's depth is that of one piece: at most the deepest vertex's, but for a crossing of edges.
    np.testing.assert_array_less(ours[~apart], 2e-5)
    shallow = ~apart & (ours > -3e-4)
    off = np.abs(ours[shallow] - np.array(theirs)[shallow])
    assert off.max() < 1.2e-4 and (off < 5e-6).mean() > 0.8


def test_pegs_that_lean_in_a_hole_are_as_far_from_its_walls_as_by_mujoco() -> None:
    """Near the edges between walls interpolated distances are off by a tenth of a millimetre."""
    kind, rng = bench_part("hexagon 12 mm"), np.random.default_rng(5)
    peg = kind.peg(0.0005)
    where = np.stack([*rng.uniform(-2e-4, 2e-4, (2, 200)), rng.uniform(0.069, 0.077, 200)], axis=1)
    turns = Rotation.from_rotvec(rng.uniform(-0.008, 0.008, (200, 3)))
    hole = torch.from_numpy(kind.part_from_hole)
    world_from_peg = torch.stack([poses.compose(hole, pose(p, t)) for p, t in zip(where, turns, strict=True)])
    ours = PegGap(kind.part, peg)(poses.identity(1), world_from_peg).distance[0].numpy()
    model = build_model(kind.part, peg, ContactParameters())
    data, theirs = mujoco.MjData(model), []
    first, count = model.body_geomadr, model.body_geomnum
    pieces, pegs = (
        range(first[body], first[body] + count[body])
        for body in (model.body("part").id, model.body("peg").id)
    )
    for p in world_from_peg.numpy():
        data.qpos[:] = p
        mujoco.mj_forward(model, data)
        each = [mujoco.mj_geomDistance(model, data, a, b, 0.1, None) for a in pieces for b in pegs]
        theirs.append(min(each))
    off = (ours - np.array(theirs))[np.array(theirs) > -3e-4]
    assert len(off) > 80 and (np.array(theirs) > 0.0).sum() > 5
    # MuJoCo's depth is the least by which one piece has to be moved: at most the deepest vertex's.
    assert off.max() < 1e-7 and off.min() > -5e-5 and (np.abs(off) < 1e-7).mean() > 0.75


@pytest.mark.long
def test_a_grid_that_knows_how_inexact_it_is_gives_the_same_gaps_with_fewer_searches() -> None:
    gap = PegGap(bench_part("round tray").part, peg_for(round_outline(0.008), 0.0005, 0.05))
    pegs = torch.cat([anyhow(40, 3, 0.02), anyhow(200, 4, 0.03)])
    coarse = gap(poses.identity(1), pegs)
    assert gap._grid is not None
    before, grid = gap._grid._searched, gap._grid.grid
    gap._grid.measure()
    assert gap._grid.grid is not grid
    fine = gap(poses.identity(1), pegs)
    for name in ("distance", "witness", "normal"):
        torch.testing.assert_close(getattr(coarse, name), getattr(fine, name), rtol=0.0, atol=2e-6)
    assert before > 100
    assert gap._grid._searched - before < 0.8 * before


def test_centred_in_a_round_hole_it_is_half_the_clearance() -> None:
    gap, clearance = in_a_hole()
    off = np.array([0.0, 5e-5, -1e-4, 2e-4, 0.00025, 0.0003])
    peg = torch.stack([pose(np.array([0.007 + x, 0.005, 0.07]), Rotation.identity()) for x in off])
    distance = gap(poses.identity(1), peg).distance[0].numpy()
    # Of 64 vertices the grid may choose one up to three sides (8.4 degrees) from the closest.
    assert np.all(np.abs(distance - 0.5 * clearance + np.abs(off)) < 0.012 * np.abs(off) + 1e-8)


@pytest.mark.long
@pytest.mark.parametrize("facets", ["coarse", "fine"])
def test_flat_sides_touch_a_ball_and_a_cylinder_however_finely_these_are_meshed(facets: str) -> None:
    """At no vertex of the peg, and at edges that are as shallow as the meshes are fine."""
    radius, heights = 0.01, np.array([0.001, 0.0, -0.001, -0.004])
    levels, sides = {"coarse": (3, 64), "fine": (4, 96)}[facets]
    ball = trimesh.creation.icosphere(levels, radius)
    upright = trimesh.creation.cylinder(radius, 0.04, sections=sides)
    above, beside = (
        torch.stack([pose(np.array(place), Rotation.identity()) for place in each])
        for each in (
            [(0.0, 0.0, radius + h + LENGTH) for h in heights],
            [(radius + h + HALF, 0.0, 0.5 * LENGTH) for h in heights],
        )
    )
    for mesh, peg in ((ball, above), (upright, beside)):
        part = Part("round", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))
        gap = PegGap(part, box_peg(2 * HALF, LENGTH))(poses.identity(1), peg)
        np.testing.assert_allclose(gap.distance[0].numpy(), heights, atol=2e-6)


def test_gradients_are_finite_differences() -> None:
    turns = [Rotation.from_rotvec([0.1, 0.05, z]) for z in np.linspace(0, 1.5, 15)]
    flat = torch.stack([pose(np.array([0.01, 0.0, LENGTH - 1e-3]), turn) for turn in turns])
    pegs = torch.cat([flat, near_contact()])
    part, step = anyhow(1, 4, 0.02), 1e-7
    peg = poses.compose(part[0], pegs)
    gap = box_gap()(part, peg)
    numeric = torch.stack(
        [
            box_gap()(poses.retract(part, step * axis), peg).distance[0]
            - box_gap()(poses.retract(part, -step * axis), peg).distance[0]
            for axis in torch.eye(6, dtype=torch.float64)
        ],
        dim=-1,
    ) / (2 * step)
    error = (gap.gradient(part)[0] - numeric).abs().amax(dim=-1).numpy()
    witness = poses.transform(poses.inverse(pegs), gap.witness[0][:, None])[:, 0].numpy()
    at_vertex = np.abs(box_distance(witness, LOW, HIGH)) < 1e-9
    assert at_vertex.sum() > 25 and (~at_vertex).sum() > 10  # the others are where edges cross
    assert np.quantile(error[at_vertex], 0.9) < 1e-4
    assert np.quantile(error[~at_vertex], 0.8) < 1e-3


def test_moving_part_and_peg_together_changes_nothing() -> None:
    gap, _ = in_a_hole()
    rng = np.random.default_rng(6)
    part = poses.retract(poses.identity(9), torch.from_numpy(rng.normal(size=(9, 6)) * 2e-3))
    turn = Rotation.from_rotvec([0.01, 0.0, 0.3])
    peg = torch.stack([pose(np.array([0.007, 0.005, z]), turn) for z in np.linspace(0.07, 0.083, 8)])
    here = gap(part, peg)
    for motion in anyhow(3, 7):
        there = gap(poses.compose(motion, part), poses.compose(motion, peg))
        torch.testing.assert_close(there.distance, here.distance, atol=1e-9, rtol=0.0)
        torch.testing.assert_close(there.witness, here.witness, atol=1e-8, rtol=0.0)
    # Evaluated one particle and one stamp at a time.
    each = torch.stack([torch.cat([gap(a[None], b[None]).distance[0] for b in peg]) for a in part])
    assert torch.equal(each, here.distance)


def test_a_peg_in_deep_penetration_and_empty_batches() -> None:
    part, peg = (
        poses.identity(1),
        torch.stack(
            [pose(np.array([0.0, 0.0, LENGTH - d]), Rotation.identity()) for d in (0.003, 0.006, 0.012)]
        ),
    )
    gap = box_gap()(part, peg)
    np.testing.assert_allclose(gap.distance[0].numpy(), [-0.003, -0.006, -0.012], atol=1e-6)
    rng, turns = (
        np.random.default_rng(8),
        Rotation.from_rotvec(np.random.default_rng(9).normal(size=(30, 3)) * 0.2),
    )
    tips = rng.uniform([-0.02, -0.02, -0.011], [0.02, 0.02, -0.004], (30, 3))
    inside = torch.stack([pose(p - t.apply([0, 0, -LENGTH]), t) for p, t in zip(tips, turns, strict=True)])
    exact = np.array([brute_force(p, 2e-4) for p in inside])
    assert exact.max() < -0.004
    assert np.abs(box_gap()(part, inside).distance[0].numpy() - exact).max() < 0.0009
    for n, t in ((0, 3), (2, 0), (0, 0)):
        none = box_gap()(poses.identity(n), poses.identity(t))
        assert none.distance.shape == (n, t) and none.witness.shape == none.normal.shape == (n, t, 3)
        assert none.gradient(poses.identity(n)).shape == (n, t, 6)


def test_an_open_part_is_refused() -> None:
    whole = block((0.02, 0.02, 0.01))
    with pytest.raises(InputError, match="open"):
        PegGap(Part("lid off", whole.vertices, whole.faces[:-1]), box_peg(0.008, 0.05))


def test_a_peg_that_is_not_convex_needs_its_pieces_and_a_part_does_not() -> None:
    """The hull of a peg with a feather fills the corners beside it: it would touch where nothing does."""
    hole, clearance = named_outline("keyway", 0.016), 0.0002
    part, peg = replace(block_with_hole(hole), pieces=()), peg_for(hole, clearance, LENGTH)
    centred = pose(np.array([0.0, 0.0, LENGTH - 0.01]), Rotation.identity())[None]
    assert PegGap(part, peg)(poses.identity(1), centred).distance.item() == pytest.approx(
        0.5 * clearance, rel=1e-4
    )
    with pytest.raises(InputError, match=r"peg.*no convex pieces"):
        PegGap(part, replace(peg, pieces=()))
