"""Drift: random walks with the covariance of the particles, over one latent value or several jointly."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.proposals.coordinates import Coordinates, coordinates_of
from bcppl.inference.proposals.proposal import Fittable
from bcppl.inference.proposals.spread import conditioned, spread_of, weighted_places
from bcppl.inference.summaries import weighted_covariance
from bcppl.traces import Trace


def drift(address: str, scales: tuple[float, float] = (0.05, 1.0)) -> Fittable:
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
    log_scales = _log_scales(scales)
    spread = spread_of(address)

    def fit(population: Population) -> Callable[[Trace], None]:
        known = coordinates_of(population.trace, address)
        covariance = spread(population) * (2.38**2 / known.dimension)

        def random_walk(trace: Trace) -> None:
            coordinates = known.of(trace)
            size = torch.exp(pyro.sample("drift scale", dist.Uniform(*log_scales)))
            place = coordinates.places(trace[address])
            pyro.sample(address, coordinates.normal(place, covariance, size))

        return random_walk

    return Fittable(fit)


def joint_drift(*addresses: str, scales: tuple[float, float] = (0.05, 1.0)) -> Fittable:
    """A random walk over several latent values with their joint covariance.

    Where measurements inform a difference (the pose of a part in the frame of a camera whose own pose is
    uncertain), the particles lie on a ridge: each value alone can hardly move, but all can together. The
    first value is drawn from its normal, every further one from its normal given the steps before it.

    Args:
        *addresses: of the latent values, two or more.
        scales: as for `drift`.

    Raises:
        InputError: fewer than two addresses, or one twice; when it is fitted: an address is not latent, or is
            discrete.
    """
    if len(set(addresses)) != len(addresses) or len(addresses) < 2:
        raise InputError(
            f"joint_drift is given the addresses {addresses!r}; give two or more, each once; "
            "use drift for one."
        )
    log_scales = _log_scales(scales)

    def fit(population: Population) -> Callable[[Trace], None]:
        links = _links(population, addresses)

        def random_walk(trace: Trace) -> None:
            size = torch.exp(pyro.sample("drift scale", dist.Uniform(*log_scales)))
            taken = torch.zeros(len(trace), 0, dtype=torch.float64)
            for link in links:
                coordinates = link.coordinates.of(trace)
                place = coordinates.places(trace[link.address])
                center = coordinates.stepped(place, taken @ link.gain.T)
                value = pyro.sample(link.address, coordinates.normal(center, link.covariance, size))
                step = coordinates.steps(place, coordinates.places(value))
                taken = torch.cat([taken, step], dim=1)

        return random_walk

    return Fittable(fit)


class _Link(NamedTuple):
    """The normal of one address's step, given the steps before it (D,).

    Its mean is `gain` (d, D) times these, its covariance (d, d).
    """

    address: str
    coordinates: Coordinates
    gain: Tensor
    covariance: Tensor


def _links(population: Population, addresses: tuple[str, ...]) -> list[_Link]:
    steps, known, least, effective = [], [], [], 0.0
    for address in addresses:
        fitted = weighted_places(population, address)
        coordinates, places, weights, *_ = fitted
        if len(places) < len(population):
            raise InputError(
                f"joint_drift moves {address!r}, of which some particles are at the edge of the support, "
                "0 or infinite; give its prior less spread."
            )
        known.append(coordinates)
        least.append(fitted.least)
        effective = max(effective, fitted.effective)
        steps.append(coordinates.steps(coordinates.mean(places, weights), places))
    together = torch.cat(steps, dim=1)
    covariance = weighted_covariance(together, weights) + torch.diag(torch.cat(least))
    covariance = conditioned(covariance, effective) * (2.38**2 / together.shape[1])
    links, end = [], 0
    for address, coordinates in zip(addresses, known, strict=True):
        before, own = slice(0, end), slice(end, end + coordinates.dimension)
        factor = torch.linalg.cholesky(covariance[before, before])
        gain = torch.cholesky_solve(covariance[before, own], factor).T
        left = covariance[own, own] - gain @ covariance[before, own]
        links.append(_Link(address, coordinates, gain, 0.5 * (left + left.T)))
        end += coordinates.dimension
    return links


def _log_scales(scales: tuple[float, float]) -> Tensor:
    """The logarithms (2,) of the smallest and the largest scale."""
    if not isinstance(scales, Sequence) or len(scales) != 2:
        raise InputError(f"drift is given the scales {scales!r}; give two, as (0.05, 1.0).")
    smallest, largest = (number_within("drift is given the scale {}", s, above=0.0) for s in scales)
    if smallest > largest:
        raise InputError(
            f"drift is given the scales {(smallest, largest)}; give the smaller one first, (0.05, 1.0)."
        )
    return torch.tensor([math.log(smallest), math.log(largest)], dtype=torch.float64)
