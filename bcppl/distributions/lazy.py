"""Distributions that cost nothing until their log-probability or a sample is asked for."""

from __future__ import annotations

import math
from typing import Any

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from bcppl.distributions.parameters import check_parameters
from bcppl.errors import InputError


class LazyDistribution(TorchDistribution):
    """A distribution over one observation for each of N particles, evaluated only on demand.

    Subclasses run their simulator in `log_prob` and `sample`, never in `__init__`, so that a program
    can be traced for the price of its Python. A log-probability is evaluated again when an attribute, or
    anything that an attribute holds, has changed (`bcppl.traces.dependence.equality`). Attributes that only
    cache what the others determine are therefore cached properties, or are named in `__caches__`. A subclass
    may be a dataclass, with `eq=False`: this class's `__init__`, called at the end of its `__post_init__`,
    checks the ranges that its fields declare (`bcppl.distributions.parameters`).

    Attributes:
        cost: of a log-probability: 0 arithmetic, 1 rendering, 2 physics. Kernels evaluate the cheap sites
            first and move particles less often where they are expensive.
        broadcasts: whether `log_prob` takes H observations at once, (H, 1, *event_shape), and gives (H, N).
    """

    cost: int = 0
    broadcasts: bool = False
    arg_constraints: dict[str, Any] = {}
    support = constraints.real

    def __init__(self, particles: int, event_shape: tuple[int, ...]) -> None:
        check_parameters(self)
        super().__init__(torch.Size([particles]), torch.Size(event_shape), validate_args=False)

    def expand(self, batch_shape: Any, _instance: Any = None) -> LazyDistribution:
        """Itself: Pyro's plates call this on every site, also when its shape fits already."""
        if torch.Size(batch_shape) == self.batch_shape:
            return self
        raise InputError(
            f"{type(self).__name__} was made for {self.batch_shape[0]} particles and cannot be spread over "
            f"a plate of shape {tuple(batch_shape)}; build it from values sampled in the same program."
        )

    def undrawn(self) -> Tensor:
        """NaN in the shape of a sample, all of it one number in memory."""
        nothing = torch.tensor(torch.nan, dtype=torch.float64)
        return nothing.expand(*self.batch_shape, *self.event_shape)

    @property
    def log_prob_bound(self) -> float:
        """Upper bound of the log-probability at any value and any parameters; +inf where none is known.

        It lets a kernel reject a particle before its expensive sites are evaluated.
        """
        return math.inf

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of one observation, or of one for each particle."""
        raise NotImplementedError

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One observation for each particle, (N, *event_shape); only the empty sample_shape is known."""
        raise NotImplementedError
