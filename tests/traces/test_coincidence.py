"""Shapes that fit N particles by coincidence alone are refused: one particle more shows it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.traces import assess, extend, generate, simulate
from tests.invariance import number
from tests.small_programs import Felt, beside_the_plate, first_entry, line

N = 5


DATA = torch.linspace(-1, 1, N, dtype=torch.float64)
BY_COINCIDENCE: dict[str, Callable[[], Any]] = {
    "simulate": lambda: simulate(line, (DATA,), N),
    "generate": lambda: generate(line, (DATA,), {"y": DATA}, N),
    "assess": lambda: assess(line, (DATA,), {"slope": DATA, "y": DATA}, N),
    "extend": lambda: extend(simulate(lengthened, (False,), N), (True,), {"y": DATA}),
    "first site": lambda: simulate(beside_the_plate, (), 3),
    "entry of a vector": lambda: simulate(first_entry, (), 3),
}


def lengthened(on: bool) -> None:
    if on:
        line(DATA)
    else:
        pyro.sample("slope", dist.Normal(number(0.0), 1.0))


@pytest.mark.parametrize("case", BY_COINCIDENCE)
def test_shapes_that_fit_by_coincidence_are_refused(case: str) -> None:
    with pytest.raises(InputError, match=r"coincidence alone; with one more, .*`\[:, ") as caught:
        BY_COINCIDENCE[case]()
    assert ". " not in str(caught.value)


def test_one_more_particle_runs_no_simulator_and_draws_nothing() -> None:
    sampled, ran = [], []

    class Counted(Felt):
        cost = 2

        def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
            sampled.append(len(self.x))
            return super().sample(sample_shape)

    def program(data: Tensor) -> None:
        ran.append(1)
        torch.rand(1)
        line(data)
        pyro.sample("felt", Counted(pyro.sample("x", dist.Normal(number(0.0), 1.0))))

    states = []
    for count, runs in ((N, 2), (N + 1, 1)):
        ran.clear(), sampled.clear(), torch.manual_seed(3)  # type: ignore[func-returns-value]
        trace = simulate(program, (DATA[:, None],), count)
        assert len(ran) == runs and sampled == [count] and trace["y"].shape == (count, N)
        torch.manual_seed(3)
        torch.rand(1), torch.randn(count, dtype=torch.float64), torch.randn(N, count, dtype=torch.float64)
        torch.randn(count, dtype=torch.float64)
        states.append(torch.rand(1))
        torch.manual_seed(3)
        simulate(program, (DATA[:, None],), count)
        assert torch.equal(torch.rand(1), states[-1]), "the generator stands where one run left it"
