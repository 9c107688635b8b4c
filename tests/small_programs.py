"""Small programs that several tests run, and the normal density by hand."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from tests.invariance import number


def normal_log(value: Tensor, mean: Tensor | float, scale: float) -> Tensor:
    return -0.5 * ((value - mean) / scale) ** 2 - math.log(scale * math.sqrt(2 * math.pi))


class Felt(LazyDistribution):
    """An observation at x; subclasses define its log-probability."""

    def __init__(self, x: Tensor) -> None:
        self.x = x
        super().__init__(len(x), ())

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return torch.zeros(self.batch_shape)


def beside_the_plate() -> None:
    pyro.sample("x", dist.Normal(torch.zeros(3), 1.0))


def first_entry() -> None:
    part = pyro.sample("part", dist.Normal(torch.zeros(3), 1.0).to_event(1))
    pyro.sample("x", dist.Normal(part[0], 1.0))


def line(data: Tensor, dim: int | None = None) -> None:
    slope = pyro.sample("slope", dist.Normal(number(0.0), 1.0))
    with pyro.plate("points", len(data), dim=dim):
        pyro.sample("y", dist.Normal(slope * data, 1.0))
