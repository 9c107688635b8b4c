"""Values at the edge of what their type can hold: moves that leave it are rejected, and give no NaN."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InferenceError
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import metropolis_hastings, moved_by
from bcppl.inference.population import Population
from bcppl.inference.proposals import Proposal, differential_evolution, drift, independent
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import simulate


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


SEEN = {"y": number(0.3)}


def extreme(prior: Any) -> Callable[[], None]:
    def program() -> None:
        x = pyro.sample("x", prior)
        pyro.sample("y", dist.Normal(x.double().clamp(max=1e10), 1.0))

    return program


PRIORS = {
    "Gamma(0.01)": dist.Gamma(torch.tensor(0.01), 1.0),
    "Gamma(0.01), double": dist.Gamma(number(0.01), number(1.0)),
    "LogNormal(0, 30)": dist.LogNormal(0.0, 30.0),
    "LogNormal(0, 400), double": dist.LogNormal(number(0.0), number(400.0)),
}
MOVES: dict[str, Proposal] = {
    "drift": drift("x"),
    "independent": independent("x", 2),
    "differences": differential_evolution("x"),
}


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("move", MOVES)
def test_values_that_run_out_of_their_type_are_rejected(prior: str, move: str) -> None:
    torch.manual_seed(1)
    start = importance_sampling(extreme(PRIORS[prior]), (), SEEN, 300)
    done = moved_by(start, metropolis_hastings(MOVES[move]), POSTERIOR, 5)
    before, after = start.trace["x"], done.population.trace["x"]
    assert done.acceptance > 0.1
    # No move leads to where nothing can be: only what was drawn there is there.
    impossible = done.population.trace.log_prob() == -torch.inf
    assert torch.equal(after[impossible], before[impossible])


def test_a_walk_near_the_edge_leaves_what_its_type_can_hold_invariant() -> None:
    """Single precision ends at exp(-103) and exp(89): the target is the prior of the numbers between."""

    def wide() -> None:
        pyro.sample("x", dist.LogNormal(torch.tensor(0.0), torch.tensor(50.0)))

    torch.manual_seed(2)
    drawn = (50.0 * torch.randn(40_000, dtype=torch.float64)).exp().to(torch.float32)
    drawn = drawn[(drawn > 0.0) & torch.isfinite(drawn)]
    assert len(drawn) < 39_000
    trace = simulate(wide, (), len(drawn)).at({"x": drawn})
    move = metropolis_hastings(drift("x", (0.5, 1.5)))(Population(trace[:300], torch.zeros(300)))
    for _ in range(3):
        trace, accepted = move(trace, POSTERIOR)
    change = trace["x"].double().log() - drawn.double().log()
    larger = trace["x"].double().log().abs() - drawn.double().log().abs()
    for each in (change, larger):
        assert abs(float(each.mean())) < 4.5 * float(each.std()) / math.sqrt(len(each))
    assert 0.2 < float(accepted.mean()) < 0.9


def test_a_prior_whose_draws_are_all_out_of_range_is_refused() -> None:
    start = importance_sampling(extreme(dist.LogNormal(0.0, 1e6)), (), SEEN, 50)
    with pytest.raises(InferenceError, match="no proposal can be fitted at 'x'"):
        drift("x").fit(start)
    close = importance_sampling(extreme(dist.Beta(torch.tensor(0.01), torch.tensor(0.01))), (), SEEN, 200)
    with pytest.raises(InferenceError, match=r"rounding to torch.float32 put values on the edge"):
        moved_by(close, metropolis_hastings(drift("x")), POSTERIOR)
