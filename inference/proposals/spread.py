"""Covariances of a population at one latent address, for proposals that are fitted to it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.errors import InferenceError
from bcppl.inference.population import Population
from bcppl.inference.proposals.coordinates import Coordinates, coordinates_of
from bcppl.inference.summaries import weighted_covariance

# Standard deviations below this are rounding: metres and radians for poses, the value's unit otherwise.
FLOOR = 1e-6


def spread_of(address: str) -> Callable[[Population], Tensor]:
    """A function of a population: the weighted covariance (d, d) of its particles at a latent address.

    For a pose it is that of its free axes in the tangent space at the mean (m^2, m rad, rad^2), for any other
    value that of its unbounded coordinates (`bcppl.inference.proposals.coordinates`).
    """
    return lambda population: covariance_about_mean(*weighted_places(population, address))


def weighted_places(population: Population, address: str) -> tuple[Coordinates, Tensor, Tensor]:
    """The coordinates, places (K, ...) and weights (K,) of the particles to which a proposal is fitted.

    A draw beyond the range of its type (0 or infinity where values are positive) has no place in unbounded
    coordinates, and is omitted.
    """
    coordinates = coordinates_of(population.trace, address)
    values = population.trace[address]
    places, weights = coordinates.places(values), normalised(population.log_weights)
    finite = torch.isfinite(places).all(dim=-1)
    if bool(finite.all()):
        return coordinates, places, weights
    total = float(weights[finite].sum())
    if not total > 0.0:
        raise InferenceError(
            f"no proposal can be fitted at {address!r}: all values are 0 or infinite in {values.dtype}, at "
            "the edge of the support; give the prior less spread."
        )
    return coordinates, places[finite], weights[finite] / total


def covariance_about_mean(coordinates: Coordinates, places: Tensor, weights: Tensor) -> Tensor:
    """The conditioned weighted covariance (d, d) of places (K, ...) about their mean."""
    return conditioned(
        weighted_covariance(coordinates.steps(coordinates.mean(places, weights), places), weights)
    )


def conditioned(covariance: Tensor) -> Tensor:
    """A covariance from few, partly equal particles, made positive definite by shrinking correlations."""
    diagonal = torch.diag(covariance.diagonal() + FLOOR**2)
    return 0.9 * covariance + 0.1 * diagonal
