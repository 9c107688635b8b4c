"""A latent site that is masked is refused on every path; the padded program gives the exact answer."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl.distributions.switch import Switch
from bcppl.inference import importance_sampling, markov_chains
from bcppl.inference.kernels import metropolis_hastings, sequence
from bcppl.inference.proposals import drift
from bcppl.inference.summaries import mean
from bcppl.traces import (
    Fault,
    ProgramError,
    Series,
    Trace,
    assess,
    extend,
    generate,
    propose,
    regenerate,
    simulate,
    update,
)
from tests.invariance import number
from tests.small_programs import normal_log

N = 6


def off(distribution: Any) -> Any:
    return distribution.mask(torch.tensor(False))


def standard(*shape: int) -> Any:
    return dist.Normal(torch.zeros(shape, dtype=torch.float64), 1.0)


MASKED: dict[str, Callable[[], Any]] = {
    "itself": lambda: off(standard()),
    "for some particles": lambda: standard(N).mask(torch.arange(N) > 0),
    "in an event": lambda: off(standard(2)).to_event(1),
    "part of an event": lambda: standard(2).mask(torch.tensor([True, False])).to_event(1),
    "expanded": lambda: off(standard()).expand([N]),
    "transformed": lambda: dist.TransformedDistribution(off(standard()), [dist.transforms.ExpTransform()]),
    "in a mixture": lambda: dist.MixtureSameFamily(
        dist.Categorical(torch.ones(2, dtype=torch.float64)), off(standard(2))
    ),
    "chosen": lambda: Switch(torch.arange(N) % 2, lambda k, rows: off(standard(len(rows)))),
}


def program_of(distribution: Callable[[], Any]) -> Callable[[], None]:
    def program() -> None:
        x = pyro.sample("x", distribution())
        pyro.sample("y", dist.Normal(x.reshape(-1, N).sum(0), number(1.0)))

    return program


@pytest.mark.parametrize("case", MASKED)
def test_a_masked_latent_site_is_refused_however_it_is_wrapped(case: str) -> None:
    torch.manual_seed(0)
    with pytest.raises(ProgramError, match="'x' is latent and its distribution is masked") as caught:
        generate(program_of(MASKED[case]), (), {"y": 0.3}, N)
    assert caught.value.fault is Fault.MASKED and caught.value.site == "x"


def switched(masked: bool, always: bool = False) -> Callable[[], None]:
    """A peg slips with an even chance; a latent shift counts if it does: masked elsewhere, or ignored."""

    def program() -> None:
        slipped = pyro.sample("slipped", dist.Bernoulli(number(0.5)))
        prior = dist.Normal(number(0.0), 2.0)
        shift = pyro.sample("shift", prior.mask((slipped == 1) | always) if masked else prior)
        pyro.sample("y", dist.Normal(torch.where(slipped == 1, shift, 0.0), 0.6))

    return program


SEEN = 1.0718


def exact() -> float:
    moved, still = (float(normal_log(number(SEEN), 0.0, s).exp()) for s in (math.hypot(2.0, 0.6), 0.6))
    return moved / (moved + still)


def start() -> Trace:
    """Of a program that masks nothing at first: its argument decides."""
    trace, _ = generate(by_argument, (False,), {"y": SEEN}, N)
    return trace


def by_argument(masked: bool) -> None:
    switched(masked, always=False)()


WALK = Series(lambda: pyro.sample("x", standard()), lambda x: pyro.sample("x", off(dist.Normal(x, 1.0))))

PATHS: dict[str, Callable[[], Any]] = {
    "assess": lambda: assess(switched(True), (), simulate(switched(True), (), N).choices, N),
    "propose": lambda: propose(switched(True), (), N),
    "log_prob of a simulated trace": lambda: simulate(switched(True), (), N).log_prob(),
    "importance_sampling": lambda: importance_sampling(switched(True), (), {"y": SEEN}, N),
    "update of arguments": lambda: update(start(), args=(True,)),
    "update of values": lambda: update(simulate(switched(True), (), N), {"shift": torch.zeros(N).double()}),
    "regenerate": lambda: regenerate(simulate(switched(True), (), N), "shift"),
    "extend": lambda: extend(start(), (True,), {}),
    "markov_chains": lambda: markov_chains(
        metropolis_hastings(drift("shift")), simulate(switched(True), (), N), 1, progress=False
    ),
    "a step of a series": lambda: extend(generate(WALK, (), {}, N)[0], (), {}),
    "a simulated step": lambda: extend(simulate(WALK, (), N), (), {}),
}


@pytest.mark.parametrize("path", PATHS)
def test_no_path_takes_a_masked_latent(path: str) -> None:
    torch.manual_seed(0)
    with pytest.raises(ProgramError, match=r"masked, .*for every particle.*`torch.where`"):
        PATHS[path]()


def test_a_mask_that_masks_nothing_passes() -> None:
    torch.manual_seed(0)
    masked = assess(switched(True, always=True), (), values := simulate(switched(False), (), N).choices, N)
    torch.testing.assert_close(masked, assess(switched(False), (), values, N), rtol=0, atol=0)


def test_the_padded_program_gives_the_exact_answer_by_weights_and_by_moves() -> None:
    """A masked one gave .024 for .554: a shift that costs nothing where it is masked drifts away."""
    torch.manual_seed(0)
    assert abs(exact() - 0.554) < 1e-3
    weighted = importance_sampling(switched(False), (), {"y": SEEN}, 20_000)
    assert abs(float(mean(weighted, "slipped")) - exact()) < 4.0 * 0.005
    kernel = sequence([metropolis_hastings(drift("shift")), metropolis_hastings(flip)])
    chains = markov_chains(kernel, weighted[:2000], 60, progress=False, scheme=None)
    assert abs(float(chains.draws["slipped"][20:].mean()) - exact()) < 0.02
    assert 0.5 < float(chains.trace["shift"].std()) < 3.0


def flip(trace: Trace) -> None:
    pyro.sample("slipped", dist.Bernoulli(number(0.5)))
