"""A latent value counts however a likelihood, or the state of a simulator, reaches it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.inference.kernels import metropolis_hastings, moved_by
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Trace, assess, generate, regenerate, update
from tests.traces.dependent_programs import (
    GAPS,
    HELD,
    READS,
    SCALE,
    SEEN,
    STARTED,
    STARTS,
    N,
    Seen,
    State,
    holding,
    reading,
    simulating,
    simulating_plainly,
    switching,
    touched,
    touching,
)

CASES = [
    *(pytest.param(reading, kind, "shift", id=f"read by {kind}") for kind in READS),
    *(pytest.param(switching, kind, "shift", id=f"in a switch by {kind}") for kind in ("lambda", "object")),
    pytest.param(holding, "", "shift", id="attribute"),
    *(pytest.param(touching, kind, "grip_from_peg", id=f"gap by {kind}") for kind in GAPS),
    *(pytest.param(simulating, kind, "shift", id=f"state by {kind}") for kind in STARTS),
    *(pytest.param(simulating_plainly, kind, "shift", id=f"plainly by {kind}") for kind in STARTS),
]
Program = Callable[[str], Any]


def observed(program: Program) -> dict[str, Tensor]:
    return touched() if program is touching else SEEN


def made(program: Program, kind: str, particles: int = N) -> Trace:
    """A trace of which every log-probability is known."""
    torch.manual_seed(0)
    trace, _ = generate(program, (kind,), observed(program), particles)
    trace.log_prob()
    return trace


def density(trace: Trace) -> Tensor:
    """Of all sites, from nothing but the values."""
    choices = {**trace.choices, **trace.observations}
    return assess(trace.program, trace.args, choices, trace.particles)


def other_than(trace: Trace, address: str) -> Tensor:
    torch.manual_seed(1)
    value = trace[address]
    if value.ndim == 1:
        return value + torch.randn(len(value), dtype=torch.float64)
    return poses.retract(value, HELD * torch.randn(len(value), 6, dtype=torch.float64))


@pytest.mark.parametrize(("program", "kind", "address"), CASES)
def test_update_weighs_what_a_closure_depends_on(program: Program, kind: str, address: str) -> None:
    trace = made(program, kind)
    moved = update(trace, {address: other_than(trace, address)})
    expected = density(moved.trace) - density(trace)
    prior = moved.trace.log_prob(address) - trace.log_prob(address)
    assert float((expected - prior).abs().min()) > 1e-6, "the likelihood differs at the two values"
    torch.testing.assert_close(moved.log_ratio, expected)
    # And back, and of some particles alone.
    back = update(moved.trace, {address: trace[address]})
    torch.testing.assert_close(back.log_ratio, -expected)
    some = torch.tensor([7, 7, 0, 3])
    torch.testing.assert_close(
        update(trace[some], {address: moved.trace[address][some]}).log_ratio, expected[some]
    )


@pytest.mark.parametrize(("program", "kind", "address"), CASES)
def test_regenerate_weighs_what_a_closure_depends_on(program: Program, kind: str, address: str) -> None:
    trace = made(program, kind)
    drawn = regenerate(trace, address)
    prior = drawn.trace.log_prob(address) - trace.log_prob(address)
    torch.testing.assert_close(drawn.log_weight, density(drawn.trace) - density(trace) - prior)


@pytest.mark.parametrize(("program", "kind", "address"), CASES)
def test_metropolis_hastings_leaves_no_stale_density(program: Program, kind: str, address: str) -> None:
    """Some particles accept, others refuse: the trace's density is that of its values."""
    trace = made(program, kind)
    population = Population(trace)
    torch.manual_seed(2)
    moved, accepted = metropolis_hastings(drift(address, (0.2, 0.4)))(population)(trace, POSTERIOR)
    assert 0 < int(accepted.sum()) < N, "the test has to see both"
    torch.testing.assert_close(moved.log_prob(), density(moved))
    if isinstance(moved.result, State):
        assert torch.equal(moved.result.value, moved["x"] + moved["shift"])


@pytest.mark.parametrize(
    ("program", "kind"), [(reading, "lambda"), (reading, "object"), (simulating, "lambda")]
)
def test_metropolis_hastings_finds_the_posterior(program: Program, kind: str) -> None:
    """Of the shift given x, a normal that is known."""
    count = 200
    trace = made(program, kind, count)
    population = Population(trace)
    torch.manual_seed(3)
    moved = moved_by(population, metropolis_hastings(drift("shift", (0.05, 1.0))), POSTERIOR, 40)
    found, precision = moved.population.trace, 1.0 + SCALE**-2
    mean = (SEEN["seen"] - found["x"]) / SCALE**2 / precision
    standard = (found["shift"] - mean) * math.sqrt(precision)
    assert abs(float(standard.mean())) < 5.0 / math.sqrt(count) and 0.7 < float(standard.std()) < 1.4


def test_what_no_closure_reaches_is_not_weighed_again() -> None:
    for kind in READS:
        trace = made(reading, kind)
        before = Seen.evaluated
        update(trace, {"other": trace["other"] + 1.0}).log_ratio  # noqa: B018
        assert Seen.evaluated == before, kind


def test_what_no_closure_reaches_starts_nothing_again() -> None:
    for kind in STARTS:
        trace = made(simulating, kind)[torch.tensor([3, 3, 0, 8])]
        before = len(STARTED)
        update(trace, {"other": trace["other"] + 1.0}).log_ratio  # noqa: B018
        assert len(STARTED) == before, kind
