"""Where addresses are asked for, a word is one address: not its letters, nor what is a part of it."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl import generate, regenerate, simulate
from bcppl.errors import InputError
from bcppl.inference import Population
from bcppl.inference.annealing import replica_exchange
from bcppl.inference.calibration import Joint, check_kernel
from bcppl.inference.chains import markov_chains
from bcppl.inference.criticism import surprise
from bcppl.inference.kernels import metropolis_hastings, until
from bcppl.inference.learning import forward_kl
from bcppl.inference.proposals import drift


def weighed() -> None:
    m = pyro.sample("m", dist.Normal(0.0, 1.0))
    mass = pyro.sample("mass", dist.Normal(m, 1.0))
    pyro.sample("reading", dist.Normal(mass, 1.0))


SEEN = {"reading": torch.tensor(0.5)}
WALK = metropolis_hastings(drift("mass"))


def test_a_word_is_one_address() -> None:
    trace, _ = generate(weighed, (), SEEN, 12)
    population = Population(trace)
    assert list(markov_chains(WALK, trace, 2, addresses="mass", progress=False).draws) == ["mass"]
    assert list(
        replica_exchange(WALK, trace, 2, [0.0, 1.0], addresses="mass", progress=False).chains.draws
    ) == ["mass"]
    assert list(surprise(population, "mass")) == ["mass"]
    assert list(regenerate(trace, "mass").discarded) == ["mass"]
    assert until(displacement=0.5, of="mass").of == ("mass",)
    assert Joint(weighed, (), "reading").observed == ("reading",)
    check_kernel(WALK, weighed, (), "reading", draws=200)
    with pytest.raises(InputError, match="'mass'"):
        trace.hiding("mass").log_prob("mass")
    moved = population.with_trace(trace.at({"m": torch.zeros(12), "mass": torch.zeros(12)}))
    half = moved.with_trace(moved.trace.at({"m": torch.arange(12.0)}))
    assert half.distinct_in("mass") == 1 and half.distinct_in(["m", "mass"]) == 12


def test_a_proposal_learns_from_one_address() -> None:
    class Guide(torch.nn.Module):
        def guide(self, seen: dict[str, torch.Tensor]) -> None:
            pyro.sample("mass", dist.Normal(0.5 * seen["reading"], 1.0))

    torch.manual_seed(0)
    one = forward_kl(Guide(), weighed, (), "reading", batch=8)  # type: ignore[arg-type]
    listed = forward_kl(Guide(), weighed, (), ["reading"], batch=8)  # type: ignore[arg-type]
    torch.manual_seed(1)
    first = one()
    torch.manual_seed(1)
    assert torch.equal(first, listed()) and "mass" in simulate(weighed, (), 2).choices
