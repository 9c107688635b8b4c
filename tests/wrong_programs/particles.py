"""Programs in which particles are not independent, or have other addresses, and masked latents."""

from __future__ import annotations

import random

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.traces import Fault, Series
from tests.invariance import number
from tests.small_programs import normal_log
from tests.wrong_programs.catalogue import WRONG, Reads, Wrong, normal, wrong

# ---- addresses


@wrong(Fault.ADDRESSES, "bad", observations={})
def one_particle_decides_the_sites() -> None:
    x = normal("x")
    if x[0] > 0.0:
        normal("bad")


@wrong(Fault.RANDOMNESS, "bad", observations={})
def chance_decides_the_sites() -> None:
    normal("x")
    if random.random() > 0.5:
        normal("bad")


@wrong(Fault.ADDRESSES, "x_1", observations={})
def sampled_until_all_are_positive() -> None:
    x, k = normal("x"), 0
    while bool((x < 0.0).any()) and k < 3:
        x, k = normal(f"x_{k}"), k + 1


# ---- masked latents


@wrong(Fault.MASKED, "bad")
def masked_latent() -> None:
    slipped = pyro.sample("slipped", dist.Bernoulli(0.5))
    bad = pyro.sample("bad", dist.Normal(number(0.0), 1.0).mask(slipped == 1))
    normal("y", torch.where(slipped == 1, bad, 0.0))


# ---- particles


@wrong(Fault.MIXING)
def centred() -> None:
    x = normal("x")
    normal("y", x - x.mean())


@wrong(Fault.MIXING)
def softmax_over_particles() -> None:
    normal("y", torch.softmax(normal("x"), 0))


@wrong(Fault.MIXING)
def sorting() -> None:
    normal("y", normal("x").sort().values)


@wrong(Fault.MIXING)
def summed_density() -> None:
    x = normal("x")
    density = Reads(x, lambda: 0.0)
    density.log_prob = lambda value: normal_log(value, x, 1.0).sum()  # type: ignore[method-assign]
    pyro.sample("y", density)


@wrong(Fault.ONE_PARTICLE)
def first_particle() -> None:
    x = normal("x")
    normal("y", x, 2.0 if x[0] > 0.0 else 1.0)


@wrong(Fault.ONE_PARTICLE)
def entry_of_a_vector() -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(3, dtype=torch.float64), 1.0).to_event(1))
    normal("y", x[0, 1])


@wrong(Fault.MIXING)
def best_of_all() -> None:
    x = normal("x")
    normal("y", x - x.min())


@wrong(Fault.MIXING, observations={"y": torch.tensor([0.3, 0.2, 0.1])})
def scrambled_axes() -> None:
    p = pyro.sample("p", dist.Normal(torch.zeros(3, dtype=torch.float64), 1.0).to_event(1))
    pyro.sample("y", dist.Normal(p.reshape(3, -1).T, 1.0).to_event(1))


@wrong(Fault.PLACE)
def by_place() -> None:
    x = normal("x")
    normal("y", x + torch.arange(len(x)))


@wrong(Fault.PLACE)
def cached_by_shape() -> None:
    normal("y", rendered_once(normal("x")))


RENDERED: dict[int, Tensor] = {}


def rendered_once(x: Tensor) -> Tensor:
    return RENDERED.setdefault(len(x), x.square())


@wrong(Fault.COUNT)
def until_all_converge() -> None:
    x = normal("x")
    root = torch.ones_like(x)
    while bool(((root**3 + root - x).abs() > 1e-3).any()):
        root = root - (root**3 + root - x) / (3.0 * root.square() + 1.0)
    normal("y", root)


@wrong(Fault.COUNT)
def shared_out() -> None:
    x = normal("x")
    normal("y", x / len(x))


@wrong(Fault.COUNT, None)
def as_many_as_now() -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(10), 1.0))
    normal("y", x)


@wrong(Fault.MIXING)
def mean_as_a_number() -> None:
    x = normal("x")
    normal("y", x - x.mean().item())


@wrong(Fault.MIXING, "f", observations={})
def summed_factor() -> None:
    x = normal("x")
    pyro.factor("f", -x.square().sum())


@wrong(Fault.MIXING)
def batch_norm() -> None:
    normal("y", torch.nn.functional.batch_norm(normal("x")[:, None], None, None, training=True)[:, 0])


@wrong(Fault.PLACE)
def fixed_noise() -> None:
    x = normal("x")
    normal("y", x + torch.as_tensor(np.random.default_rng(0).normal(size=len(x))))


def centred_step(x: Tensor) -> Tensor:
    normal("y", x - x.mean())
    return x


def mixed_state(x: Tensor) -> Tensor:
    normal("y", x)
    return x - x.mean()


ONE_STEP = (((), {"y": 0.3}),)
IN_A_STEP, A_STATE = Series(lambda: normal("x"), centred_step), Series(lambda: normal("x"), mixed_state)
WRONG["mixing in a step"] = Wrong(Fault.MIXING, "y", IN_A_STEP, (), {}, ONE_STEP)
WRONG["a mixed state"] = Wrong(Fault.MIXING, None, A_STATE, (), {}, ONE_STEP)
