"""Drift: a random walk shaped by the particles' own spread."""

from __future__ import annotations

import math
from collections.abc import Callable

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.distributions.poses import NormalPose
from bcppl.inference.population import Population
from bcppl.inference.proposals.proposal import Fitted
from bcppl.poses import Freedom
from bcppl.traces import Trace

# Spreads below these are rounding, not belief: metres and radians for poses, the value's own unit otherwise.
FLOOR = 1e-6


def drift(address: str, scales: tuple[float, float] = (0.05, 1.0)) -> Fitted:
    """A random walk shaped by the weighted covariance of the particles, its scale drawn anew for each move.

    Poses are moved in their tangent space along the free axes, other values as vectors.

    Args:
        address: which latent value to move.
        scales: the step's scale is log-uniform between these, times 2.38 / sqrt(d) times the particles' own
            spread (Roberts and Rosenthal, Optimal scaling for various Metropolis-Hastings algorithms,
            Statistical Science 16, 2001).
    """
    smallest, largest = (math.log(s) for s in scales)
    spread = spread_of(address)

    def fit(population: Population) -> Callable[[Trace], None]:
        freedom = getattr(population.trace.distributions[address], "freedom", None)
        covariance = spread(population)
        covariance = covariance * (2.38**2 / len(covariance))
        factor = torch.linalg.cholesky(covariance)
        if freedom is None:
            factor = factor.to(population.trace[address])

        def random_walk(trace: Trace) -> None:
            size = torch.exp(pyro.sample("drift scale", dist.Uniform(*_pair(smallest, largest))))
            if freedom is None:
                value = trace[address]
                event = value.shape[1:]
                flat = dist.MultivariateNormal(
                    value.reshape(len(value), -1),
                    scale_tril=size.to(value)[:, None, None] * factor,
                    validate_args=False,
                )
                pyro.sample(
                    address, dist.TransformedDistribution(flat, _reshape(event)) if len(event) != 1 else flat
                )
            else:
                pyro.sample(
                    address, NormalPose(trace[address], size[:, None, None] ** 2 * covariance, freedom)
                )

        return random_walk

    return Fitted(fit)


def _pair(low: float, high: float) -> tuple[Tensor, Tensor]:
    return torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)


def _reshape(event: torch.Size) -> torch.distributions.Transform:
    return torch.distributions.transforms.ReshapeTransform(torch.Size([math.prod(event)]), event)


def spread_of(address: str) -> Callable[[Population], Tensor]:
    """What a proposal may learn: the weighted covariance (d, d) of the particles at a latent address.

    For a pose it is that of its free axes in the tangent space at the mean (m^2, m rad, rad^2).
    """

    def spread(population: Population) -> Tensor:
        freedom = getattr(population.trace.distributions[address], "freedom", None)
        if freedom is None:
            return _vector_spread(population, address)
        return _pose_spread(population, address, freedom)

    return spread


def _pose_spread(population: Population, address: str, freedom: Freedom) -> Tensor:
    covariance = population.belief(address).covariance
    free = list(freedom.axes)
    return _conditioned(covariance[free][:, free])


def _vector_spread(population: Population, address: str) -> Tensor:
    value = population.trace[address].to(torch.float64).reshape(len(population), -1)
    weights = normalised(population.log_weights)
    centred = value - weights @ value
    return _conditioned((weights[:, None] * centred).T @ centred)


def _conditioned(covariance: Tensor) -> Tensor:
    """A covariance from few, partly equal particles, made positive definite by shrinking correlations."""
    diagonal = torch.diag(covariance.diagonal() + FLOOR**2)
    return 0.9 * covariance + 0.1 * diagonal
