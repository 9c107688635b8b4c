"""What a wrong program is: its kind of mistake, and the site where it shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.traces import Fault
from tests.small_programs import normal_log

WRONG: dict[str, Wrong] = {}


@dataclass(frozen=True)
class Wrong:
    fault: Fault
    site: str | None
    program: Any
    args: tuple[Any, ...] = ()
    observations: Mapping[str, Any] = field(default_factory=lambda: {"y": 0.3})
    steps: tuple[Any, ...] = ()


def wrong(fault: Fault, site: str | None = "y", *args: Any, **more: Any) -> Callable[[Any], Any]:
    def register(program: Any) -> Any:
        WRONG[program.__name__] = Wrong(fault, site, program, args, **more)
        return program

    return register


def normal(address: str, mean: Any = 0.0, scale: Any = 1.0) -> Tensor:
    value: Tensor = pyro.sample(address, dist.Normal(torch.as_tensor(mean, dtype=torch.float64), scale))
    return value


class Reads(LazyDistribution):
    """A likelihood of x and of what a function returns."""

    def __init__(self, x: Tensor, read: Callable[[], Any]) -> None:
        self.x, self.read = x, read
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, self.x + self.read(), 1.0)
