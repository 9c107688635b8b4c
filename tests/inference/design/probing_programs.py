"""Populations over a part's pose, for the tests of probing."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.inference.population import Population
from bcppl.poses import FREE, Freedom
from bcppl.traces import generate, simulate
from tests.invariance import matrix

CENTER = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
SPREAD = [0.004, 0.002, 0.001, 0.02, 0.01, 0.03]
PLANAR = Freedom("xy", "z")


def placed(freedom: Freedom, axes: list[int], noise: float = 0.0005) -> None:
    """A part at a pose, whose coordinates along some of the world's axes are read."""
    spread = freedom.coordinates(matrix(SPREAD))
    part = pyro.sample("part", NormalPose(CENTER, spread, freedom))
    for k, axis in enumerate(axes):
        pyro.sample(f"y_{k}", dist.Normal(part[..., axis], noise))


def particles(count: int, freedom: Freedom = FREE, seed: int = 0) -> Population:
    torch.manual_seed(seed)
    return Population(simulate(placed, (freedom, []), count))


def at(world_from_part: Tensor, log_weights: Tensor | None = None, freedom: Freedom = FREE) -> Population:
    """Particles at given poses."""
    count = len(world_from_part)
    trace, _ = generate(placed, (freedom, []), {}, count, choices={"part": world_from_part})
    return Population(trace, torch.zeros(count, dtype=torch.float64) if log_weights is None else log_weights)


def doubled(population: Population) -> Population:
    return population[torch.arange(len(population)).repeat(2)]
