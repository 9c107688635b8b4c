"""Other hypotheses than a belief's: outside the guess, mirrored, turned; and silence where there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pyro
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.cli.predictive_checks import displaced_sentence, edge_sentence
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.poses import NormalPose, SwingTwistPose, UniformPose
from bcppl.geometry.parts import Part
from bcppl.inference.criticism import hypotheses
from bcppl.inference.criticism.hypotheses import alternatives, displaced, edges, likeliest
from bcppl.inference.population import Population
from bcppl.inference.resampling import seeded
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.rasterisation import Rasteriser
from bcppl.rendering.ray_casting import RayCaster
from bcppl.traces import generate
from tests.made_recordings import assert_one_sentence

COUNT = 12
SCENE = bench_scene(0)
TRUTH = torch.from_numpy(SCENE.truth)


def moved(*tangent: float) -> Tensor:
    """The truth moved by a tangent, of which numbers left out are 0."""
    whole = torch.zeros(6, dtype=torch.float64)
    whole[: len(tangent)] = torch.tensor(tangent, dtype=torch.float64)
    return poses.retract(TRUTH, whole)


def turned_about_z(degrees: float) -> np.ndarray:
    half = math.radians(degrees) / 2.0
    return np.array([0.0, 0.0, 0.0, math.cos(half), 0.0, 0.0, math.sin(half)])


def seen(part: Part = SCENE.part) -> Tensor:
    """An image of a part at the truth, with errors of 2 mm."""
    rendered = RayCaster(part).images(SCENE.cameras[0], TRUTH[None])[0]
    noise = np.random.default_rng(0).laplace(scale=0.002, size=rendered.shape)
    return torch.from_numpy(np.where(np.isfinite(rendered), rendered + noise, np.nan))


def belief(
    prior: Any, middle: Tensor, part: Part = SCENE.part, renderer: type[PartRenderer] = RayCaster
) -> Population:
    """Particles within tenths of a millimetre of a pose, clamped to nothing: all have the same weight."""

    def program() -> None:
        pose = pyro.sample("part", prior)
        site = RobustDepth(renderer(part), SCENE.cameras[0], pose, 0.002, effective_pixels=300.0)
        pyro.sample("depth", site)

    torch.manual_seed(0)
    trace, _ = generate(program, (), {"depth": seen()}, COUNT)
    spread = torch.tensor([1e-4] * 3 + [1e-3] * 3, dtype=torch.float64)
    drawn = NormalPose(middle, spread).expand((COUNT,)).sample()
    return Population(trace.at({"part": drawn}))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_truth_outside_the_box_is_named_with_its_axis(axis: int, side: float) -> None:
    """The truth is 8 mm outside a box of 20 mm: particles at its edge, and nothing to be seen of them."""
    unit = np.eye(3)[axis] * side
    population = belief(UniformPose(moved(*-0.028 * unit), 0.02, 0.3), moved(*-0.0083 * unit))
    (found,) = edges(population, "part")
    assert found.axis == "xyz"[axis] and found.limit == pytest.approx(0.02 * side)
    assert found.mass > 0.9 and found.decisive and found.beyond == pytest.approx(0.008, abs=0.003)
    sentence = edge_sentence(found)
    assert_one_sentence(sentence)
    assert f"{'xyz'[axis]} {20 * side:+.3g} mm" in sentence and "widen the guess" in sentence


def test_a_truth_beyond_the_yaw_and_one_beyond_an_angle_are_named() -> None:
    turned = moved(0.0, 0.0, 0.0, 0.0, 0.0, -0.14)
    upright = SwingTwistPose(moved(0.0, 0.0, 0.0, 0.0, 0.0, -0.35), 0.02, 0.2, 0.2)
    (found,) = edges(belief(upright, turned), "part")
    assert found.axis == "yaw" and found.decisive and found.beyond == pytest.approx(0.15, abs=0.07)
    within = UniformPose(moved(0.0, 0.0, 0.0, 0.0, 0.0, -0.35), 0.02, 0.22)
    (found,) = edges(belief(within, turned), "part")
    assert found.axis == "angle" and found.decisive


@pytest.mark.parametrize("degrees", [0.0, 60.0, 170.0])
def test_each_coordinate_grows_along_its_own_direction_however_far_the_part_is_turned(degrees: float) -> None:
    tilted = poses.compose(moved(0.0, 0.0, 0.0, 0.1, 0.05), torch.from_numpy(turned_about_z(degrees)))
    pose = poses.retract(tilted, torch.zeros(COUNT, 6).double())
    prior = SwingTwistPose(TRUTH, 0.02, 0.2, math.pi - 0.01)
    step, grown = 1e-6, {}
    for axis, limit, place, outwards in hypotheses._limits(prior, pose):
        there = {
            name: each for name, _, each, _ in hypotheses._limits(prior, poses.retract(pose, step * outwards))
        }
        grown[axis] = float(((there[axis] - place) / step).mean())
        assert limit > 0.0
    assert grown["tilt"] == pytest.approx(1.0, abs=1e-4) and grown["yaw"] == pytest.approx(1.0, abs=1e-2)


def test_a_truth_just_inside_is_reported_and_not_decisive_and_one_far_inside_is_not() -> None:
    (found,) = edges(belief(UniformPose(moved(-0.0195, 0.0, 0.0), 0.02, 0.3), TRUTH), "part")
    assert found.axis == "x" and not found.decisive
    assert edges(belief(UniformPose(TRUTH, 0.02, 0.3), TRUTH), "part") == []
    assert edges(belief(NormalPose(TRUTH, torch.full((6,), 0.01).double()), TRUTH), "part") == []


def test_a_mutant_that_compares_nothing_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hypotheses, "_of_others", lambda trace, address: torch.zeros(len(trace)).double())
    population = belief(UniformPose(moved(-0.028, 0.0, 0.0), 0.02, 0.3), moved(-0.0083, 0.0, 0.0))
    assert not any(edge.decisive for edge in edges(population, "part"))


def other(linear: np.ndarray) -> Part:
    """The scene's part under a map (3, 3) about the middle of its box."""
    vertices = SCENE.part.vertices
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    faces = SCENE.part.faces if np.linalg.det(linear) > 0.0 else SCENE.part.faces[:, ::-1].copy()
    mapped = np.ascontiguousarray((vertices - middle) @ linear.T + middle)
    return replace(SCENE.part, vertices=mapped, faces=faces, pieces=())


@pytest.mark.parametrize("renderer", [RayCaster, Rasteriser])
def test_a_mirrored_part_and_a_turned_one_are_named_and_the_right_one_is_not(
    renderer: type[PartRenderer],
) -> None:
    prior = UniformPose(TRUTH, 0.02, 0.3)
    assert alternatives(belief(prior, TRUTH, renderer=renderer)) == []
    mirrored = alternatives(belief(prior, TRUTH, other(np.diag([-1.0, 1.0, 1.0])), renderer))
    assert "mirrored along x" in likeliest(mirrored) and mirrored[0].gain > 20.0
    quarter = other(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]))
    turned = alternatives(belief(prior, TRUTH, quarter, renderer))
    assert "turned by -90° about its z" in likeliest(turned) and turned[0].gain > 20.0


@pytest.mark.long
@pytest.mark.parametrize("away", [(0.0, 0.0), (0.02, 0.0), (0.0, -0.015)])
def test_an_image_of_a_part_that_moved_along_its_table_is_named_and_one_of_a_part_that_stood_is_not(
    away: tuple[float, float],
) -> None:
    """Whatever the seed of the search."""
    population = belief(UniformPose(TRUTH, 0.05, 0.5), moved(*away))
    for seed in range(5):
        found = displaced(population, seed=seed)
        if away == (0.0, 0.0):
            assert not found
            continue
        (one,) = found
        assert one.address == "depth" and one.gain > 10.0
        assert one.distance == pytest.approx(np.linalg.norm(away), abs=0.006)
        assert_one_sentence(displaced_sentence({"view 2": one}))


def test_the_evidence_of_a_displaced_part_is_that_of_quadrature() -> None:
    """Log Bayes factors of a Gaussian image of three displacements, which has an exact answer."""

    @dataclass(frozen=True)
    class Bump:
        pose: Tensor
        width = torch.tensor([0.003] * 3 + [0.02] * 3, dtype=torch.float64)

        def log_prob(self, image: Tensor) -> Tensor:
            away = poses.local(poses.identity(), self.pose) - image
            return -0.5 * (away / self.width).square().sum(dim=-1)

    class Few:
        def __init__(self, count: int) -> None:
            self.distributions = {"depth": Bump(poses.identity().expand(count, 7))}

        def chosen(self, index: Tensor) -> Few:
            return Few(len(index))

        def log_prob(self, address: str) -> Tensor:
            return self.distributions[address].log_prob(self[address])

        def __getitem__(self, address: str) -> Tensor:
            return image

    for shift in (0.0, 0.006, 0.02):
        image = torch.tensor([shift, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        wide = hypotheses.DISPLACEMENT.square() + Bump.width.square()
        # Of a product of normal densities, against the likelihood at no displacement.
        marginal = 0.5 * (Bump.width.square() / wide).log().sum() - 0.5 * (image.square() / wide).sum()
        exact = float(marginal + 0.5 * (image / Bump.width).square().sum())
        with seeded(0):
            gain = hypotheses._displaced(cast(Any, Few(4)), "depth").gain
        assert gain == pytest.approx(exact, abs=0.7)
