"""Chains that all start from one point learn no scale from it, and take that of the prior."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.inference import adaptive_hmc, markov_chains, tempered, tempered_importance_sampling
from bcppl.inference.kernels import Kernel, fitted, hmc, metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import differential_evolution, drift, independent, joint_drift, spread_of
from bcppl.inference.proposals.spread import weighted_places
from bcppl.traces import Series, extend, generate, simulate
from tests.invariance import number


def shifted() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    pyro.sample("y", dist.Normal(x, 1.0))


def scaled() -> None:
    """A rate and a position whose prior depends on it."""
    scale = pyro.sample("scale", dist.Gamma(number(4.0), 2.0))
    pyro.sample("x", dist.Normal(number(1.0), scale))


KERNELS: dict[str, Kernel] = {
    "drift": metropolis_hastings(drift("x")),
    "independent": metropolis_hastings(independent("x")),
    "a kernel density": metropolis_hastings(independent("x", None)),
    "hmc": hmc("x"),
    "adaptive hmc": adaptive_hmc("x"),
}


@pytest.mark.long
@pytest.mark.parametrize("particles", [1, 20])
@pytest.mark.parametrize("name", KERNELS)
def test_chains_from_one_point_reach_the_posterior(name: str, particles: int) -> None:
    torch.manual_seed(3)
    start, _ = generate(shifted, (), {"y": 0.0}, particles, {"x": number(0.1)})
    chains = markov_chains(KERNELS[name], start, 300 if particles == 1 else 40, progress=False)
    assert 0.55 < float(chains.draws["x"].std()) < 0.9  # exact: 0.707
    assert 0.2 < float(chains.acceptance.mean()) < 0.999


@pytest.mark.long
def test_a_tempered_particle_by_itself_moves() -> None:
    torch.manual_seed(0)
    step = tempered(metropolis_hastings(drift("x")), sweeps=15, always_move=True)
    values = torch.cat(
        [tempered_importance_sampling(shifted, (), {"y": 2.0}, 1, step).population["x"] for _ in range(40)]
    )
    assert abs(float(values.mean()) - 1.0) < 0.4 and 0.45 < float(values.std()) < 0.95


def test_the_scale_does_not_depend_on_where_the_particle_is() -> None:
    """A particle by itself is fitted to itself: with a scale of its own, its moves would not be invariant."""
    scales, states = [], torch.tensor([[0.1, 1.0], [9.0, -40.0]]).double()
    for scale, x in states:
        torch.manual_seed(1)
        trace, _ = generate(scaled, (), {}, 1, {"scale": scale, "x": x})
        scales.append(spread_of("x")(Population(trace)))
    assert torch.equal(*scales) and 1.0 < float(scales[0].sqrt()) < 3.0


def test_differences_of_equal_particles_are_noise_of_the_prior() -> None:
    torch.manual_seed(0)
    start, _ = generate(shifted, (), {"y": 0.0}, 20, {"x": number(0.1)})
    kernel = metropolis_hastings(differential_evolution("x", noise=0.5))
    chains = markov_chains(kernel, start, 60, progress=False)
    assert 0.5 < float(chains.draws["x"][20:].std()) < 0.95  # exact: 0.707


def test_joint_steps_leave_a_single_point() -> None:
    torch.manual_seed(0)
    point = {"scale": number(2.0), "x": number(0.1)}
    start, _ = generate(scaled, (), {}, 20, point)
    chains = markov_chains(metropolis_hastings(joint_drift("scale", "x")), start, 150, progress=False)
    assert abs(float(chains.draws["scale"][30:].mean()) - 2.0) < 0.3  # a gamma of mean 2 and deviation 1
    assert 0.7 < float(chains.draws["scale"][30:].std()) < 1.3


def test_the_scale_is_that_of_the_coordinates() -> None:
    torch.manual_seed(0)
    spread = torch.tensor([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]).double()

    def program() -> None:
        part = pyro.sample("part", NormalPose(poses.identity(), covariance=torch.diag(spread**2)))
        pyro.sample("rate", dist.LogNormal(part[..., 0], 0.5))
        pyro.sample("heavy", dist.Cauchy(number(0.0), 1.0))

    trace = simulate(program, (), 1)[torch.zeros(30, dtype=torch.int64)]
    population = Population(trace)
    root = spread_of("part")(population).diagonal().sqrt()
    assert bool(((root / spread).log().abs() < 0.2).all())
    log_rate = float(spread_of("rate")(population).sqrt())
    assert abs(math.log(log_rate / math.hypot(0.5, 0.1))) < 0.2
    assert 0.5 < float(spread_of("heavy")(population).sqrt()) < 5.0


def test_where_particles_differ_nothing_is_drawn() -> None:
    def along(first: Tensor) -> Tensor:
        trace, _ = generate(plane, (), {}, 2, {"x": torch.stack([first, number(2.0).expand(2)], dim=1)})
        return weighted_places(Population(trace), "x").unlearned

    def plane() -> None:
        pyro.sample("x", dist.Normal(torch.zeros(2).double(), torch.tensor([1.0, 10.0])).to_event(1))

    torch.manual_seed(0)
    unlearned = along(torch.tensor([1.0, 1.0 + 1e-9], dtype=torch.float64))
    assert float(unlearned[0]) == 0.0 and 7.0 < float(unlearned[1].sqrt()) < 13.0
    population, state = Population(simulate(shifted, (), 3)), torch.get_rng_state()
    fitted(hmc("x"), population)
    assert torch.equal(torch.get_rng_state(), state)


def test_a_step_of_a_series_has_the_scale_of_that_step() -> None:
    def onward(x: Tensor) -> Tensor:
        return pyro.sample("x", dist.Normal(0.5 * x, 3.0))

    series = Series(lambda: pyro.sample("x", dist.Normal(number(0.0), 1.0)), onward)
    torch.manual_seed(0)
    trace, _ = generate(series, (), {}, 1)
    longer, _ = extend(trace, (), {})
    assert 2.4 < float(spread_of("x")(Population(longer)).sqrt()) < 3.6
