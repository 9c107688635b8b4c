"""What measurements tell of the errors that they share, which a likelihood integrates out.

    for error in shared_errors(population):
        print(error.name, error.mean, error.deviation)

A deviation of 1 is that of the prior: nothing was learnt. Where it is small and the mean is far from zero the
bench is off by something that can be put right: measure the grasp, calibrate the arm, shift the clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.inference.population import Population


class SharedError(NamedTuple):
    """The parameters of an error, in standard deviations of their prior.

    Attributes:
        name: of the error.
        mean: (M,) posterior means.
        deviation: (M,) posterior standard deviations.
    """

    name: str
    mean: Tensor
    deviation: Tensor


@runtime_checkable
class SharesErrors(Protocol):
    """A distribution that integrates errors out which several measurements share."""

    def shared_moments(self, value: Tensor) -> Mapping[str, tuple[Tensor, Tensor]]:
        """By name, each particle's means and variances (N, M)."""


def shared_errors(population: Population) -> list[SharedError]:
    """The errors of the newest site that shares them, which is given what earlier ones have observed."""
    trace = population.trace
    sites = [a for a in trace.observations if isinstance(trace.distributions[a], SharesErrors)]
    if not sites:
        return []
    weights = normalised(population.log_weights)
    errors = []
    for name, (means, variances) in trace.distributions[sites[-1]].shared_moments(trace[sites[-1]]).items():
        mean = weights @ means
        deviation = torch.sqrt(weights @ (variances + (means - mean).square()))
        errors.append(SharedError(name, mean, deviation))
    return errors
