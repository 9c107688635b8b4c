"""Populations as ArviZ reads them: equal weight, right posterior, nothing lost on the way."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import UniformPose
from bcppl.errors import InputError
from bcppl.inference import arviz as export
from bcppl.inference.arviz import to_arviz
from bcppl.inference.chains import markov_chains
from bcppl.inference.filters.step import StepInfo, Stepped
from bcppl.inference.kernels import cycle, metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.repetitions import Repeated
from bcppl.traces import generate, simulate

arviz = export.import_arviz()
TURNED = poses.as_pose([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])


def number(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def program() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0)[0], 1.0))
    pyro.sample("which", dist.Categorical(number(0.2, 0.3, 0.5)))
    pyro.sample("hole", UniformPose(TURNED, 0.02, 0.2))
    pyro.sample("y", dist.Normal(x, 0.5))
    pyro.sample("z", dist.Normal(x[:, None].expand(-1, 3), 1.0).to_event(1))


SEEN = {"y": number(0.7)[0], "z": number(0.1, 0.2, 0.3)}


def weighted(particles: int, seed: int) -> Population:
    torch.manual_seed(seed)
    trace, log_weights = generate(program, (), SEEN, particles)
    log_evidence = float(torch.logsumexp(log_weights, 0)) - math.log(particles)
    return Population(trace, log_weights, log_evidence, torch.arange(particles) // 2)


def test_groups_shapes_and_names() -> None:
    populations = [weighted(200, 1), weighted(150, 2)]
    data = to_arviz(populations, draws=120)
    assert data.posterior.x.shape == (2, 120) and data.posterior.hole.dims == ("chain", "draw", "pose")
    assert list(data.posterior.coords["pose"].values) == ["x", "y", "z", "qw", "qx", "qy", "qz"]
    assert set(data.log_likelihood.data_vars) == {"y", "z"} and data.log_likelihood.z.shape == (2, 120)
    np.testing.assert_array_equal(data.observed_data.z.values, SEEN["z"].numpy())
    stats = data.sample_stats
    assert stats.log_evidence.values.tolist() == [p.log_evidence for p in populations]
    assert stats.effective_sample_size.values.tolist() == [p.effective_sample_size for p in populations]
    for chain, population in enumerate(populations):
        particle = stats.particle.values[chain]
        assert len(set(particle)) == int(stats.distinct_particles[chain]) < 120
        trace = population.trace[torch.from_numpy(particle)]
        np.testing.assert_array_equal(data.posterior.x.values[chain], trace["x"].numpy())
        np.testing.assert_array_equal(data.posterior.which.values[chain], trace["which"].numpy())
        np.testing.assert_array_equal(stats.lp.values[chain], trace.log_prob().numpy())
        np.testing.assert_array_equal(stats.founder.values[chain], population.founders[particle].numpy())
        np.testing.assert_array_equal(data.log_likelihood.y.values[chain], trace.log_prob("y").numpy())
        np.testing.assert_array_equal(
            stats.log_weight.values[chain], population.log_weights[particle].numpy()
        )
        same = poses.local(torch.from_numpy(data.posterior.hole.values[chain]), trace["hole"])
        assert float(same.norm(dim=-1).max()) < 1e-12
    assert to_arviz(populations).posterior.sizes["draw"] == 150
    assert np.isfinite(arviz.summary(data, kind="stats")["mean"].to_numpy()).all()


@pytest.mark.parametrize("draws", [30, 50, 77, 240])
def test_draws_have_equal_weight(draws: int) -> None:
    """Expected counts are draws times weights, whatever the number of draws, and never far off."""
    population = weighted(50, 3)
    share = draws * torch.softmax(population.log_weights, 0)
    runs = 300
    counts = torch.zeros(50, runs, dtype=torch.float64)
    torch.manual_seed(0)
    for run in range(runs):
        (chosen,) = export.draw([population], draws)
        assert len(chosen) == draws
        counts[:, run] = torch.bincount(chosen, minlength=50).double()
    error = (counts.mean(1) - share).abs() / (counts.std(1) / math.sqrt(runs)).clamp_min(0.01)
    assert float(error.max()) < 4.5
    assert float((counts - share[:, None]).abs().max()) < 2.0
    # The mutant: the first `draws` particles, or their weights forgotten.
    forgotten = (draws / 50 - share).abs() / (counts.std(1) / math.sqrt(runs)).clamp_min(0.01)
    assert float(forgotten.max()) > 20


def test_draws_come_in_no_order_and_from_their_seed() -> None:
    population = weighted(400, 4)
    before = torch.get_rng_state()
    one, two, other = (to_arviz(population, seed=seed) for seed in (5, 5, 6))
    assert torch.equal(before, torch.get_rng_state())
    particle = one.sample_stats.particle.values[0].astype(float)
    np.testing.assert_array_equal(particle, two.sample_stats.particle.values[0])
    assert (particle != other.sample_stats.particle.values[0]).any()
    assert abs(np.corrcoef(particle[1:], particle[:-1])[0, 1]) < 0.2


def test_the_posterior_is_the_weighted_one() -> None:
    population = weighted(20000, 5)
    x = to_arviz(population).posterior.x.values
    # Precision 1 + 4 + 3, mean (4 * 0.7 + 0.6) / 8; the prior's mean is 0.
    assert float(x.mean()) == pytest.approx(3.4 / 8, abs=0.02)
    assert float(x.var()) == pytest.approx(1 / 8, rel=0.05)


def test_opposite_quaternions_do_not_part_the_chains() -> None:
    populations = [weighted(100, seed) for seed in (6, 7)]
    signs = torch.where(torch.arange(100)[:, None] % 2 == 0, 1.0, -1.0)
    hole = populations[0].trace["hole"]
    flipped = torch.cat([hole[:, :3], signs * hole[:, 3:]], 1)
    mixed = Population(populations[0].trace.at({"hole": flipped}), populations[0].log_weights)
    found = to_arviz([mixed, populations[1]]).posterior.hole.values
    assert (np.abs(found[..., 6]) > 0.9).all() and len(np.unique(np.sign(found[..., 6]))) == 1
    assert float(arviz.rhat(found[..., 6])) < 1.1


def test_runs_steps_and_populations_say_the_same() -> None:
    one, two = weighted(40, 1), weighted(40, 2)
    step = [Stepped(p, StepInfo()) for p in (one, two)]
    for given, meant in (
        (Repeated((one, two), (1, 2)), [one, two]),
        ((p for p in (one, two)), [one, two]),
        (step, [one, two]),
        (step[1], two),
        (iter(step), two),
    ):
        found, expected = to_arviz(given), to_arviz(meant)
        np.testing.assert_array_equal(found.posterior.x.values, expected.posterior.x.values)


def test_chains_come_with_their_moves_as_draws() -> None:
    torch.manual_seed(0)
    kernel = cycle(metropolis_hastings(drift("x")), metropolis_hastings(drift("hole")))
    chains = markov_chains(kernel, weighted(6, 1), 10)
    data = to_arviz(chains)
    assert data.posterior.x.shape == (6, 10) and data.posterior.hole.shape == (6, 10, 7)
    assert data.posterior.hole.dims == ("chain", "draw", "pose")
    np.testing.assert_array_equal(data.posterior.x.values, chains.draws["x"].numpy().T)
    np.testing.assert_array_equal(data.sample_stats.acceptance.values, chains.acceptance.numpy())
    np.testing.assert_array_equal(
        to_arviz(chains, draws=4).posterior.x.values, chains.draws["x"][6:].numpy().T
    )
    assert np.isfinite(arviz.summary(data, var_names=["x"], kind="stats")["mean"].to_numpy()).all()
    with pytest.raises(InputError, match="11 draws were asked for of chains with 10 states"):
        to_arviz(chains, draws=11)


def test_it_can_be_saved_and_read(tmp_path: Path) -> None:
    data = to_arviz([weighted(50, 1), weighted(50, 2)])
    path = data.to_netcdf(str(tmp_path / "run.nc"))
    again = arviz.from_netcdf(path)
    np.testing.assert_array_equal(again.posterior.hole.values, data.posterior.hole.values)
    np.testing.assert_array_equal(
        again.sample_stats.log_evidence.values, data.sample_stats.log_evidence.values
    )


def elsewhere() -> None:
    pyro.sample("x", dist.Normal(number(0.0)[0], 1.0))


def other_addresses() -> Any:
    trace, _ = generate(elsewhere, (), {}, 50)
    return to_arviz([weighted(50, 1), Population(trace)])


def other_observations() -> Any:
    trace, log_weights = generate(program, (), {**SEEN, "y": number(0.8)[0]}, 50)
    return to_arviz([weighted(50, 1), Population(trace, log_weights)])


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (other_addresses, "populations 1 and 2 have different addresses"),
        (other_observations, "different observations at 'y'"),
        (lambda: to_arviz([]), "no population was given"),
        (lambda: to_arviz(weighted(5, 1), draws=0), "0 draws were asked for"),
    ],
)
def test_what_does_not_fit_is_refused(call: Callable[[], Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        call()


def test_without_arviz_one_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(InputError, match=r"ArviZ is not installed; run `pip install 'bcppl\[arviz\]'`"):
        to_arviz(weighted(5, 1))


def test_angles_about_half_a_turn_are_not_torn_apart() -> None:
    def heading() -> None:
        pyro.sample("a", dist.VonMises(number(math.pi)[0], 20.0))

    population = Population(simulate(heading, (), 500))
    for runs in (population, [population, population]):
        angles = to_arviz(runs).posterior["a"].values
        assert angles.std() == pytest.approx(20.0**-0.5, rel=0.15)
        assert math.cos(angles.mean() - math.pi) > 0.99
