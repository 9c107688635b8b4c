"""What measurements tell of the errors that they share, which a likelihood integrates out.

    for error in shared_errors(population):
        print(error.name, error.mean, error.deviation)
    for change in sudden_changes(population):
        print(change.name, change.time, change.probability)

A deviation of 1 is that of the prior: nothing was learnt. Where it is small and the mean is far from zero the
bench is off by something that can be put right: measure the grasp, calibrate the arm, shift the clock. A
sudden change, as a slip of the peg, is allowed for by the belief, and named because the next one may not be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.inference.population import Population

PROBABLE = 0.5


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


class SuddenChange(NamedTuple):
    """A sudden change of what all touches share.

    Attributes:
        name: in words, as "the part slid".
        time: of the first touch after it, s of the probe.
        probability: given all measurements.
    """

    name: str
    time: float
    probability: float


@runtime_checkable
class InfersSharedErrors(Protocol):
    """A distribution that integrates errors out which several measurements share."""

    def shared_moments(self, value: Tensor) -> Mapping[str, tuple[Tensor, Tensor]]:
        """By name, each particle's means and variances (N, M)."""

    def changes(self, value: Tensor) -> Sequence[tuple[str, float, Tensor]]:
        """By name and time (s), the probabilities (N,) that each particle gives to a sudden change."""


def shared_errors(population: Population) -> list[SharedError]:
    """The posterior of each shared error; empty where measurements share none."""
    weights, errors = normalised(population.log_weights), []
    for site, value in _newest(population):
        for name, (means, variances) in site.shared_moments(value).items():
            mean = weights @ means
            deviation = torch.sqrt(weights @ (variances + (means - mean).square()))
            errors.append(SharedError(name, mean, deviation))
    return errors


def sudden_changes(population: Population) -> list[SuddenChange]:
    """The sudden changes that are more probable than not, in their order."""
    weights = normalised(population.log_weights)
    each = [
        SuddenChange(name, time, float(weights @ probabilities))
        for site, value in _newest(population)
        for name, time, probabilities in site.changes(value)
    ]
    return [change for change in each if change.probability > PROBABLE]


def _newest(population: Population) -> list[tuple[Any, Tensor]]:
    """The newest site that shares errors, which is given what earlier ones have observed, and its value."""
    trace = population.trace
    sites = [a for a in trace.observations if isinstance(trace.distributions[a], InfersSharedErrors)]
    return [(trace.distributions[a], trace[a]) for a in sites[-1:]]
