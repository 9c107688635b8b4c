"""What a population says about any of its latent addresses: moments, quantiles, probabilities.

At the address of a pose (its distribution has a `freedom`) these are the belief's: a mean pose (7,), and six
tangent coordinates at it, metres and radians, 0 along held axes (`bcppl.beliefs`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bcppl.beliefs import normalised, weighted_quantiles
from bcppl.errors import InputError
from bcppl.inference.population import Population


def values_at(population: Population, address: str) -> Tensor:
    """The values (N, *event) at a latent address.

    Raises:
        InputError: no latent site has that address.
    """
    if address not in population.trace.choices:
        raise InputError(
            f"a summary of {address!r} was asked for, which is no latent address; "
            f"latent are {', '.join(population.trace.choices) or 'none'}."
        )
    return population.trace.choices[address]


def is_pose(population: Population, address: str) -> bool:
    """Whether a latent address holds poses (N, 7): its distribution says which of their axes are free."""
    values_at(population, address)
    return hasattr(population.trace.distributions[address], "freedom")


def mean(population: Population, address: str) -> Tensor:
    """The weighted mean (*event) at an address, in its own units; of a discrete one that of its numbers.

    Raises:
        InputError: no latent site has that address.
        InferenceError: no particle has any weight.
    """
    if is_pose(population, address):
        return population.belief(address).mean
    values = values_at(population, address).to(torch.float64)
    return torch.einsum("n,n...->...", normalised(population.log_weights), values)


def covariance(population: Population, address: str) -> Tensor:
    """The weighted covariance (D, D) of the D numbers of a value, in reading order; (6, 6) of a pose.

    Raises:
        InputError: no latent site has that address.
        InferenceError: no particle has any weight.
    """
    if is_pose(population, address):
        return population.belief(address).covariance
    weights = normalised(population.log_weights)
    values = values_at(population, address).to(torch.float64).reshape(len(weights), -1)
    centred = values - weights @ values
    return (weights[:, None] * centred).T @ centred


def quantiles(population: Population, address: str, probabilities: object) -> Tensor:
    """Weighted quantiles (Q, *event) of each number of a value by itself, (Q, 6) of a pose.

    Args:
        population: weighted particles.
        address: a latent one.
        probabilities: one (then there is no first axis) or several in [0, 1]; see `weighted_quantiles`.

    Raises:
        InputError: no latent site has that address, or a probability is not in [0, 1].
        InferenceError: no particle has any weight.
    """
    if is_pose(population, address):
        return population.belief(address).quantiles(probabilities)
    return weighted_quantiles(
        values_at(population, address), normalised(population.log_weights), probabilities
    )


class Probabilities(NamedTuple):
    """The distinct values (K, *event) that particles with weight have, in order, and their weights (K,)."""

    values: Tensor
    probabilities: Tensor


def probabilities(population: Population, address: str) -> Probabilities:
    """The probability of each value at a discrete address.

    Raises:
        InputError: no latent site has that address, or it holds poses.
        InferenceError: no particle has any weight.
    """
    if is_pose(population, address):
        raise InputError(
            f"probabilities of the poses at {address!r} were asked for; ask its belief for modes instead."
        )
    weights, values = normalised(population.log_weights), values_at(population, address)
    carrying = weights > 0
    distinct, which = torch.unique(values[carrying], dim=0, return_inverse=True)
    summed = torch.zeros(len(distinct), dtype=torch.float64).index_add_(0, which, weights[carrying])
    return Probabilities(distinct, summed)
