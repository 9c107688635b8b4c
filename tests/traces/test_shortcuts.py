"""Densities and draws that cost less where there are many particles are the same densities and draws."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.traces import generate, simulate


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


@pytest.mark.parametrize("kind", [dist.Normal, dist.Laplace])
def test_a_shared_scale_gives_the_densities_of_one_for_each(kind: Any) -> None:
    count, scale = 2000, number(0.7)

    def program(each: bool) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        width = scale.expand(count).clone() if each else scale
        pyro.sample("y", kind(x, width))
        pyro.sample("z", kind(number(0.5), width))
        with pyro.plate("points", 3):
            pyro.sample("w", kind(x, width if each else torch.tensor([[0.7], [0.8], [0.9]]).double()))

    torch.manual_seed(0)
    shared, _ = generate(program, (False,), {"y": number(0.3)}, count)
    whole, _ = generate(program, (True,), {"y": number(0.3)}, count)
    whole = whole.at(shared.choices)
    for address in ("x", "y", "z"):
        torch.testing.assert_close(shared.log_prob(address), whole.log_prob(address))
    widths = torch.tensor([0.7, 0.8, 0.9], dtype=torch.float64)
    by_hand = kind(shared["x"][:, None], widths).log_prob(shared["w"]).sum(1)
    torch.testing.assert_close(shared.log_prob("w"), by_hand)


@pytest.mark.parametrize("mutant", ["", "variance", "shifted"])
def test_many_normals_are_drawn_as_normals(mutant: str) -> None:
    torch.manual_seed(5)
    count = 400_000
    means, widths = torch.linspace(-3, 3, count, dtype=torch.float64), number(0.7)
    for scale in (widths, widths * (1 + means**2)):
        trace = simulate(lambda s=scale: pyro.sample("x", dist.Normal(means, s)), (), count)
        draws = (trace["x"] - means) / scale
        draws = draws * 1.01 if mutant == "variance" else draws + 0.01 if mutant == "shifted" else draws
        assert bool(torch.isfinite(draws).all())
        # The distance of the distribution function from the normal's: Kolmogorov's 0.1 % point is 1.95.
        ranks = (torch.arange(count, dtype=torch.float64) + 0.5) / count
        away = float((torch.special.ndtr(draws.sort().values) - ranks).abs().max()) * math.sqrt(count)
        tail = float((draws.abs() > 4).sum()) - count * 2 * float(torch.special.ndtr(number(-4.0)))
        fourth = float(((draws**4).mean() - 3) / math.sqrt(96 / count))
        worst = max(away / 1.95, abs(tail) / 4 / math.sqrt(count * 6.3e-5), abs(fourth) / 4)
        assert worst > 1 if mutant else worst < 1, (away, tail, fourth)
