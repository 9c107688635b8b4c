"""Targets: what a kernel leaves invariant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from bcppl.traces import Trace


@dataclass(frozen=True)
class Target:
    """The unnormalised log-density of a trace, with some sites let in only in part.

    Attributes:
        exponents: by address; a site that is not named counts in full, one with exponent 0 is not evaluated.
    """

    exponents: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, trace: Trace) -> Tensor:
        """log-density (N,). Cheap sites come first: where they forbid a particle, its total is -inf."""
        full = [a for a in trace.addresses if a not in self.exponents]
        total = trace.log_prob(*full) if full else torch.zeros(trace.particles, dtype=torch.float64)
        for address, exponent in self.exponents.items():
            if exponent > 0.0:
                total = total + exponent * trace.log_prob(address)
        return total


POSTERIOR = Target()
