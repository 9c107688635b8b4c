"""Drift: a random walk whose covariance is the particles'."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.proposals.coordinates import coordinates_of
from bcppl.inference.proposals.proposal import Fitted
from bcppl.inference.proposals.spread import spread_of
from bcppl.traces import Trace


def drift(address: str, scales: tuple[float, float] = (0.05, 1.0)) -> Fitted:
    """A random walk with the weighted covariance of the particles and a random scale.

    Poses are moved in their tangent space along the free axes, other values as vectors in unbounded
    coordinates of their support (logarithms of positive numbers).

    Args:
        address: of the latent value.
        scales: the step's scale is log-uniform between these, times 2.38 / sqrt(d) times the particles'
            standard deviations (Roberts and Rosenthal, Optimal scaling for various Metropolis-Hastings
            algorithms, Statistical Science 16, 2001).

    Raises:
        InputError: the scales are not two positive numbers, the smaller first; when it is fitted: the address
            is not latent, or is discrete.
    """
    smallest, largest = map(math.log, _scales(scales))
    spread = spread_of(address)

    def fit(population: Population) -> Callable[[Trace], None]:
        known = coordinates_of(population.trace, address)
        covariance = spread(population) * (2.38**2 / known.dimension)

        def random_walk(trace: Trace) -> None:
            coordinates = known.of(trace)
            size = torch.exp(pyro.sample("drift scale", dist.Uniform(*_pair(smallest, largest))))
            place = coordinates.places(trace[address])
            pyro.sample(address, coordinates.normal(place, covariance, size))

        return random_walk

    return Fitted(fit)


def _scales(scales: object) -> tuple[float, float]:
    if not isinstance(scales, Sequence | Tensor) or isinstance(scales, str) or len(scales) != 2:
        raise InputError(f"drift is given the scales {scales!r}; give two, (0.05, 1.0).")
    smallest, largest = (number_within("drift is given the scale {}", s, above=0.0) for s in scales)
    if smallest > largest:
        raise InputError(
            f"drift is given the scales {(smallest, largest)}; give the smaller one first, (0.05, 1.0)."
        )
    return smallest, largest


def _pair(low: float, high: float) -> tuple[Tensor, Tensor]:
    return torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
