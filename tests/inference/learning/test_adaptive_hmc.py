"""Adaptive HMC: invariance, also where it learns from few particles or copies; what it learns is right."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import markov_chains, rejuvenate
from bcppl.inference.kernels import hamiltonian
from bcppl.inference.learning import hmc_adaptation as room
from bcppl.inference.learning.hmc_adaptation import adaptive_hmc, learned_factor, tuned
from bcppl.inference.learning.mass import fisher_covariance
from bcppl.inference.population import Population
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Trace, generate, simulate
from tests.inference.kernels.exact_targets import COVARIANCE, SEEN, bounded, correlated, correlated_draws
from tests.invariance import largest_z, number

SOUND, BROKEN = 4.5, 8.0
BOUNDED = ("top", "shares", "each")


def moments(trace: Trace, *addresses: str) -> Tensor:
    x = torch.cat([trace[a].reshape(len(trace), -1).double() for a in addresses], dim=1)
    return torch.cat([x, (x[:, :, None] * x[:, None, :]).flatten(1), torch.sin(2 * x)], dim=1)


def worst_z(learned: Population, draws: Trace, *addresses: str, target: Any = POSTERIOR) -> float:
    move = adaptive_hmc(*addresses)(learned)
    before, trace = moments(draws, *addresses), draws
    for _ in range(2):
        trace, accepted = move(trace, target)
        assert 0.2 < float(accepted.mean()) <= 1.0
    return largest_z(before, moments(trace, *addresses))


def test_it_leaves_the_target_invariant_whatever_it_learns_from() -> None:
    torch.manual_seed(0)
    draws = correlated_draws(6000)
    few = Population(correlated_draws(2))
    copies = Population(correlated_draws(8)[torch.arange(200) % 8])
    off = correlated_draws(300)
    weighted = Population(off, 2.0 * off["x"][:, 0])
    for learned in (Population(correlated_draws(300)), few, copies, weighted):
        assert worst_z(learned, draws, "x") < SOUND
    lone = Population(correlated_draws(1))
    move = adaptive_hmc("x")(lone)
    assert largest_z(moments(draws, "x"), moments(move(draws, POSTERIOR)[0], "x")) < SOUND


def test_bounded_supports_and_tempered_targets() -> None:
    torch.manual_seed(1)

    def program() -> None:
        top = pyro.sample("top", dist.Gamma(number(2.0), number(1.5)))
        pyro.sample("shares", dist.Dirichlet(torch.tensor([2.0, 0.7, 1.5]).double()))
        with pyro.plate("rows", 3, dim=-2):
            pyro.sample("each", dist.Beta(top, number(1.5)).expand([3, *top.shape]))

    assert worst_z(Population(simulate(program, (), 300)), simulate(program, (), 6000), *BOUNDED) < SOUND
    assert bounded is not program
    half = Target({"y": 0.5})
    posterior = torch.linalg.inv(torch.linalg.inv(COVARIANCE) + torch.eye(3).double() / 0.98)
    exact = torch.distributions.MultivariateNormal(posterior @ SEEN / 0.98, posterior)
    draws = correlated_draws(6000).at({"x": exact.sample((6000,))})
    learned = Population(correlated_draws(300))
    assert worst_z(learned, draws, "x", target=half) < SOUND
    assert worst_z(learned, draws, "x", target=POSTERIOR) > BROKEN


def test_one_fitted_move_is_tuned_to_each_target_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(2)
    calls, sound = [], room.tuned
    monkeypatch.setattr(room, "tuned", lambda *a, **k: calls.append(a[2]) or sound(*a, **k))
    draws = correlated_draws(200)
    move, half = adaptive_hmc("x")(Population(draws)), Target({"y": 0.5})
    for target in (POSTERIOR, half, POSTERIOR, Target({"y": 0.5})):
        move(draws, target)
    assert calls == [POSTERIOR, half]


def test_mutant_that_learns_from_each_particle_that_it_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step size that depends on the particle's own place is not undone on the way back."""
    torch.manual_seed(0)
    draws = correlated_draws(6000)
    sound = hamiltonian.leapfrog

    def own_size(gradient: Any, position: Tensor, momentum: Tensor, size: Tensor, *rest: Any) -> Any:
        return sound(gradient, position, momentum, size * position[:, :1].abs().clamp(0.1, 1.5), *rest)

    monkeypatch.setattr(hamiltonian, "leapfrog", own_size)
    assert worst_z(Population(correlated_draws(300)), draws, "x") > BROKEN


# ---- what is learned


def normal(covariance: Tensor) -> Any:
    def program() -> None:
        center = torch.zeros(len(covariance), dtype=torch.float64)
        pyro.sample("x", dist.MultivariateNormal(center, covariance))

    return program


def uneven(dimension: int) -> Tensor:
    """Standard deviations over six decades and a correlation of 0.9 of neighbours."""
    spread = torch.logspace(-3, 3, dimension, dtype=torch.float64)
    order = torch.arange(dimension, dtype=torch.float64)
    return spread[:, None] * spread * 0.9 ** (order[:, None] - order).abs()


@pytest.mark.parametrize(("particles", "condition"), [(100, 1.6), (40, 10.0), (15, 1e3)])
def test_the_mass_is_that_of_a_normal_from_few_particles(particles: int, condition: float) -> None:
    """Its covariance alone would leave a condition number of about 200 with 40 particles in 30 axes."""
    torch.manual_seed(0)
    covariance = uneven(30)
    draws = Population(simulate(normal(covariance), (), particles))
    factor = learned_factor(("x",), draws, POSTERIOR)
    # The covariance in the coordinates in which the mass is 1.
    white = torch.linalg.solve_triangular(factor, torch.linalg.cholesky(covariance), upper=False)
    sizes = torch.linalg.svdvals(white).square()
    assert float(sizes[0] / sizes[-1]) < condition
    assert 0.3 < float(sizes.log().mean().exp()) < 3.0


def test_the_mass_solves_its_equation_and_has_the_units_of_the_particles() -> None:
    torch.manual_seed(0)
    position = torch.randn(4000, 3, dtype=torch.float64) @ torch.randn(3, 3, dtype=torch.float64)
    score = torch.sin(position) @ torch.randn(3, 3, dtype=torch.float64)
    weights = torch.rand(4000, dtype=torch.float64)
    weights = weights / weights.sum()
    mass = fisher_covariance(position, score, weights)
    spread, bend = ((weights[:, None] * (v - weights @ v)).T @ (v - weights @ v) for v in (position, score))
    torch.testing.assert_close(mass @ bend @ mass, spread, rtol=5e-3, atol=5e-3)
    unit = torch.tensor([1e-4, 1.0, 1e3], dtype=torch.float64)
    scaled = fisher_covariance(position * unit, score / unit, weights)
    torch.testing.assert_close(scaled, mass * unit[:, None] * unit)


def test_the_mass_without_scores_or_particles_that_differ() -> None:
    torch.manual_seed(0)
    position, weights = torch.randn(50, 3, dtype=torch.float64), torch.full((50,), 0.02).double()
    lost = position.clone()
    lost[::2] = torch.nan
    for score in (torch.zeros(50, 3).double(), lost, torch.full((50, 3), torch.inf).double()):
        assert bool(torch.isfinite(torch.linalg.cholesky(fisher_covariance(position, score, weights))).all())
    same = position[:1].expand(50, 3)
    assert bool(torch.isfinite(torch.linalg.cholesky(fisher_covariance(same, -same, weights))).all())


@pytest.mark.parametrize("dimension", [2, 50])
def test_it_is_accepted_as_often_as_wanted_and_turns_by_about_a_quarter(dimension: int) -> None:
    torch.manual_seed(0)
    program = normal(uneven(dimension))
    for wanted in (0.6, 0.9):
        learned, others = (simulate(program, (), 400) for _ in range(2))
        kernel = adaptive_hmc("x", acceptance=wanted, jitter=0.0)
        moved, accepted = kernel(Population(learned))(others, POSTERIOR)
        assert float(accepted.mean()) == pytest.approx(wanted, abs=0.2)
        factor = learned_factor(("x",), Population(learned), POSTERIOR)
        size, steps, *_ = tuned(learned, ("x",), POSTERIOR, factor, acceptance=wanted, most_steps=32)
        assert 0.7 < size * steps < 2.2
        both = [torch.linalg.solve_triangular(factor, t["x"].T, upper=False) for t in (others, moved)]
        # For an independent draw the squared jump is 2 in every coordinate, of the squares 4.
        jump = (both[1] - both[0]).square().mean()
        of_squares = (both[1].square() - both[0].square()).square().mean()
        assert float(jump) > 0.9 and float(of_squares) > 1.6


def test_mutant_whose_criterion_lets_trajectories_turn_by_a_half(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the jump of the coordinates alone, the length is nearer to pi than to pi / 2."""
    torch.manual_seed(0)
    sound = room._Flight.flown
    monkeypatch.setattr(
        room._Flight, "flown", lambda *args: [(chance, far, far) for chance, far, _ in sound(*args)]
    )
    learned = simulate(normal(uneven(50)), (), 400)
    factor = learned_factor(("x",), Population(learned), POSTERIOR)
    size, steps, *_ = tuned(learned, ("x",), POSTERIOR, factor, acceptance=0.95, most_steps=32)
    assert size * steps > 2.0


# ---- in programs of inference


@pytest.mark.long
def test_chains_warm_up_from_where_they_should_not_begin() -> None:
    torch.manual_seed(0)
    trace = generate(correlated, (), {"y": SEEN}, 100)[0]
    start = trace.at({"x": 10.0 + 3.0 * trace["x"]})
    chains = markov_chains(adaptive_hmc("x"), start, 100, warm_up=10)
    posterior = torch.linalg.inv(torch.linalg.inv(COVARIANCE) + torch.eye(3).double() / 0.49)
    x = chains.draws["x"].flatten(0, 1)
    error = (x.mean(0) - posterior @ SEEN / 0.49) / posterior.diagonal().sqrt()
    assert float(error.abs().max()) < 0.06
    torch.testing.assert_close(torch.cov(x.T), posterior, rtol=0.0, atol=0.03)
    assert 0.5 < float(chains.acceptance.mean()) < 0.95


def test_a_population_is_rejuvenated() -> None:
    torch.manual_seed(0)
    trace = correlated_draws(4000)
    moved = rejuvenate(Population(trace), adaptive_hmc("x"), sweeps=2)
    assert largest_z(moments(trace, "x"), moments(moved.trace, "x")) < SOUND
    assert math.isclose(moved.log_evidence, 0.0)


@pytest.mark.parametrize(
    "options",
    [{"acceptance": 1.0}, {"most_steps": 0}, {"pilots": 2.5}, {"jitter": -0.1}],
    ids=lambda options: next(iter(options)),
)
def test_what_is_out_of_range_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="adaptive_hmc"):
        adaptive_hmc("x", **options)
    with pytest.raises(InputError, match="no address"):
        adaptive_hmc()
