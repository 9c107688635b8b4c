"""A population: a trace with its log weights, what SMC passes from step to step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bcppl.beliefs import Belief, effective_sample_size, normalised
from bcppl.poses import FREE
from bcppl.traces import Trace


@dataclass(frozen=True, eq=False)
class Population:
    """Weighted particles.

    Attributes:
        trace: of N particles.
        log_weights: (N,) unnormalised, float64.
        log_evidence: log of the estimated evidence of all measurements so far.
    """

    trace: Trace
    log_weights: Tensor
    log_evidence: float = 0.0

    def __len__(self) -> int:
        return self.trace.particles

    @property
    def effective_sample_size(self) -> float:
        """1 / sum of squared normalised weights."""
        return effective_sample_size(self.log_weights)

    def reweighed(self, log_factor: Tensor) -> Population:
        """Every weight times exp(log_factor) (N,), and the evidence times the weighted mean of the factors.

        The evidence's factor is a difference of two logsumexps, so it is right whether or not the
        population was resampled before.

        Raises:
            InferenceError: no particle has any weight left.
        """
        log_weights = self.log_weights + log_factor
        normalised(log_weights)
        gained = torch.logsumexp(log_weights, 0) - torch.logsumexp(self.log_weights, 0)
        return replace(self, log_weights=log_weights, log_evidence=self.log_evidence + float(gained))

    def selected(self, ancestors: Tensor) -> Population:
        """The particles at `ancestors` (N,), equally weighted."""
        return replace(
            self, trace=self.trace[ancestors], log_weights=torch.zeros(len(ancestors), dtype=torch.float64)
        )

    def __getitem__(self, index: Tensor) -> Population:
        return replace(self, trace=self.trace[index], log_weights=self.log_weights[index])

    def belief(self, address: str) -> Belief:
        """The particles read as a posterior over the pose at an address."""
        freedom = getattr(self.trace.distributions[address], "freedom", FREE)
        return Belief(self.trace[address], self.log_weights, freedom)
