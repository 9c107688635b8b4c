"""`check_kernel` passes every shipped kernel and finds kernels that are wrong in one way each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference import check_kernel
from bcppl.inference.calibration import KernelError
from bcppl.inference.kernels import (
    Kernel,
    cycle,
    delayed_acceptance,
    hmc,
    involutive,
    metropolis_hastings,
    mixture,
    repeat,
    sequence,
)
from bcppl.inference.kernels.kernel import decided
from bcppl.inference.learning import adaptive_hmc
from bcppl.inference.population import Population
from bcppl.inference.proposals import (
    differential_evolution,
    drift,
    independent,
    joint_drift,
    prior,
    spread_of,
)
from bcppl.inference.targets import Target
from bcppl.traces import Trace, propose, update
from tests.invariance import number


def program() -> None:
    """A mean, a precision and a fault behind four readings, and a pose of which the place is read."""
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    rate = pyro.sample("rate", dist.Gamma(number(3.0), number(2.0)))
    bad = pyro.sample("bad", dist.Bernoulli(number(0.3)))
    part = pyro.sample("part", NormalPose(poses.identity(), torch.full((6,), 0.5).double()))
    with pyro.plate("readings", 4):
        pyro.sample("y", dist.Normal(x, torch.where(bad == 1, 1.0, 0.4) / rate.sqrt()))
    pyro.sample("z", dist.Normal(part[..., :3], 0.3).to_event(1))


def near(trace: Trace) -> None:
    pyro.sample("x", dist.Normal(trace["x"], 0.5))


def leaning(trace: Trace) -> None:
    pyro.sample("x", dist.Normal(0.8 * trace["x"], 0.5))


def by_spread(trace: Trace, covariance: Tensor) -> None:
    pyro.sample("x", dist.Normal(trace["x"], covariance[0, 0].sqrt()))


def factor(trace: Trace) -> None:
    pyro.sample("log", dist.Normal(torch.zeros(len(trace), dtype=torch.float64), 0.5))


Values = Mapping[str, Tensor]


def stretch(values: Values, choices: Values) -> tuple[Values, Values]:
    return {"rate": values["rate"] * choices["log"].exp()}, {"log": -choices["log"]}


def by_hand(log_ratio: Callable[[Tensor], Tensor]) -> Kernel:
    """The rate times exp(s), s normal, with a log-ratio of s: s itself is the Jacobian."""

    def kernel(population: Population) -> Any:
        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            step = 0.5 * torch.randn(len(trace), dtype=torch.float64)
            new = update(trace, {"rate": trace["rate"] * step.exp()}).trace
            return decided(target, trace, new, log_ratio(step))

        return move

    return kernel


walk = metropolis_hastings(near)
RIGHT: dict[str, Kernel] = {
    "proposal": walk,
    "leaning": metropolis_hastings(leaning),
    "learned": metropolis_hastings(by_spread, spread_of("x")),
    "drift": metropolis_hastings(drift("rate")),
    "drift of a pose": metropolis_hastings(drift("part")),
    "joint drift": metropolis_hastings(joint_drift("x", "rate")),
    "prior": metropolis_hastings(prior("bad")),
    "independent": metropolis_hastings(independent("x")),
    "independent pose": metropolis_hastings(independent("part")),
    "differences": metropolis_hastings(differential_evolution("part")),
    "hmc": hmc("x", "rate"),
    "adaptive hmc": adaptive_hmc("x", "rate"),
    "involution": involutive(factor, stretch),
    "delayed": delayed_acceptance(walk, first="y"),
    "mixture": mixture([walk, metropolis_hastings(drift("part"))], weights=[0.3, 0.7]),
    "cycle": cycle(walk, hmc("rate")),
    "sequence": sequence(repeat(walk, 2), metropolis_hastings(prior("bad"))),
    "Jacobian by hand": by_hand(lambda step: step),
}


@pytest.mark.long
@pytest.mark.parametrize("name", RIGHT)
def test_a_right_kernel_passes(name: str) -> None:
    state = torch.get_rng_state()
    found = check_kernel(RIGHT[name], program, (), ["y", "z"])
    assert found.p_value > 1e-4 and 0.02 < found.acceptance < 1.0
    assert torch.equal(state, torch.get_rng_state())


def to_the_mean(trace: Trace) -> None:
    pyro.sample("x", dist.Normal(trace["x"].mean(), 0.5))


def as_wide_as_they_are(trace: Trace) -> None:
    pyro.sample("x", dist.Normal(trace["x"], trace["x"].std()))


def to_the_best(trace: Trace) -> None:
    best = trace.log_prob().argmax()
    pyro.sample("x", dist.Normal(trace["x"][best].expand(len(trace)), 0.5))


def to_the_mean_place(trace: Trace) -> None:
    place = trace["part"].clone()
    place[:, :3] = 0.9 * place[:, :3] + 0.1 * place[:, :3].mean(dim=0)
    pyro.sample("part", NormalPose(place, torch.full((6,), 0.2).double()))


def counting() -> Callable[[Trace], None]:
    calls = [0]

    def propose_wider(trace: Trace) -> None:
        calls[0] += 1
        pyro.sample("x", dist.Normal(trace["x"], 0.2 * calls[0]))

    return propose_wider


def with_its_own_generator() -> Callable[[Trace], None]:
    generator = np.random.default_rng(0)

    def propose_scaled(trace: Trace) -> None:
        pyro.sample("x", dist.Normal(trace["x"], generator.uniform(0.1, 1.0)))

    return propose_scaled


def forgetful(population: Population) -> Any:
    """Metropolis-Hastings without the densities of the proposal."""

    def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
        new = update(trace, propose(leaning, (trace,), len(trace)).choices).trace
        return decided(target, trace, new, torch.zeros(len(trace), dtype=torch.float64))

    return move


def moving_data(population: Population) -> Any:
    def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
        return update(trace, {"y": trace["y"] + 0.1}).trace, torch.ones(len(trace), dtype=torch.float64)

    return move


def still(population: Population) -> Any:
    return lambda trace, target: (trace, torch.zeros(len(trace), dtype=torch.float64))


WRONG: dict[str, tuple[Kernel, str]] = {
    "mean": (metropolis_hastings(to_the_mean), "other particles"),
    "spread": (metropolis_hastings(as_wide_as_they_are), "other particles"),
    "best": (metropolis_hastings(to_the_best), "other particles"),
    "mean of poses": (metropolis_hastings(to_the_mean_place), "other particles"),
    "counter": (metropolis_hastings(counting()), "same random numbers"),
    "own generator": (metropolis_hastings(with_its_own_generator()), "same random numbers"),
    "reverse density": (forgetful, "standard errors"),
    "Jacobian": (by_hand(torch.zeros_like), "standard errors"),
    "sign of the Jacobian": (by_hand(torch.neg), "standard errors"),
    "data": (moving_data, "moves 'y', which is observed"),
    "nothing": (still, "moves no particle"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_kernel_is_found(name: str) -> None:
    kernel, says = WRONG[name]
    with pytest.raises(KernelError, match=says):
        check_kernel(kernel, program, (), ["y", "z"])


def test_single_precision_and_heavy_tails_do_no_harm() -> None:
    def single() -> None:
        x = pyro.sample("x", dist.Normal(0.0, 1.0))
        pyro.sample("y", dist.Cauchy(x, 0.5))

    assert check_kernel(walk, single, (), ["y"]).p_value > 1e-4
    with pytest.raises(KernelError, match="other particles"):
        check_kernel(metropolis_hastings(to_the_mean), single, (), ["y"])


def test_what_cannot_be_checked_is_refused() -> None:
    with pytest.raises(InputError, match="never visits"):
        check_kernel(walk, program, (), ["reading"])
    with pytest.raises(InputError, match="10 draws"):
        check_kernel(walk, program, (), ["y"], draws=10)
    with pytest.raises(InputError, match="in place of a kernel"):
        check_kernel(drift("x"), program, (), ["y"])  # type: ignore[arg-type]


def test_another_seed_is_a_second_opinion() -> None:
    def asked(seed: int) -> float:
        return check_kernel(metropolis_hastings(near), program, (), ["y"], draws=300, seed=seed).acceptance

    state = torch.get_rng_state()
    assert asked(0) == asked(0) != asked(1)
    assert torch.equal(state, torch.get_rng_state())
