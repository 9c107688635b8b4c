"""Hamiltonian Monte Carlo: invariance on every kind of support, a chain with an exact answer, refusals."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference.kernels import delayed_acceptance, fitted, hamiltonian, hmc, moved_by
from bcppl.inference.kernels.kernel import Kernel
from bcppl.inference.population import Population
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Trace, carried, generate, simulate
from bcppl.traces.differentiation.programs import log_prob_with_grad
from tests.invariance import largest_z, number

DRAWS = 10_000
SOUND, BROKEN = 4.5, 8.0


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


# ---- programs with exact draws

COVARIANCE = torch.tensor([[1.0, 0.8, 0.0], [0.8, 1.0, 0.3], [0.0, 0.3, 0.5]], dtype=torch.float64)
SEEN = vector(1.0, -0.5, 2.0)


def correlated() -> None:
    x = pyro.sample("x", dist.MultivariateNormal(torch.zeros(3, dtype=torch.float64), COVARIANCE))
    pyro.sample("y", dist.Normal(x, 0.7).to_event(1))


def posterior_draws(exponent: float) -> Callable[[int], Trace]:
    """The likelihood to a power is that of a wider noise."""

    def draws(count: int) -> Trace:
        variance = 0.49 / exponent
        covariance = torch.linalg.inv(torch.linalg.inv(COVARIANCE) + torch.eye(3).double() / variance)
        exact = torch.distributions.MultivariateNormal(covariance @ SEEN / variance, covariance)
        return generate(correlated, (), {"y": SEEN}, count)[0].at({"x": exact.sample((count,))})

    return draws


def bounded() -> None:
    """Positive, in an interval that depends on another value, on a simplex, and free: all dependent."""
    rate = pyro.sample("rate", dist.Gamma(number(3.0), 2.0))
    edge = pyro.sample("edge", dist.Uniform(number(0.5), 2.0))
    pyro.sample("within", dist.Uniform(-edge, edge))
    share = pyro.sample("share", dist.Dirichlet(vector(2.0, 3.0, 4.0)))
    pyro.sample("free", dist.Normal(share[:, 0] * rate, rate))


def plated() -> None:
    center = pyro.sample("center", dist.Normal(number(0.0), 1.0))
    with pyro.plate("points", 3):
        scale = pyro.sample("scale", dist.LogNormal(center, 0.5))
        pyro.sample("at", dist.Normal(torch.zeros(2).double(), scale[..., None]).to_event(1))


def flattened(*addresses: str) -> Callable[[Trace], Tensor]:
    def functions(trace: Trace) -> Tensor:
        x = torch.cat([trace[a].reshape(len(trace), -1) for a in addresses], dim=1)
        return torch.cat([x, (x[:, :, None] * x[:, None, :]).flatten(1), torch.sin(2 * x)], dim=1)

    return functions


BOUNDED = ("rate", "within", "share", "free")
PLATED = ("center", "scale", "at")
CASES: dict[str, tuple[Callable[[int], Trace], tuple[str, ...], float]] = {
    "correlated Gaussian": (posterior_draws(1.0), ("x",), 0.9),
    "bounded": (lambda n: simulate(bounded, (), n), BOUNDED, 0.4),
    "plates": (lambda n: simulate(plated, (), n), PLATED, 0.4),
}


def worst_z(case: str, kernel: Kernel | None = None, target: Any = POSTERIOR, times: int = 2) -> float:
    """The largest |z| of the change in expectations from exact draws, each draw compared with itself."""
    exact, addresses, size = CASES[case]
    torch.manual_seed(1)
    kernel = hmc(*addresses, step_size=size, steps=4) if kernel is None else kernel
    move = kernel(Population(exact(500)))
    trace = exact(DRAWS)
    functions = flattened(*addresses)
    before = functions(trace)
    for _ in range(times):
        trace, accepted = move(trace, target)
        assert 0.02 < float(accepted.mean()) <= 1.0
    return largest_z(before, functions(trace))


@pytest.mark.parametrize("case", CASES)
def test_hmc_leaves_the_target_invariant(case: str) -> None:
    assert worst_z(case) < SOUND


def test_a_tempered_likelihood_and_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CASES, "tempered", (posterior_draws(0.5), ("x",), 0.9))
    half = Target({"y": 0.5})
    assert worst_z("tempered", target=half) < SOUND
    assert worst_z("tempered", target=POSTERIOR) > BROKEN
    staged = delayed_acceptance(hmc("x", steps=4), first="x")
    assert worst_z("correlated Gaussian", staged) < SOUND


# ---- mutants


def no_last_kick(*args: Any) -> Any:
    """A trajectory that is not reversible."""
    gradient, _, _, size, *_ = args
    position, momentum = sound_leapfrog(*args)
    return position, momentum - 0.5 * size * gradient(position)


def last_kick_flipped(*args: Any) -> Any:
    gradient, _, _, size, *_ = args
    position, momentum = sound_leapfrog(*args)
    return position, momentum - size * gradient(position)


def all_kicks_flipped(gradient: Any, *args: Any) -> Any:
    return sound_leapfrog(lambda z: -gradient(z), *args)


sound_leapfrog = hamiltonian.leapfrog


@pytest.mark.parametrize("mutant", [no_last_kick, last_kick_flipped])
def test_mutants_whose_trajectories_are_not_reversible(mutant: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hamiltonian, "leapfrog", mutant)
    assert worst_z("correlated Gaussian") > BROKEN


def test_mutant_that_climbs_the_wrong_way_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flipped gradient still leaves the target invariant, but moves away from the mass."""

    def accepted() -> float:
        torch.manual_seed(0)
        trace = posterior_draws(1.0)(1000)
        _, done = hmc("x", step_size=0.5, steps=8)(Population(trace))(trace, POSTERIOR)
        return float(done.mean())

    assert accepted() > 0.85
    monkeypatch.setattr(hamiltonian, "leapfrog", all_kicks_flipped)
    assert accepted() < 0.3


def test_mutant_that_accepts_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        hamiltonian, "decided", lambda target, old, new, ratio: (new, torch.ones(len(new)).double())
    )
    assert worst_z("correlated Gaussian", hmc("x", step_size=1.3, steps=4)) > BROKEN


def test_mutant_that_forgets_the_momentum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        hamiltonian, "leapfrog", lambda s, z, p, *rest: (sound_leapfrog(s, z, p, *rest)[0], p)
    )
    assert worst_z("correlated Gaussian") > BROKEN


def test_mutant_that_drops_the_jacobian_of_the_support(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = hamiltonian.Unconstrained.values
    monkeypatch.setattr(
        hamiltonian.Unconstrained,
        "values",
        lambda self, z: (sound(self, z)[0], torch.zeros(len(z), dtype=torch.float64)),
    )
    assert worst_z("bounded") > BROKEN


# ---- exact answers


def chain() -> None:
    """Pyro's tests/infer/mcmc/test_hmc.py: means k / 4, precisions 4 / (k (4 - k))."""
    at = pyro.sample("z_1", dist.Normal(number(0.0), 1.0))
    at = pyro.sample("z_2", dist.Normal(at, 1.0))
    at = pyro.sample("z_3", dist.Normal(at, 1.0))
    pyro.sample("y", dist.Normal(at, 1.0))


def test_gaussian_chain() -> None:
    torch.manual_seed(0)
    count = 4000
    trace, _ = generate(chain, (), {"y": number(1.0)}, count)
    names = ("z_1", "z_2", "z_3")
    away = trace.at({a: 3.0 + 2.0 * trace[a] for a in names})
    done = moved_by(Population(away), hmc(*names), POSTERIOR, 12)
    assert done.acceptance > 0.8
    x = torch.stack([done.population.trace[a] for a in names], dim=1)
    variance = vector(0.75, 1.0, 0.75)
    mean_error = (x.mean(0) - vector(0.25, 0.5, 0.75)) / (variance / count).sqrt()
    precision_error = (x.var(0) / variance - 1) / math.sqrt(2 / count)
    assert float(mean_error.abs().max()) < 3.5
    assert float(precision_error.abs().max()) < 3.5
    torch.testing.assert_close(1 / x.var(0), vector(1.33, 1.0, 1.33), rtol=0.1, atol=0)


def wide() -> None:
    pyro.sample("x", dist.Normal(torch.zeros(40, dtype=torch.float64), 1.0).to_event(1))


def still_on_its_line(kernel: Kernel, seed: int) -> float:
    """The share of particles that three sweeps leave near the line through the mean on which they began."""
    torch.manual_seed(seed)
    start = Population(simulate(wide, (), 2000))
    moved = moved_by(start, kernel, POSTERIOR, 3).population
    return float((torch.cosine_similarity(start["x"], moved["x"], dim=1).abs() > 0.8).double().mean())


@pytest.mark.long
def test_few_particles_stay_on_their_line_through_the_mean() -> None:
    """After half a period a particle is at its mirror image; some trajectories have to be shorter."""
    default, half = (sum(still_on_its_line(k, s) for s in range(5)) for k in (hmc("x"), hmc("x", steps=8)))
    assert default < 0.6 * half


def test_each_move_draws_its_number_of_steps() -> None:
    """Of what has learned once too: its small steps go three times or eight times as far."""
    torch.manual_seed(0)
    start = Population(simulate(wide, (), 200))
    move = fitted(hmc("x", step_size=1e-3, jitter=0.0), start)
    ends = [move(start.trace, POSTERIOR)[0]["x"] for _ in range(12)]
    lengths = {round(float((x - start["x"]).norm(dim=1).mean()) / 1e-3 / 40**0.5) for x in ends}
    assert lengths == {3, 8}


def test_units_do_not_matter() -> None:
    def uneven() -> None:
        pyro.sample("x", dist.Normal(vector(5e-4, -3e3), vector(1e-4, 1e3)).to_event(1))

    torch.manual_seed(0)
    trace = simulate(uneven, (), 1000)
    moved, accepted = hmc("x")(Population(trace))(trace, POSTERIOR)
    assert float(accepted.mean()) > 0.85
    assert bool(((moved["x"] - trace["x"]).std(0) > vector(1e-4, 1e3)).all())


def test_the_gradient_is_that_of_the_log_density() -> None:
    torch.manual_seed(0)
    trace = simulate(plated, (), 5)
    values = {a: trace[a].clone().requires_grad_() for a in PLATED}
    density = log_prob_with_grad(trace, values)
    torch.testing.assert_close(density.detach(), trace.log_prob())
    gradients = torch.autograd.grad(density.sum(), list(values.values()))
    for (address, value), gradient in zip(values.items(), gradients, strict=True):
        step = 1e-6 * torch.randn_like(value.detach())
        higher, lower = (trace.at({address: value.detach() + s * step}).log_prob() for s in (1, -1))
        expected = (gradient * step).reshape(5, -1).sum(1)
        torch.testing.assert_close((higher - lower) / 2, expected, rtol=1e-4, atol=1e-12)
    halved = log_prob_with_grad(trace, values, {"at": 0.5})
    torch.testing.assert_close(halved.detach(), trace.log_prob() - 0.5 * trace.log_prob("at"))


def test_trajectories_that_diverge_are_rejected() -> None:
    def steep() -> None:
        pyro.sample("s", dist.LogNormal(number(0.0), 3.0))

    torch.manual_seed(0)
    trace = simulate(steep, (), 500)
    moved, accepted = hmc("s", step_size=60.0, steps=30)(Population(trace))(trace, POSTERIOR)
    assert float(accepted.mean()) < 0.1
    assert bool(torch.isfinite(moved.log_prob()).all())


# ---- refusals


class Simulated(LazyDistribution):
    """A likelihood that is computed outside of torch."""

    def __init__(self, pose: Tensor, cost: int) -> None:
        self.cost = cost
        self.pose = pose
        super().__init__(len(pose), ())

    def log_prob(self, value: Tensor) -> Tensor:
        if self.cost:
            return -((self.pose.detach() - value) ** 2)
        return torch.from_numpy(-((self.pose.numpy() - value.numpy()) ** 2))


class Rollout:
    """A state that a simulator would carry."""

    def __init__(self, start: Tensor) -> None:
        self.start = start.numpy()

    def __getitem__(self, index: Tensor) -> Rollout:
        return Rollout(torch.from_numpy(self.start)[index])

    def where(self, mask: Tensor, other: Rollout) -> Rollout:
        return Rollout(torch.where(mask, torch.from_numpy(self.start), torch.from_numpy(other.start)))


def mixed(kind: str) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    z = pyro.sample("z", dist.Normal(number(0.0), 1.0))
    if kind == "physics":
        pyro.sample("felt", Simulated(x, 2))
    if kind == "numpy":
        pyro.sample("seen", Simulated(x, 0))
    if kind == "carried":
        carried("probe", lambda: Rollout(x))
    pyro.sample("pose", NormalPose(poses.identity(), 0.1 * torch.ones(6)))
    pyro.sample("which", dist.Categorical(torch.ones(3).double()))
    pyro.sample("edge", dist.Uniform(z - 1, z + 1))
    pyro.sample("matrix", dist.Normal(torch.zeros(2).double(), 1.0).to_event(1))


def test_what_has_no_gradient_is_refused_by_name() -> None:
    torch.manual_seed(0)

    def refused(kind: str, match: str, *addresses: str) -> None:
        observed = {"physics": "felt", "numpy": "seen"}.get(kind)
        given = {} if observed is None else {observed: number(0.3)}
        trace, _ = generate(mixed, (kind,), given, 20)
        with pytest.raises(InputError, match=match) as caught:
            hmc(*addresses)(Population(trace))(trace, POSTERIOR)
        assert "\n" not in str(caught.value)
        # An address that no simulator depends on moves, also beside one.
        free, _ = hmc("matrix")(Population(trace))(trace, POSTERIOR)
        assert not torch.equal(free["matrix"], trace["matrix"])

    refused("physics", r"'felt' depends on 'x' and runs a simulator", "z", "x")
    refused("numpy", r"'seen' takes 'x' out of torch", "x")
    refused("carried", r"the program takes 'x' out of torch", "x")
    refused("", r"'pose': it is a pose", "pose")
    refused("", r"'which' is discrete", "which")
    refused("", r"'nowhere', which is no latent address; latent are x, z", "nowhere")
    refused("", r"'edge' together with 'z', on which its support depends", "z", "edge")
    refused("", r"no address to move")
    with pytest.raises(InputError, match="step size -1"):
        hmc("x", step_size=-1)
