"""By how much moves shift particles: little where these are draws of the target, and much elsewhere."""

from __future__ import annotations

from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.kernels.rejuvenation import moved_by, shift
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import generate

WALK = metropolis_hastings(drift("x"))


def normal() -> None:
    pyro.sample("x", dist.Normal(torch.zeros(3, dtype=torch.float64), 1.0).to_event(1))


def shifted(values: Any, sweeps: int = 10) -> float:
    population = Population(generate(normal, (), {}, len(values), {"x": values})[0]).reweighed(
        torch.zeros(len(values), dtype=torch.float64)
    )
    return shift(population, moved_by(population, WALK, POSTERIOR, sweeps).population)


def test_draws_of_the_target_are_not_shifted_and_others_are() -> None:
    torch.manual_seed(0)
    draws = torch.randn(12, 400, 3, dtype=torch.float64)
    copies = draws[:, :80].repeat_interleave(5, dim=1)
    assert max(shifted(each) for each in draws) < 4.0
    assert max(shifted(each) for each in copies) < 4.0
    for wrong in (0.5 * draws, 2.0 * draws, draws + torch.tensor([0.0, 1.0, 0.0])):
        assert min(shifted(each) for each in wrong) > 4.5


@pytest.mark.parametrize("particles", [1, 20])
def test_of_copies_of_one_particle_nothing_is_known(particles: int) -> None:
    torch.manual_seed(0)
    assert shifted(torch.full((particles, 3), 0.3, dtype=torch.float64)) == 0.0
