"""Kernels leave their target invariant: from exact draws, moves must not change any expectation.

Beside each stands a mutant that the same test has to find: a flipped sign, a reverse move that is left out, a
density without the Jacobian of the rotations, an edge that is not seen.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference.kernels import Kernel, cycle, metropolis_hastings, moved_by, repeat
from bcppl.inference.population import Population
from bcppl.inference.proposals import Fittable, drift
from bcppl.inference.targets import POSTERIOR, Target, as_target
from bcppl.poses import Freedom
from bcppl.traces import Trace, generate, simulate
from tests.inference.kernels.exact_targets import (
    CENTER,
    COVARIANCE,
    SEEN,
    WIDE,
    correlated,
    correlated_draws,
    draws_of,
    edged,
    planar,
    wide,
)
from tests.invariance import largest_z, number

DRAWS = 20_000
SOUND, BROKEN = 4.5, 8.0  # |z| of the worst of a dozen expectations: below if invariant, above if not


def of_vectors(x: Tensor) -> Tensor:
    """Expectations (N, K) that are compared before and after."""
    products = (x[:, :, None] * x[:, None, :]).flatten(1)
    return torch.cat([x, products, torch.sin(2 * x), (x**2).sum(-1, keepdim=True).sqrt()], dim=1)


def of_poses(center: Tensor) -> Callable[[Tensor], Tensor]:
    def functions(pose: Tensor) -> Tensor:
        tangent = poses.local(center, pose)
        angle = tangent[:, 3:].norm(dim=-1, keepdim=True)
        return torch.cat([of_vectors(tangent), torch.cos(angle), angle, angle**2], dim=1)

    return functions


def worst_z(
    exact: Callable[[int], Trace],
    kernel: Kernel,
    address: str,
    functions: Callable[[Tensor], Tensor],
    target: Any = POSTERIOR,
    times: int = 3,
) -> float:
    """The largest |z| of the change in expectations, over exact draws, after some moves.

    The move is fitted to draws of its own. Each draw is compared with itself, so that the change's own
    standard error is what it is measured in.
    """
    torch.manual_seed(1)
    move = kernel(Population(exact(500)))
    trace = exact(DRAWS)
    before = functions(trace[address])
    for _ in range(times):
        trace, _ = move(trace, as_target(target))
    return largest_z(before, functions(trace[address]))


# ---- what is compared

CASES: dict[str, tuple[Callable[[int], Trace], str, Callable[[Tensor], Tensor]]] = {
    "correlated Gaussian": (correlated_draws, "x", of_vectors),
    "wide rotations": (draws_of(wide), "pose", of_poses(CENTER)),
    "planar": (draws_of(planar), "pose", of_poses(CENTER)),
    "hard edges": (draws_of(edged), "pose", of_poses(CENTER)),
}


@pytest.mark.parametrize("case", CASES)
def test_drift_leaves_the_target_invariant(case: str) -> None:
    exact, address, functions = CASES[case]
    assert worst_z(exact, metropolis_hastings(drift(address, (0.3, 1.5))), address, functions) < SOUND


@pytest.mark.parametrize("case", ["correlated Gaussian", "wide rotations", "planar"])
def test_mutant_with_the_sign_flipped(case: str) -> None:
    exact, address, functions = CASES[case]

    def flipped(trace: Trace) -> Tensor:
        return -POSTERIOR(trace)

    kernel = metropolis_hastings(drift(address, (0.3, 1.5)))
    assert worst_z(exact, kernel, address, functions, flipped) > BROKEN


def test_mutant_that_drops_the_jacobian_of_rotations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Freedom, "log_base_density", lambda self, angle: torch.zeros_like(angle))
    exact, address, functions = CASES["wide rotations"]
    assert worst_z(exact, metropolis_hastings(drift(address, (0.3, 1.5))), address, functions) > BROKEN


def test_mutant_that_does_not_see_the_edges() -> None:
    exact, address, functions = CASES["hard edges"]

    def blind(trace: Trace) -> Tensor:
        return torch.zeros(len(trace), dtype=torch.float64)

    kernel = metropolis_hastings(drift(address, (0.3, 1.5)))
    assert worst_z(exact, kernel, address, functions, blind) > BROKEN


def test_composed_kernels_and_tempered_targets_are_invariant() -> None:
    """A likelihood tempered by half: the posterior of a noise wider by sqrt 2."""
    posterior = torch.linalg.inv(torch.linalg.inv(COVARIANCE) + torch.eye(3, dtype=torch.float64) / 0.98)
    halfway = torch.distributions.MultivariateNormal(posterior @ SEEN / 0.98, posterior)

    def exact(count: int) -> Trace:
        return generate(correlated, (), {"y": SEEN}, count)[0].at({"x": halfway.sample((count,))})

    kernel = repeat(cycle(metropolis_hastings(drift("x")), metropolis_hastings(leaning)), 2)
    assert worst_z(exact, kernel, "x", of_vectors, Target({"y": 0.5}), times=1) < SOUND
    assert worst_z(exact, kernel, "x", of_vectors, POSTERIOR, times=1) > BROKEN


# ---- proposals that are not symmetric, and that choose more than the new value


def leaning(trace: Trace) -> None:
    """Pulled to the origin by a pull that is chosen first, its chances hanging on where the particle is."""
    x = trace["x"]
    strong = pyro.sample("strong", dist.Bernoulli(torch.sigmoid(x[:, 0])))
    pull = torch.where(strong == 1, number(0.2), number(0.8))[:, None]
    pyro.sample("x", dist.Normal(pull * x + 0.1, 0.5 + 0.3 * strong[:, None]).to_event(1))


def fresh(trace: Trace) -> None:
    """An independent pose about the centre, wherever the particle is."""
    pyro.sample("pose", NormalPose(CENTER.expand(len(trace), 7), 0.7 * WIDE))


ASYMMETRIC = {
    "auxiliary choice": (leaning, "correlated Gaussian"),
    "independent pose": (fresh, "wide rotations"),
}


@pytest.mark.parametrize("name", ASYMMETRIC)
def test_the_way_back_is_weighed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    proposal, case = ASYMMETRIC[name]
    exact, address, functions = CASES[case]
    assert worst_z(exact, metropolis_hastings(proposal), address, functions) < SOUND
    monkeypatch.setattr(
        "bcppl.inference.kernels.hastings.assess",
        lambda program, args, choices, count: torch.zeros(count, dtype=torch.float64),
    )
    assert worst_z(exact, metropolis_hastings(proposal), address, functions) > BROKEN


def test_a_proposal_that_moves_nothing_latent_is_refused() -> None:
    def elsewhere(trace: Trace) -> None:
        pyro.sample("elsewhere", dist.Normal(trace["x"], 1.0).to_event(1))

    trace = correlated_draws(4)
    with pytest.raises(InputError, match=r"elsewhere.* latent are x"):
        metropolis_hastings(elsewhere)(Population(trace))(trace, POSTERIOR)


def test_drift_moves_scalars_and_matrices_too() -> None:
    def program() -> None:
        pyro.sample("s", dist.Normal(number(0.0), 1.0))
        pyro.sample("m", dist.Normal(torch.zeros(2, 2, dtype=torch.float64), 1.0).to_event(2))

    for address in ("s", "m"):
        kernel = metropolis_hastings(drift(address, (0.5, 2.0)))
        assert (
            worst_z(draws_of(program), kernel, address, lambda v: of_vectors(v.reshape(len(v), -1))) < SOUND
        )


# ---- what a particle may learn from


@pytest.mark.parametrize("count", [2, 7, 20])
def test_no_particle_shapes_its_own_proposal(count: int) -> None:
    def program() -> None:
        pyro.sample("tag", dist.Normal(number(0.0), 1.0))
        pyro.sample("x", dist.Normal(number(0.0), 1.0))

    learnt: list[set[float]] = []
    moved: list[set[float]] = []

    def spying(population: Population) -> Callable[[Trace], None]:
        learnt.append(set(population.trace["tag"].tolist()))

        def propose(trace: Trace) -> None:
            if len(moved) < len(learnt):
                moved.append(set(trace["tag"].tolist()))
            assert set(trace["tag"].tolist()) == moved[-1], "the reverse move is of the same particles"
            pyro.sample("x", dist.Normal(trace["x"], 1.0))

        return propose

    trace = simulate(program, (), count)
    tags = set(trace["tag"].tolist())
    sweeps = 3
    done = moved_by(Population(trace), metropolis_hastings(Fittable(spying)), POSTERIOR, sweeps)
    assert len(learnt) == len(moved) == 2 * sweeps
    for others, mine in zip(learnt, moved, strict=True):
        assert not others & mine and others | mine == tags
    for k in range(sweeps):
        assert moved[2 * k] | moved[2 * k + 1] == tags, "every particle is moved in every sweep"
        assert all(each == moved[k % 2] for k, each in enumerate(moved)), "halves stay from sweep to sweep"
    # Particles stay in their places, and what is not moved stays.
    assert torch.equal(done.population.trace["tag"], trace["tag"])
    fresh = Trace(program, (), count, done.population.trace.choices, {})
    torch.testing.assert_close(done.population.trace.log_prob(), fresh.log_prob())


def test_acceptance_is_the_share_that_moved() -> None:
    torch.manual_seed(0)
    trace = correlated_draws(1000)
    done = moved_by(Population(trace), metropolis_hastings(drift("x")), POSTERIOR)
    moved = (done.population.trace["x"] != trace["x"]).any(dim=-1)
    assert done.acceptance == pytest.approx(float(moved.double().mean()))
    assert 0.05 < done.acceptance < 0.95
