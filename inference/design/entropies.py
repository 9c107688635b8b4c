"""How uncertain a population is under other weights: entropies in nats, of many reweighings at once.

Where the next measurement is chosen, the particles stay and their weights change. So what hangs on the
particles alone (copies, neighbours, coordinates) is worked out once, by
`entropy = mode_entropy("hole")(population)`, and then `entropy(weights)` gives that of each of M
reweighings, (M, N) -> (M,).

Few particles bear a sharp measurement: under its weights one or two may be left. The entropies here stay
finite then, and go no lower than that of what a single particle stands for.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.special import digamma
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within, whole_number
from bcppl.beliefs import Belief
from bcppl.beliefs.merged import distinct_poses
from bcppl.beliefs.modes import cluster, gathered, links, nearest
from bcppl.errors import InputError
from bcppl.inference.design.mixtures import Mixtures, spanning_factor
from bcppl.inference.population import Population
from bcppl.inference.summaries import is_pose, values_at

# Entropies (M,) of normalised weights (M, N) of the particles it was made for.
EntropyOf = Callable[[Tensor], Tensor]
Entropy = Callable[[Population], EntropyOf]

# Gaps between modes are at least so many distances of a particle from its nearest neighbour (median).
SPARSE = 3.0
# Numbers held at once where a reweighing's neighbours are gathered.
AT_ONCE = 1 << 24


def weight_entropy() -> Entropy:
    """Entropy of the weights: log N where they are equal, 0 where one particle has all.

    BayesContact's choice of the next probe. It asks nothing of the particles, and tells nothing of how far
    apart they are: two that are a micrometre apart count as two.

    Raises:
        InputError: (of what it returns) all particles with weight are the same.
    """

    def fitted(population: Population) -> EntropyOf:
        _refuse_one_particle(population)
        return lambda weights: torch.special.entr(weights).sum(dim=1)

    return fitted


def value_entropy(address: str) -> Entropy:
    """Entropy of the distribution of a discrete value, the weights of equal values summed: which hole it is.

    Raises:
        InputError: (of what it returns) no latent site has that address, or all particles agree on its value.
    """

    def fitted(population: Population) -> EntropyOf:
        carrying = torch.softmax(population.log_weights, 0) > 0
        values = values_at(population, address)[carrying]
        distinct, which = torch.unique(values, dim=0, return_inverse=True)
        refuse_collapsed(address, len(distinct))
        summed = _summing(carrying, which, len(distinct))
        return lambda weights: torch.special.entr(summed(weights)).sum(dim=1)

    return fitted


def mode_entropy(
    address: str, translation: float = 0.01, rotation: float = 0.2, symmetries: Tensor | None = None
) -> Entropy:
    """Differential entropy of a mixture with a Gaussian for each mode, copies merged.

    Of poses it is against the base measure (`bcppl.beliefs.entropy`), the Gaussians in the tangent space at
    the modes of the belief (`Belief.modes`). Modes are found anew for every reweighing, among the particles
    with more than a thousandth of an even share: what is cut off by a measurement no longer links two modes.
    Of other real values it is that of one Gaussian, in their own units.

    Each Gaussian has the weighted covariance of its particles plus V n^(-2/d) / m: V is the belief's
    covariance within its modes, n the effective sample size, d the number of axes, and m the effective
    sample size of the mode. It counts only where few are left, and a single one has the d-dimensional volume
    of one share in n.

    Args:
        address: a latent one.
        translation: the gap between modes, metres. Both are widened together where half of the particles
            have no neighbour within a third of them.
        rotation: the gap between modes, radians.
        symmetries: (K, 7) `part_from_part` under which the part looks the same.

    Raises:
        InputError: (of what it returns) no latent site has that address, its values are whole numbers, all
            particles have the same, or they do not span its axes.
    """

    def fitted(population: Population) -> EntropyOf:
        whole = torch.softmax(population.log_weights, 0)
        carrying = whole > 0
        weights = whole[carrying]
        linked = None
        if is_pose(population, address):
            freedom = population.belief(address).freedom
            distinct, which = distinct_poses(population[address][carrying])
            refuse_collapsed(address, len(distinct))
            share = _summed(weights, which, len(distinct))
            label, gap = parted(distinct, translation, rotation, symmetries)
            linked = links(distinct, *gap, symmetries)
            tangent = distinct.new_zeros(len(distinct), 6)
            for mode in range(int(label.max()) + 1):
                within = label == mode
                own = distinct[within]
                if symmetries is not None:
                    own = gathered(own, own[share[within].argmax()], *gap, symmetries)
                tangent[within] = poses.local(_mean(own, share[within]), own)
            coordinates = freedom.coordinates(tangent)
            log_base = freedom.log_base_density(tangent[:, 3:].norm(dim=-1))
        else:
            coordinates, which = _distinct_reals(population, address, carrying)
            share = _summed(weights, which, len(coordinates))
            label = torch.zeros(len(coordinates), dtype=torch.int64)
            log_base = torch.zeros(len(coordinates), dtype=torch.float64)
        mixtures = Mixtures.fitted(address, coordinates, log_base, share, label, linked)
        summed = _summing(carrying, which, len(coordinates))
        return lambda weights: mixtures.entropy(summed(weights))

    return fitted


def parted(
    distinct: Tensor, translation: float, rotation: float, symmetries: Tensor | None = None
) -> tuple[Tensor, tuple[float, float]]:
    """Which mode each of distinct poses (K, 7) is in, (K,) int64, and the gap between modes that was used."""
    number_within("modes are to be parted by {} m", translation, above=0.0)
    number_within("modes are to be parted by {} rad", rotation, above=0.0)
    # The few particles of a wide belief are farther apart than modes are, and no modes for that.
    sparse = SPARSE * float(nearest(distinct, translation, rotation, symmetries).median())
    gap = (max(1.0, sparse) * translation, max(1.0, sparse) * rotation)
    return cluster(distinct, *gap, symmetries), gap


def neighbour_entropy(address: str, neighbours: int = 3) -> Entropy:
    """Differential entropy by distances to neighbours, whatever the shape of the belief, copies merged.

    Kozachenko and Leonenko 1987, weighted as `bcppl.beliefs.entropy.nearest_neighbour_entropy` is, with one
    difference: the weight thereabouts is the mean over a particle and its k neighbours, so that it is not 0
    where a measurement leaves one particle alone. Distances are Mahalanobis distances of the population,
    and do not change with the weights. It asks for many particles: several hundred in six dimensions.

    Args:
        address: a latent one, of poses or of other real values.
        neighbours: k.

    Raises:
        InputError: k is no whole number, 1 or more; or (of what it returns) no latent site has that address,
            its values are whole numbers, all particles have the same or do not span its axes, or there are
            no more than k of them.
    """
    neighbours = whole_number("an entropy by {} neighbours was asked for", neighbours)

    def fitted(population: Population) -> EntropyOf:
        whole = torch.softmax(population.log_weights, 0)
        carrying = whole > 0
        weights = whole[carrying]
        if is_pose(population, address):
            belief = population.belief(address)
            distinct, which = distinct_poses(population[address][carrying])
            tangent = poses.local(belief.mean, distinct)
            coordinates = belief.freedom.coordinates(tangent)
            log_base = belief.freedom.log_base_density(tangent[:, 3:].norm(dim=-1))
        else:
            coordinates, which = _distinct_reals(population, address, carrying)
            log_base = torch.zeros(len(coordinates), dtype=torch.float64)
        count, dimension = coordinates.shape
        refuse_collapsed(address, count)
        if count <= neighbours:
            raise InputError(
                f"the belief over {address!r} has {count} distinct particles, too few for an entropy by "
                f"{neighbours} neighbours; use more particles, or weight_entropy()."
            )
        share = _summed(weights, which, count)
        centred = coordinates - share @ coordinates
        factor = spanning_factor(address, (share[:, None] * centred).T @ centred)
        white = torch.linalg.solve_triangular(factor, coordinates.T, upper=False).T.numpy()
        radius, near = cKDTree(white).query(white, k=neighbours + 1)
        about = torch.from_numpy(np.asarray(near))
        ball = 0.5 * dimension * math.log(math.pi) - math.lgamma(0.5 * dimension + 1.0)
        volume = ball + dimension * torch.from_numpy(np.asarray(radius)[:, -1]).log()
        volume = volume + float(factor.diagonal().log().sum())
        # The log-density of the belief is this plus the log of the mean weight thereabouts.
        log_particles = float(digamma(neighbours) - digamma(count)) + math.log(count) - volume
        summed = _summing(carrying, which, count)

        def entropy(weights: Tensor) -> Tensor:
            rows = max(1, AT_ONCE // about.numel())
            found = [
                -(part * (log_particles + _log(part[:, about].mean(dim=2)) - log_base)).sum(dim=1)
                for part in summed(weights).split(rows)
            ]
            return torch.cat(found)

        return entropy

    return fitted


def _log(shares: Tensor) -> Tensor:
    """Logs, finite where a share is 0: its weight is 0 as well then."""
    return shares.clamp_min(torch.finfo(torch.float64).tiny).log()


def _mean(world_from_part: Tensor, weights: Tensor) -> Tensor:
    return Belief(world_from_part, weights.log()).mean


def _summed(weights: Tensor, which: Tensor, count: int) -> Tensor:
    return torch.zeros(count, dtype=torch.float64).index_add_(0, which, weights)


def _summing(carrying: Tensor, which: Tensor, count: int) -> Callable[[Tensor], Tensor]:
    """The sums (M, count) of weights (M, N) over the particles that are copies of one another."""
    kept = carrying.nonzero().flatten()

    def summed(weights: Tensor) -> Tensor:
        total = torch.zeros(len(weights), count, dtype=torch.float64)
        return total.index_add_(1, which, weights.index_select(1, kept))

    return summed


def _distinct_reals(population: Population, address: str, carrying: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct values (K, D) at an address of real numbers, and which of them each particle has."""
    values = values_at(population, address)
    if not values.is_floating_point():
        raise InputError(
            f"the values at {address!r} are whole numbers, which have no density; "
            f"use value_entropy({address!r})."
        )
    distinct, which = torch.unique(
        values[carrying].to(torch.float64).reshape(int(carrying.sum()), -1), dim=0, return_inverse=True
    )
    refuse_collapsed(address, len(distinct))
    return distinct, which


def refuse_collapsed(address: str, distinct: int) -> None:
    """Raises where a belief has fewer than two distinct particles."""
    if distinct < 2:
        raise InputError(
            f"the belief over {address!r} has collapsed to a point: all particles with weight are the same, "
            "so no measurement can tell more; move them apart first (rejuvenation, or more particles)."
        )


def _refuse_one_particle(population: Population) -> None:
    carrying = (torch.softmax(population.log_weights, 0) > 0).nonzero().flatten()
    latent = [value.index_select(0, carrying) for value in population.trace.choices.values()]
    if all(bool((value == value[:1]).all()) for value in latent):
        raise InputError(
            "the belief has collapsed to a point: all particles with weight are the same, so no measurement "
            "can tell more; use more particles, or move them apart first (rejuvenation)."
        )
