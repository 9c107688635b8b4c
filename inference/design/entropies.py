"""The entropy of a population under other weights, in nats, for many sets of weights at once.

While the next measurement is chosen, the particles stay and their weights change. So an `Entropy` is fitted
to a population once, with all that depends on the particles alone (copies, neighbours, coordinates):
`entropy = mixture_entropy("hole")(population)`. Then `entropy(weights)` maps M sets of weights (M, N) to M
entropies.

A precise measurement leaves weight to few particles, or to one. These entropies stay finite then, and are
bounded below by the entropy that a single particle stands for.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from scipy.special import digamma
from torch import Tensor

from bcppl import poses
from bcppl.arguments import whole_number
from bcppl.beliefs import Belief
from bcppl.beliefs.entropy import neighbourhoods
from bcppl.beliefs.modes import gathered, links
from bcppl.errors import InputError
from bcppl.inference.design.distinct import DistinctParticles, separate_modes
from bcppl.inference.design.weighted_mixtures import WeightedMixtures, cholesky_factor
from bcppl.inference.population import Population
from bcppl.inference.summaries import COLLAPSED, is_pose, values_at, weighted_covariance

# Entropies (M,) of normalised weights (M, N) of the particles that it was fitted to.
EntropyOfWeights = Callable[[Tensor], Tensor]
Entropy = Callable[[Population], EntropyOfWeights]

# Numbers held at once where the neighbours' weights are gathered.
AT_ONCE = 1 << 24


def weight_entropy() -> Entropy:
    """The entropy of the weights: log N where they are equal, 0 where one particle has all.

    The criterion of BayesContact. It ignores the distances between particles: two that are a micrometre apart
    count as two.

    Fitting raises InputError where all particles with weight are the same.
    """

    def fit(population: Population) -> EntropyOfWeights:
        weighted = (torch.softmax(population.log_weights, 0) > 0).nonzero().flatten()
        latent = [value.index_select(0, weighted) for value in population.trace.choices.values()]
        if all(bool((value == value[:1]).all()) for value in latent):
            raise InputError(f"the belief {COLLAPSED}")
        return lambda weights: torch.special.entr(weights).sum(dim=1)

    return fit


def discrete_entropy(address: str) -> Entropy:
    """The entropy of the distribution of a discrete value: the weights of equal values are summed.

    Fitting raises InputError where all particles agree on the value.
    """

    def fit(population: Population) -> EntropyOfWeights:
        particles = DistinctParticles.of(population, address)
        return lambda weights: torch.special.entr(particles.merge(weights)).sum(dim=1)

    return fit


def mixture_entropy(
    address: str, translation: float = 0.01, rotation: float = 0.2, symmetries: Tensor | None = None
) -> Entropy:
    """The differential entropy of a mixture with a Gaussian for each mode; copies are merged.

    At the address of a pose it is with respect to the base measure (`bcppl.beliefs.entropy`), with Gaussians
    in the tangent space at the modes of the belief (`Belief.modes`). For every set of weights, modes are
    separated again, among the particles with more than a thousandth of an even share: particles that a
    measurement rules out no longer link two modes. At an address of other real values it is that of a single
    Gaussian, in their own units.

    Each Gaussian has the weighted covariance of its particles plus V n^(-2/d) / m: V is the belief's
    covariance within its modes, n the effective sample size, d the number of axes, and m the effective
    sample size of the mode. The second term matters only where few particles remain; by it a single particle
    has the d-dimensional volume of a share 1/n.

    Args:
        address: of a latent site.
        translation: the gap between modes, metres. Both gaps are widened together where half of the particles
            have no neighbour within a third of them.
        rotation: the gap between modes, radians.
        symmetries: (K, 7) `part_from_part` under which the part looks the same.

    Fitting raises InputError where the values are whole numbers, all particles have the same, or they do not
    span the axes.
    """

    def fit(population: Population) -> EntropyOfWeights:
        if not is_pose(population, address):
            particles, coordinates, log_base = _coordinates(population, address)
            label = torch.zeros(len(particles), dtype=torch.int64)
            mixtures = WeightedMixtures.fit(address, coordinates, log_base, particles.weights, label, None)
            return lambda weights: mixtures.entropy(particles.merge(weights))
        particles, freedom = DistinctParticles.of(population, address), population.belief(address).freedom
        distinct, share = particles.values, particles.weights
        label, gap = separate_modes(distinct, translation, rotation, symmetries)
        tangent = distinct.new_zeros(len(distinct), 6)
        for mode in range(int(label.max()) + 1):
            within = label == mode
            own = distinct[within]
            if symmetries is not None:
                own = gathered(own, own[share[within].argmax()], *gap, symmetries)
            tangent[within] = poses.local(Belief(own, share[within].log()).mean, own)
        mixtures = WeightedMixtures.fit(
            address,
            freedom.coordinates(tangent),
            freedom.log_base_density(tangent[:, 3:].norm(dim=-1)),
            share,
            label,
            links(distinct, *gap, symmetries),
        )
        return lambda weights: mixtures.entropy(particles.merge(weights))

    return fit


def neighbour_entropy(address: str, neighbours: int = 3) -> Entropy:
    """The k-nearest-neighbour estimate of the differential entropy, for any shape; copies are merged.

    Kozachenko and Leonenko 1987, weighted as in `bcppl.beliefs.entropy.nearest_neighbour_entropy`, except
    that the local weight is the mean over a particle and its k neighbours, so that it is not 0 where a
    measurement leaves a single particle. Where candidates bring latent values of their own, the weights of
    neighbours differ at random, a particle's own counts too much, and gains are too large by tenths of a nat:
    use `mixture_entropy` there. Distances are Mahalanobis distances of the population, whatever the weights.
    It needs several hundred particles in six dimensions.

    Args:
        address: of a latent site, of poses or of other real values.
        neighbours: k.

    Fitting raises InputError where the values are whole numbers, all particles have the same or do not span
    the axes, or there are no more than k of them.
    """
    neighbours = whole_number("an entropy by {} neighbours was asked for", neighbours)

    def fit(population: Population) -> EntropyOfWeights:
        particles, coordinates, log_base = _coordinates(population, address)
        count = len(coordinates)
        if count <= neighbours:
            raise InputError(
                f"the belief over {address!r} has {count} distinct particles, too few for an entropy by "
                f"{neighbours} neighbours; use more particles, or weight_entropy()."
            )
        factor = cholesky_factor(address, weighted_covariance(coordinates, particles.weights))
        about, volume = neighbourhoods(coordinates, factor, neighbours)
        volume += float(factor.diagonal().log().sum())
        # The log-density of the belief is this plus the log of the mean local weight.
        log_particles = float(digamma(neighbours) - digamma(count)) + math.log(count) - volume

        def entropy(weights: Tensor) -> Tensor:
            rows = max(1, AT_ONCE // about.numel())
            merged = particles.merge(weights).split(rows)
            return torch.cat(
                [-(w * (log_particles + _log(w[:, about].mean(dim=2)) - log_base)).sum(dim=1) for w in merged]
            )

        return entropy

    return fit


def _log(shares: Tensor) -> Tensor:
    """Logs, finite where a share is 0, which is multiplied by a weight of 0."""
    return shares.clamp_min(torch.finfo(torch.float64).tiny).log()


def _coordinates(population: Population, address: str) -> tuple[DistinctParticles, Tensor, Tensor]:
    """Distinct particles, their coordinates (K, d) and the log-density (K,) of the base measure there.

    Poses have tangent coordinates at the belief's mean, other real values are their own.
    """
    if not values_at(population, address).is_floating_point():
        raise InputError(
            f"the values at {address!r} are whole numbers, which have no density; "
            f"use discrete_entropy({address!r})."
        )
    particles = DistinctParticles.of(population, address)
    if not particles.is_pose:
        return particles, particles.values, torch.zeros(len(particles), dtype=torch.float64)
    belief = population.belief(address)
    tangent = poses.local(belief.mean, particles.values)
    log_base = belief.freedom.log_base_density(tangent[:, 3:].norm(dim=-1))
    return particles, belief.freedom.coordinates(tangent), log_base
