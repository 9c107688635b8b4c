"""Angles: a periodic density is one on a turn, and values stay there."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy import special
from torch import Tensor

from bcppl.distributions.support import support_of
from bcppl.inference import importance_sampling, rejuvenate
from bcppl.inference.kernels import Kernel, hmc, metropolis_hastings
from bcppl.inference.proposals import drift, independent
from bcppl.traces import assess, check_program, generate
from tests.invariance import number


def opposite() -> None:
    pyro.sample("angle", dist.VonMises(number(torch.pi), number(2.0)))


KERNELS: dict[str, Kernel] = {
    "independent": metropolis_hastings(independent("angle")),
    "drift": metropolis_hastings(drift("angle")),
    "hmc": hmc("angle"),
}


@pytest.mark.long
@pytest.mark.parametrize("name", KERNELS)
def test_a_prior_across_the_cut_is_left_invariant(name: str) -> None:
    cosines = []
    for seed in range(5):
        torch.manual_seed(seed)
        population = importance_sampling(opposite, (), {}, 500)
        moved = rejuvenate(population, KERNELS[name], sweeps=10)
        assert float(moved["angle"].abs().max()) <= math.pi
        cosines.append(moved["angle"].cos().mean())
    runs = torch.stack(cosines)
    exact = -special.i1(2.0) / special.i0(2.0)
    assert abs(float(runs.mean()) - exact) < 4.0 * float(runs.std()) / math.sqrt(5) + 0.01


def pairs() -> dist.TorchDistribution:
    one = number(1.0)
    return dist.SineBivariateVonMises(0.0 * one, 0.0 * one, one, one, 0.5 * one)


def mixed() -> dist.TorchDistribution:
    each = dist.VonMises(torch.tensor([0.0, 2.0]).double(), 3.0)
    return dist.MixtureSameFamily(dist.Categorical(torch.tensor([0.5, 0.5])), each)


@pytest.mark.parametrize(
    "distribution",
    [
        dist.VonMises(number(0.0), 1.0),
        dist.VonMises(torch.zeros(2).double(), 1.0).to_event(1),
        dist.VonMises(number(0.0), 1.0).expand([3]).mask(torch.tensor(True)),
        pairs(),
        mixed(),
    ],
    ids=["one", "event", "masked", "pairs", "mixed"],
)
def test_the_support_of_angles_is_one_turn(distribution: dist.TorchDistribution) -> None:
    support = support_of(distribution)
    assert (support.lower_bound, support.upper_bound) == (-math.pi, math.pi)


def test_a_latent_angle_is_of_one_turn_and_an_observed_one_of_any() -> None:
    def program() -> None:
        angle = pyro.sample("angle", dist.VonMises(number(0.0), 1.0))
        pyro.sample("seen", dist.VonMises(angle, 3.0))

    def at(angle: float, seen: float) -> Tensor:
        return generate(program, (), {"seen": seen}, 1, {"angle": number(angle)})[1]

    torch.testing.assert_close(at(1.0, 5.0), at(1.0, 5.0 - 2.0 * math.pi))
    assert float(at(1.0 + 2.0 * math.pi, 5.0)) == -math.inf
    beyond = {"angle": number(1.0 + 2.0 * math.pi), "seen": number(0.0)}
    assert float(assess(program, (), beyond, 1)) == -math.inf
    check_program(program, (), {"seen": 5.0})
