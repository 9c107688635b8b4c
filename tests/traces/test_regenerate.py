"""Values regenerated from the program: in its order, and as moves that leave the posterior invariant."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.traces import generate, regenerate, simulate, update


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


N = 5


def test_later_addresses_are_regenerated_given_the_earlier_ones_new_values() -> None:
    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 100.0))
        y = pyro.sample("y", dist.Normal(x, 0.01))
        pyro.sample("w", dist.Normal(y, 0.01))

    drawn = regenerate(simulate(program, (), N), {"w", "y", "x"}).trace
    assert float((drawn["y"] - drawn["x"]).abs().max()) < 0.1
    assert float((drawn["w"] - drawn["y"]).abs().max()) < 0.1


@pytest.mark.parametrize("mutant", ["", "sign", "own", "never"])
def test_moves_by_regeneration_leave_the_posterior_as_it_is(mutant: str) -> None:
    """From exact draws of x given y = 1 (prior N(0, 1), noise 1: N(1/2, 1/2)), after moves, exact moments."""
    torch.manual_seed(1)
    count = 20000

    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("y", dist.Normal(x, 1.0))

    trace, _ = generate(program, (), {"y": number(1.0)}, count)
    trace = trace.at({"x": 0.5 + math.sqrt(0.5) * torch.randn(count, dtype=torch.float64)})
    for _ in range(4):
        drawn = regenerate(trace, "x")
        ratio = drawn.log_weight
        if mutant == "sign":
            ratio = -ratio
        elif mutant == "own":  # the regenerated site's own prior forgotten to cancel
            ratio = update(trace, drawn.trace.choices).log_ratio
        elif mutant == "never":  # always accepted
            ratio = torch.zeros(count, dtype=torch.float64)
        accepted = torch.rand(count, dtype=torch.float64).log() < ratio
        trace = drawn.trace.where(accepted, trace)
    z_mean = float((trace["x"].mean() - 0.5) / math.sqrt(0.5 / count))
    z_square = float((((trace["x"] - 0.5) ** 2).mean() - 0.5) / (0.5 * math.sqrt(2 / count)))
    worst = max(abs(z_mean), abs(z_square))
    assert worst > 8 if mutant else worst < 3.5, worst


def test_what_is_impossible_before_and_after_stays_so() -> None:
    """No particle's ratio is -inf minus -inf, as it is not of an update."""

    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("y", dist.Uniform(x.detach() + 10.0, x.detach() + 11.0, validate_args=False))

    trace, _ = generate(program, (), {"y": number(0.0)}, N)
    assert bool((regenerate(trace, "x").log_weight == -torch.inf).all())
