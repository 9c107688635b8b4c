"""Training of proposals: closed forms of a linear Gaussian program, unbiased use, refusals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InferenceError, InputError
from bcppl.inference import Observed, Pair, importance_sampling, smcp3
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.learning import Amortised, Checks, evidence_bound, forward_kl, objectives, train
from bcppl.inference.population import Population
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import generate
from tests.invariance import number

# x ~ N(0, 2^2), y | x ~ N(x, 1): the posterior is N(0.8 y, 0.8), the evidence N(y; 0, 5).
GAIN, VARIANCE, ENTROPY = 0.8, 0.8, 0.5 * math.log(2.0 * math.pi * math.e * 0.8)
SEEN = {"y": number(1.5)}
LOG_EVIDENCE = float(dist.Normal(number(0.0), math.sqrt(5.0)).log_prob(SEEN["y"]))
FAST = partial(torch.optim.Adam, lr=0.05)


def program() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 2.0))
    pyro.sample("y", dist.Normal(x, 1.0))


class Linear(torch.nn.Module):
    """q(x | y) = N(gain y + shift, exp(2 log_scale))."""

    def __init__(self, gain: float = 0.0, shift: float = 0.5, log_scale: float = 0.5) -> None:
        super().__init__()
        self.gain, self.shift, self.log_scale = (
            torch.nn.Parameter(number(v)) for v in (gain, shift, log_scale)
        )

    def forward(self, observed: Mapping[str, Tensor], *args: Any) -> None:
        center = self.gain * observed["y"] + self.shift
        pyro.sample("x", dist.Normal(center, self.log_scale.exp()))

    def values(self) -> list[float]:
        return [float(p) for p in self.parameters()]


BEST = [GAIN, 0.0, 0.5 * math.log(VARIANCE)]


def divergence(guide: Linear, y: float) -> Tensor:
    """KL from the guide to the posterior at y."""
    away = guide.gain * y + guide.shift - GAIN * y
    ratio = (2.0 * guide.log_scale).exp() / VARIANCE
    return 0.5 * (ratio + away**2 / VARIANCE - 1.0 - ratio.log())


def test_forward_kl_is_that_of_the_closed_form() -> None:
    """E[-log q] over the joint: log s + 1/2 log 2 pi + E[(x - g y - b)^2] / 2 s^2, and its gradient."""
    torch.manual_seed(0)
    guide = Linear(0.3, 0.2, -0.1)
    loss = forward_kl(Amortised(guide), program, (), ["y"], batch=400_000)()
    squared = 4.0 * (1.0 - guide.gain) ** 2 + guide.gain**2 + guide.shift**2
    exact = guide.log_scale + 0.5 * math.log(2 * math.pi) + 0.5 * squared * (-2.0 * guide.log_scale).exp()
    assert float(loss.detach()) == pytest.approx(float(exact.detach()), abs=0.02)
    for given, right in zip(
        *(torch.autograd.grad(v, list(guide.parameters())) for v in (loss, exact)), strict=True
    ):
        assert float(given) == pytest.approx(float(right), abs=0.06)


@pytest.mark.parametrize("samples", [1, 5])
def test_the_evidence_bound_is_that_of_the_closed_form(samples: int) -> None:
    """With one sample it is log Z - KL; with more it is larger; at the posterior it is log Z."""
    torch.manual_seed(0)
    guide = Linear(0.3, 0.2, -0.1)
    bound = partial(evidence_bound, program=program, args=(), observations=SEEN, samples=samples)
    loss = bound(Amortised(guide).given(SEEN), batch=200_000)()
    exact = divergence(guide, 1.5) - LOG_EVIDENCE
    if samples == 1:
        assert float(loss.detach()) == pytest.approx(float(exact.detach()), abs=0.01)
        for given, right in zip(
            *(torch.autograd.grad(v, list(guide.parameters())) for v in (loss, exact)), strict=True
        ):
            assert float(given) == pytest.approx(float(right), abs=0.03)
    else:
        assert -LOG_EVIDENCE + 0.01 < float(loss.detach()) < float(exact.detach()) - 0.1
    best = bound(Amortised(Linear(*BEST)).given(SEEN), batch=3)()
    assert float(best.detach()) == pytest.approx(-LOG_EVIDENCE, abs=1e-12)


# Held-out draws by the thousand: the best of the checks is that of these draws.
MANY = Checks(every=100, batches=60)


def trained(objective: Callable[[Amortised], Any], seed: int = 0, steps: int = 500) -> tuple[Linear, Any]:
    guide = Linear()
    loss = objective(Amortised(guide))
    return guide, train(guide, loss, steps=steps, optimiser=FAST, seed=seed, checks=MANY)


def by_forward_kl(proposal: Amortised) -> Any:
    return forward_kl(proposal, program, (), ["y"], batch=128)


def test_training_ends_at_the_posterior_for_all_observations() -> None:
    guide, record = trained(by_forward_kl)
    assert guide.values() == pytest.approx(BEST, abs=0.05)
    assert float(record.held_out.min()) == pytest.approx(ENTROPY, abs=0.1)
    assert float(record.held_out[0]) > ENTROPY + 0.3
    assert record.held_out[record.steps == record.best] == record.held_out.min()
    assert len(record.losses) <= 500 and record.seconds > 0.0 and "held-out loss" in repr(record)


@pytest.mark.long
def test_training_by_the_evidence_bound_ends_at_one_posterior() -> None:
    guide, record = trained(
        lambda proposal: evidence_bound(proposal.given(SEEN), program, (), SEEN, samples=2)
    )
    gain, shift, log_scale = guide.values()
    assert 1.5 * gain + shift == pytest.approx(1.5 * GAIN, abs=0.05)
    assert log_scale == pytest.approx(BEST[2], abs=0.05)
    assert float(record.held_out.min()) == pytest.approx(-LOG_EVIDENCE, abs=1e-3)


@pytest.mark.long
def test_parameters_of_the_program_are_learned_by_the_bound() -> None:
    """The evidence N(y; 0, v + 1) of y = 3 is largest at v = 8."""
    log_scale = torch.nn.Parameter(number(0.0))
    guide = Linear()

    def learned() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), log_scale.exp()))
        pyro.sample("y", dist.Normal(x, 1.0))

    seen = {"y": number(3.0)}
    objective = evidence_bound(Amortised(guide).given(seen), learned, (), seen, samples=4)
    train([guide, log_scale], objective, steps=600, optimiser=FAST, checks=Checks(every=600, batches=60))
    assert float((2.0 * log_scale.detach()).exp()) == pytest.approx(8.0, rel=0.15)


@pytest.mark.long
def test_mutants_of_the_bounds_end_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the density of the proposal, it is left no spread."""
    sound = objectives.simulate

    class Dropped:
        def __init__(self, trace: Any) -> None:
            self.trace = trace
            self.choices, self.distributions = trace.choices, trace.distributions

        def __getitem__(self, address: str) -> Any:
            return self.trace[address]

        def log_prob(self) -> Tensor:
            return 0.0 * self.trace.log_prob()

    monkeypatch.setattr(objectives, "simulate", lambda *a: Dropped(sound(*a)))
    guide, _ = trained(lambda p: evidence_bound(p.given(SEEN), program, (), SEEN))
    assert guide.values()[2] < BEST[2] - 0.5
    monkeypatch.setattr(objectives, "simulate", sound)
    monkeypatch.setattr(objectives, "assess", lambda *a: objectives_assess(*a).detach())
    with pytest.raises(InputError, match="depends on no parameter"):
        trained(by_forward_kl, steps=1)


objectives_assess = objectives.assess


def test_small_batches_are_no_coincidence() -> None:
    """A guide that is given as many observations as there are particles fits no other number of them."""
    loss = forward_kl(Amortised(Linear()), program, (), ["y"], batch=5)()
    assert bool(torch.isfinite(loss)) and loss.requires_grad


# ---- reproducible


def test_the_seed_determines_the_parameters_and_nothing_else_is_drawn_from() -> None:
    torch.manual_seed(5)
    state = torch.get_rng_state()
    first, record = trained(by_forward_kl, steps=50)
    assert torch.equal(torch.get_rng_state(), state)
    torch.rand(3)
    again, second = trained(by_forward_kl, steps=50)
    other, third = trained(by_forward_kl, seed=1, steps=50)
    assert first.values() == again.values() != other.values()
    assert torch.equal(record.losses, second.losses) and not torch.equal(record.losses, third.losses)


def test_training_stops_early_and_keeps_the_best() -> None:
    """A learning rate that is far too large: the loss grows, and what was best is what is left."""
    guide = Linear(*BEST)
    record = train(
        guide,
        forward_kl(Amortised(guide), program, (), ["y"]),
        steps=2000,
        optimiser=partial(torch.optim.SGD, lr=0.5),
        checks=Checks(every=5, patience=3),
    )
    assert len(record.losses) <= 100 and record.best < len(record.losses)
    evaluated = forward_kl(Amortised(guide), program, (), ["y"], batch=100_000)()
    assert float(evaluated) == pytest.approx(ENTROPY, abs=0.1)


def test_held_out_draws_are_other_than_those_of_training(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[float] = []
    guide = Linear()

    def objective() -> Tensor:
        drawn.append(float(torch.rand(())))
        return guide.shift**2

    train(guide, objective, steps=4, checks=Checks(every=2, batches=2))
    held_out, steps = [drawn[i] for i in (0, 1, 4, 5, 8, 9)], [drawn[i] for i in (2, 3, 6, 7)]
    assert held_out[:2] == held_out[2:4] == held_out[4:]
    assert len({*held_out, *steps}) == 6


def test_modules_are_in_evaluation_mode_when_the_loss_is_checked() -> None:
    module = torch.nn.Sequential(torch.nn.Linear(1, 4), torch.nn.Dropout(0.5), torch.nn.Linear(4, 1))
    modes: list[bool] = []

    def objective() -> Tensor:
        modes.append(module.training)
        return module(torch.ones(8, 1)).square().mean()

    train(module, objective, steps=2, checks=Checks(every=1, batches=1))
    assert modes == [False, True, False, True, False] and not module.training


# ---- as it is used


def test_a_trained_proposal_gives_unbiased_evidence_and_the_posterior() -> None:
    """Also one that is not quite the posterior: its weights make up for it."""
    torch.manual_seed(0)
    proposal = Amortised(Linear(0.6, 0.3, 0.2))
    population = importance_sampling(program, (), SEEN, 200_000, proposal.given(SEEN))
    ratios = (population.log_weights - LOG_EVIDENCE).exp()
    assert float(ratios.mean()) == pytest.approx(1.0, abs=4 * float(ratios.std()) / math.sqrt(200_000))
    best = importance_sampling(program, (), SEEN, 50, Amortised(Linear(*BEST)).given(SEEN))
    torch.testing.assert_close(best.log_weights, torch.full((50,), LOG_EVIDENCE).double())


def test_a_trained_proposal_moves_particles() -> None:
    torch.manual_seed(0)
    trace, _ = generate(program, (), SEEN, 20_000)
    exact = trace.at({"x": GAIN * 1.5 + math.sqrt(VARIANCE) * torch.randn(20_000).double()})
    move = metropolis_hastings(Amortised(Linear(0.6, 0.3, 0.2)))(Population(exact))
    moved, accepted = move(exact, POSTERIOR)
    assert 0.5 < float(accepted.mean()) < 0.95
    assert float(moved["x"].mean()) == pytest.approx(1.2, abs=0.03)
    assert float(moved["x"].var()) == pytest.approx(VARIANCE, abs=0.04)
    _, all_accepted = metropolis_hastings(Amortised(Linear(*BEST)))(Population(exact))(exact, POSTERIOR)
    assert bool((all_accepted == 1.0).all())


def test_a_trained_proposal_is_a_forward_kernel_of_smcp3() -> None:
    """From the prior to the posterior in one step: with the posterior as the forward kernel, no variance."""

    def growing(count: int) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 2.0))
        if count:
            pyro.sample("y", dist.Normal(x, 1.0))

    def before(trace: Any) -> None:
        pyro.sample("x", dist.Normal(number(0.0), 2.0))

    torch.manual_seed(0)
    start = importance_sampling(growing, (0,), {}, 100)
    step = smcp3(Pair(Amortised(Linear(*BEST)), before))
    population, _ = step(start, Observed((1,), SEEN))
    assert population.log_evidence == pytest.approx(LOG_EVIDENCE, abs=1e-10)


# ---- refusals


def test_what_cannot_be_trained_is_refused() -> None:
    guide = Linear()
    proposal = Amortised(guide)

    def refused(match: str, objective: Any, parameters: Any = guide, **options: Any) -> None:
        with pytest.raises(InputError, match=match) as caught:
            train(parameters, objective, steps=1, **options)
        assert "\n" not in str(caught.value)

    def discrete(*args: Any) -> None:
        pyro.sample("x", dist.Bernoulli(logits=guide.gain + 0.0).mask(False).mask(True))

    def broken(in_training: bool) -> Tensor:
        return guide.gain * (torch.nan if guide.training is in_training else 1.0)

    def elsewhere(observed: Any) -> None:
        pyro.sample("z", dist.Normal(guide.gain, 1.0))

    refused("'w', which the program never visits", forward_kl(proposal, program, (), ["w"]))
    refused("samples 'z', which is no latent address", forward_kl(Amortised(elsewhere), program, (), ["y"]))
    refused("samples nothing", forward_kl(Amortised(lambda observed: None), program, (), ["y"]))
    refused("at 'x'.* not reparameterised", evidence_bound(discrete, program, (), SEEN))
    refused("leaves out the latent address 'x'", evidence_bound(lambda: None, program, (), SEEN))
    refused("no parameter", forward_kl(proposal, program, (), ["y"]), torch.zeros(3))
    with pytest.raises(InputError, match="seed"):
        train(guide, forward_kl(proposal, program, (), ["y"]), seed=-1)
    with pytest.raises(InputError, match="every 0 steps"):
        Checks(every=0)
    for step, in_training in ((1, True), (0, False)):  # of the draws that are held out
        with pytest.raises(InferenceError, match=f"loss of training is nan at step {step}"):
            train(guide, partial(broken, in_training), steps=1)
