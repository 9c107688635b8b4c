"""What guides a filter's proposals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from bcppl.traces import Trace


class Approximation(Protocol):
    """What guides the filter; `GaussianApproximation` is one. It is immutable.

    One that inherits from this class has a single mode unless it states otherwise.
    """

    def including(self, scene: Any, number: int, action: Any, observations: Mapping[str, Tensor]) -> Any:
        """The approximation given one more measurement."""

    def deferring(self, scene: Any, number: int, action: Any, observations: Mapping[str, Tensor]) -> Any:
        """The same for a measurement that all particles predict with certainty."""

    def updated(self) -> Any:
        """The approximation with all that was deferred."""

    @property
    def is_ambiguous(self) -> bool:
        """Whether it may have several modes before any contact; more copies are then made of a particle."""
        return False

    def is_far(self, scene: Any, number: int, action: Any, observations: Mapping[str, Tensor]) -> bool:
        """Whether a measurement is made too far from the part to depend on its pose."""
        return False

    def share_inside(self, action: Any) -> float:
        """How much of it lies where the prior's limits do not matter."""
        return 1.0

    def screens(self, action: Any) -> bool:
        """Whether it has a cheap likelihood of a measurement that is simulated."""
        return False

    def stratum(self, trace: Trace) -> Tensor:
        """The mode of each particle (N,), int64."""
        return torch.zeros(len(trace), dtype=torch.int64)
