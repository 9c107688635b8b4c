"""Moves of one particle, and of copies of one, leave the target invariant, whatever they are fitted to."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl.inference.kernels import metropolis_hastings, moved_by
from bcppl.inference.population import Population
from bcppl.inference.proposals import independent
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import generate

KERNEL = metropolis_hastings(independent("x"))


def standard() -> None:
    pyro.sample("x", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))


@pytest.mark.long
def test_an_independence_proposal_is_not_centred_on_the_particle_that_it_moves() -> None:
    """Fitted to it, each sweep makes the variance 1.3 from an exact draw (1.19 for forty copies)."""
    torch.manual_seed(0)
    squares = []
    for _ in range(800):
        drawn, _ = generate(standard, (), {}, 1)
        for copies in (1, 3):
            population = Population(drawn[torch.zeros(copies, dtype=torch.int64)])
            moved = moved_by(population, KERNEL, POSTERIOR).population
            squares.append(float(moved.trace["x"][0]) ** 2)
    mean = torch.tensor(squares).view(-1, 2).mean(dim=0)
    assert (abs(mean - 1.0) < 4.0 * (2.0 / 800) ** 0.5).all()  # 0.2
