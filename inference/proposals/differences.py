"""Differential evolution: steps along differences of particles, on SE(3) and in vectors."""

from __future__ import annotations

import math
from collections.abc import Callable

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.inference.population import Population
from bcppl.inference.proposals.coordinates import Coordinates
from bcppl.inference.proposals.proposal import Fittable
from bcppl.inference.proposals.spread import spread_of, weighted_places
from bcppl.traces import Trace

DIFFERENCES = 200  # drawn when it is fitted


def differential_evolution(
    address: str, *, scale: float | None = None, jumps: float = 0.1, noise: float = 0.05
) -> Fittable:
    """A proposal that steps along plus or minus the difference of two other particles, with noise.

    ter Braak, A Markov Chain Monte Carlo version of the genetic algorithm Differential Evolution, Statistics
    and Computing 16, 2006, eq. 2. Some steps are whole differences, which lead from one mode to another. The
    pairs are drawn by weight from the particles of the fit; the density is that of the mixture of both signs.
    For a pose a difference is the tangent from one pose to the other.

    Args:
        address: of the latent value.
        scale: factor of the differences; by default ter Braak's 2.38 / sqrt(2 d).
        jumps: the probability of a whole difference.
        noise: standard deviation of the noise, in the particles' standard deviations.

    Raises:
        InputError: the scale or the noise is not positive, or the jumps are no probability; when it is
            fitted: the address is not latent, or is discrete.
    """
    if scale is not None:
        scale = number_within("differential_evolution is given the scale {}", scale, above=0.0)
    jumps = number_within("differential_evolution is given the jumps {}", jumps, least=0.0, most=1.0)
    noise = number_within("differential_evolution is given the noise {}", noise, above=0.0)
    spread = spread_of(address)

    def fit(population: Population) -> Callable[[Trace], None]:
        covariance = noise**2 * spread(population)
        known, places, weights, *_ = weighted_places(population, address)
        drawn = _differences(known, places, weights)
        usual = 2.38 / math.sqrt(2.0 * known.dimension) if scale is None else scale
        sizes = torch.tensor([usual, 1.0], dtype=torch.float64)

        def along(trace: Trace) -> None:
            coordinates = known.of(trace)
            # A categorical one would be given the chances of all for each particle.
            which = pyro.sample("difference", dist.Uniform(drawn.new_zeros(()), float(len(drawn)))).long()
            whole = pyro.sample("whole", dist.Bernoulli(torch.tensor(jumps, dtype=torch.float64)))
            step = sizes[whole.long()][:, None] * drawn[which]
            place = coordinates.places(trace[address])
            ends = coordinates.stepped(place[:, None], torch.stack([step, -step], dim=1))
            pyro.sample(
                address, coordinates.mixture(torch.zeros(len(step), 2, dtype=torch.float64), ends, covariance)
            )

        return along

    return Fittable(fit)


def _differences(coordinates: Coordinates, places: Tensor, weights: Tensor) -> Tensor:
    """Steps (M, d) between two distinct particles, both drawn by weight."""
    if int((weights > 0).sum()) < 2:
        return torch.zeros(1, coordinates.dimension, dtype=torch.float64)
    first = torch.multinomial(weights, DIFFERENCES, replacement=True)
    # The second by inversion of what is left, the weights without the first's.
    below = weights.cumsum(0)
    point = torch.rand(DIFFERENCES, dtype=torch.float64) * (below[-1] - weights[first])
    beyond = point >= below[first] - weights[first]
    second = torch.searchsorted(below, point + torch.where(beyond, weights[first], 0.0), right=True)
    return coordinates.steps(places[first], places[second.clamp_(max=len(weights) - 1)])
