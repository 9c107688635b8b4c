"""Programs that are right, in ways that a check might take for a mistake."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.transforms import Transform

from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import NormalPose
from bcppl.distributions.switch import Switch
from bcppl.traces import Series, carried
from tests.invariance import number
from tests.small_programs import normal_log
from tests.wrong_programs.catalogue import normal
from tests.wrong_programs.dependence import Rollout
from tests.wrong_programs.numbers_and_supports import Custom, WithoutJacobian

RIGHT: dict[str, Right] = {}


@dataclass(frozen=True)
class Right:
    program: Any
    args: tuple[Any, ...] = ()
    observations: Mapping[str, Any] = field(default_factory=lambda: {"y": 0.3})
    steps: tuple[Any, ...] = ()


def right(*args: Any, **more: Any) -> Callable[[Any], Any]:
    def register(program: Any) -> Any:
        RIGHT[program.__name__] = Right(program, args, **more)
        return program

    return register


@right([torch.linspace(0.2, 1.0, 5)], observations={"y_0": np.array([0.4, 0.5, 1.1, 0.9, 1.8])})
def in_single_precision(batches: list[Tensor]) -> None:
    slope = pyro.sample("slope", dist.Normal(0.0, 2.0))
    bad = pyro.sample("bad", dist.Bernoulli(0.5))
    for k, x in enumerate(batches):
        with pyro.plate(f"batch_{k}", len(x)):
            pyro.sample(f"y_{k}", dist.Normal(slope * x[:, None], torch.where(bad == 1, 0.6, 0.3)))


@right(observations={"y": torch.tensor([0.3, -0.2, 1.0])})
def hierarchy() -> None:
    scale = pyro.sample("scale", dist.HalfCauchy(number(1.0)))
    with pyro.plate("groups", 3):
        mean = pyro.sample("mean", dist.Normal(number(0.0), scale))
        pyro.sample("y", dist.StudentT(number(2.0), mean, 1.0))


@right(observations={"y": 2})
def simplex() -> None:
    shares = pyro.sample("shares", dist.Dirichlet(torch.ones(4, dtype=torch.float64)))
    pyro.sample("y", dist.Categorical(shares))


@right()
def chosen() -> None:
    which = pyro.sample("which", dist.Categorical(torch.ones(2, dtype=torch.float64)))
    x = normal("x")
    pyro.sample("y", Switch(which, lambda k, rows: dist.Normal(x[rows], 1.0 + k)))


@right()
def padded() -> None:
    slipped = pyro.sample("slipped", dist.Bernoulli(0.5))
    normal("y", torch.where(slipped == 1, normal("shift", 0.0, 2.0), 0.0))


@right(observations={})
def with_a_factor_and_a_point() -> None:
    x = normal("x")
    twice = pyro.sample("twice", dist.Delta(2.0 * x))
    pyro.factor("f", -twice.square())


@right()
def masked_observation() -> None:
    x = normal("x")
    pyro.sample("y", dist.Normal(x, 1.0).mask(x > 0.0))


class TableLookup(LazyDistribution):
    """A likelihood by a simulator outside of torch, whose results are kept."""

    known: dict[bytes, Tensor] = {}  # noqa: RUF012
    calls = 0

    def __init__(self, x: Tensor) -> None:
        self.x = x
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        TableLookup.calls += 1
        key = self.x.numpy().tobytes() + value.numpy().tobytes()
        if key not in TableLookup.known:
            TableLookup.known[key] = torch.from_numpy(-0.5 * np.square(self.x.numpy() - value.numpy()))
        return TableLookup.known[key]


@right()
def kept_results() -> None:
    pyro.sample("y", TableLookup(normal("x")))


@lru_cache(maxsize=8)
def grid(count: int) -> Tensor:
    return torch.linspace(0.0, 1.0, count)


OFFSETS = torch.tensor([0.1, 0.2])
SEEN: list[int] = []


@right()
def globals_that_stay() -> None:
    x = normal("x")
    SEEN.append(1)
    normal("y", x + OFFSETS.sum() + grid(4)[1])


@right()
def black_box() -> None:
    x = normal("x")
    normal("y", torch.as_tensor(np.sin(x.numpy())))


@right()
def steps_and_kinks() -> None:
    x = normal("x")
    normal("y", x.abs() + x.clamp(min=0.0) + x.detach().round())


class Exponential(Custom):
    support = constraints.positive

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return -torch.log1p(-self.uniform(sample_shape))

    def log_prob(self, value: Tensor) -> Tensor:
        return -value


class TwoPeaks(Custom):
    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        sides = torch.where(self.uniform(sample_shape) < 0.3, -20.0, 20.0)
        return sides + torch.randn(sides.shape, dtype=torch.float64)

    def log_prob(self, value: Tensor) -> Tensor:
        low, high = normal_log(value, -20.0, 1.0), normal_log(value, 20.0, 1.0)
        return torch.logaddexp(math.log(0.3) + low, math.log(0.7) + high)


class HeavyTails(Custom):
    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return torch.tan(math.pi * (self.uniform(sample_shape) - 0.5))

    def log_prob(self, value: Tensor) -> Tensor:
        return -math.log(math.pi) - torch.log1p(value.square())


class LoadedDice(Custom):
    support = constraints.integer_interval(0, 5)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return (6 * self.uniform(sample_shape).sqrt()).floor().long()

    def log_prob(self, value: Tensor) -> Tensor:
        return ((2 * value + 1) / 36).double().log()


class ExpWithJacobian(WithoutJacobian):
    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        return x


def transformed() -> Any:
    transforms: list[Transform] = [ExpWithJacobian()]
    return dist.TransformedDistribution(dist.Normal(number(0.0), 1.0), transforms)


def pair() -> Any:
    class Pair(dist.MultivariateNormal):
        """A user's class: not taken on trust."""

    covariance = torch.tensor([[1.0, 0.9], [0.9, 1.0]], dtype=torch.float64)
    return Pair(torch.zeros(2, dtype=torch.float64), covariance)


def custom(make: Callable[[], Any]) -> None:
    def program() -> None:
        x = pyro.sample("x", make()).double()
        normal("y", x[..., 0] if x.ndim > 1 else x)

    RIGHT[make.__name__] = Right(program)


for make in (Exponential, TwoPeaks, HeavyTails, LoadedDice, transformed, pair):
    custom(make)


@right(observations={"y": torch.tensor([0.1, 0.0, 0.2])})
def pose() -> None:
    mean = torch.tensor([0.1, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    part = pyro.sample("part", NormalPose(mean, covariance=0.01 * torch.eye(6, dtype=torch.float64)))
    pyro.sample("y", dist.Normal(part[..., :3], 0.1).to_event(1))


@right(observations={"seen": 3})
def thinned() -> None:
    count = pyro.sample("count", dist.Binomial(number(20.0), number(0.3)))
    pyro.sample("seen", dist.Binomial(count, number(0.5)))


@right(observations={"seen": 3})
def vague_rate() -> None:
    rate = pyro.sample("rate", dist.Gamma(number(0.02), number(0.02)))
    pyro.sample("seen", dist.Poisson(rate))


@right()
def rolled() -> None:
    x = normal("x")
    normal("y", carried("rollout", partial(Rollout, x)).x)


def step(state: dict[str, Tensor], gain: float) -> dict[str, Tensor]:
    x = normal("x", gain * state["x"])
    normal("y", x)
    return {"x": x, "far": x > 1.0}


def start() -> dict[str, Tensor]:
    return {"x": normal("x")}


STEPS = (((0.9,), {"y": 0.3}), ((0.8,), {"y": 0.1}))
RIGHT["series"] = Right(Series(start, step), (), {}, STEPS)
RIGHT["series without history"] = Right(Series(start, step, history=False), (), {}, STEPS)
