"""What proposals learn of a population at one latent address: how far its particles are spread."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.inference.population import Population
from bcppl.inference.proposals.coordinates import coordinates_of

# Spreads below these are rounding, not belief: metres and radians for poses, the value's own unit otherwise.
FLOOR = 1e-6


def spread_of(address: str) -> Callable[[Population], Tensor]:
    """What a proposal may learn: the weighted covariance (d, d) of the particles at a latent address.

    For a pose it is that of its free axes in the tangent space at the mean (m^2, m rad, rad^2). A value whose
    support is bounded has that of its unbounded coordinates (`bcppl.inference.proposals.coordinates`); any
    other value is flattened.
    """

    def spread(population: Population) -> Tensor:
        coordinates = coordinates_of(population.trace, address)
        places = coordinates.places(population.trace[address])
        weights = normalised(population.log_weights)
        return conditioned(
            covariance_of(coordinates.steps(coordinates.mean(places, weights), places), weights)
        )

    return spread


def covariance_of(steps: Tensor, weights: Tensor) -> Tensor:
    """The weighted covariance (d, d) of steps (N, d)."""
    centred = steps - weights @ steps
    return (weights[:, None] * centred).T @ centred


def conditioned(covariance: Tensor) -> Tensor:
    """A covariance from few, partly equal particles, made positive definite by shrinking correlations."""
    diagonal = torch.diag(covariance.diagonal() + FLOOR**2)
    return 0.9 * covariance + 0.1 * diagonal
