"""Candidates whose simulation fails under some outer samples."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.inference.design import expected_information_gain
from bcppl.inference.population import Population
from bcppl.traces import simulate


class OneSided(dist.Normal):
    """A simulation that fails for half of what it draws."""

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.where(value > 0.0, -torch.inf, super().log_prob(value))


@pytest.mark.filterwarnings("ignore:the expected information gain of candidate 0 leaves out")
def test_a_second_step_is_paid_where_the_first_was_simulated() -> None:
    def program(actions: tuple[str, ...]) -> None:
        x = pyro.sample("x", dist.Normal(torch.zeros((), dtype=torch.float64), 1.0))
        for k, action in enumerate(actions):
            site = OneSided(0.0 * x, 1.0) if action == "fails" else dist.Normal(x, 0.1)
            pyro.sample(f"y_{k}", site)

    ranking = expected_information_gain(
        Population(simulate(program, ((),), 60)),
        ["fails", "informs"],
        lambda action: ((action,),),
        cost={"fails": 0.0, "informs": 0.5},
        horizon=2,
        seed=1,
    )
    first = ranking.of(0)
    made = ~torch.isnan(first.gains)
    assert first.second is not None and 0 < int(made.sum()) < 60
    assert bool((first.second[made] == 1).all()) and first.cost == pytest.approx(0.5)
