"""Independent proposals: a mixture fitted to particles, that does not ask where the moved particle is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import pyro
import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.proposals.coordinates import Coordinates
from bcppl.inference.proposals.proposal import Fitted
from bcppl.inference.proposals.spread import FLOOR, conditioned, covariance_of, learned_from
from bcppl.inference.schemes import systematic
from bcppl.traces import Trace

TEACHERS = 1000  # a covariance of these is right to a few percent
ROUNDS = 10  # of expectation maximisation: what is left to gain hardly shows in the acceptance


def independent(
    address: str,
    components: int | None = 2,
    *,
    inflation: float = 1.05,
    wide: tuple[float, float] = (0.05, 2.0),
) -> Fitted:
    """A value drawn from a mixture of normals that is fitted to the particles, wherever the particle was.

    The independence sampler of Tierney (Annals of Statistics 22, 1994, section 2.3.3). One component more is
    as wide as the whole population, and wider: it keeps the ratio of target to proposal from growing in the
    tails, where particles would be stuck (Hesterberg, Weighted average importance sampling and defensive
    mixture distributions, Technometrics 37, 1995). Poses are fitted in their tangent spaces, other
    values in unbounded coordinates of their support. Of more than a thousand particles a thousand, drawn by
    weight, are learned from.

    Args:
        address: which latent value to move.
        components: how many normals are fitted by expectation maximisation; None for a kernel density, one
            normal at every particle, its width by Silverman's rule (Density Estimation, 1986, eq. 4.14).
        inflation: what the fitted standard deviations are multiplied by.
        wide: the chance of the wide component, and its standard deviations in the population's.

    Raises:
        InputError: no whole number of components, a chance not in (0, 1), or a factor not above 0; when it is
            fitted: the address is not latent, or is discrete.
    """
    if components is not None:
        components = whole_number("an independent proposal is given {} components", components)
    inflation = number_within("an independent proposal is given the inflation {}", inflation, above=0.0)
    if not isinstance(wide, Sequence) or len(wide) != 2:
        raise InputError(
            f"the wide component of an independent proposal is {wide!r}; give its chance and its width."
        )
    chance = number_within(
        "the wide component of an independent proposal has the chance {}", wide[0], above=0.0, below=1.0
    )
    width = number_within(
        "the wide component of an independent proposal has the width {}", wide[1], above=0.0
    )

    def fit(population: Population) -> Callable[[Trace], None]:
        known, places, weights = learned_from(population, address)
        if len(population) > TEACHERS:
            places = places[systematic(weights.log(), TEACHERS)]
            weights = weights.new_full((TEACHERS,), 1.0 / TEACHERS)
        if components is None:
            mixture = _kernel_density(known, places, weights)
        else:
            mixture = _maximised(known, places, weights, components)
        mean = known.mean(places, weights)
        whole = conditioned(covariance_of(known.steps(mean, places), weights))
        shares = torch.cat([mixture.log_weights.exp() * (1.0 - chance), weights.new_tensor([chance])]).log()
        centers = torch.cat([mixture.centers, mean[None]])
        covariances = torch.cat([inflation**2 * mixture.covariances, width**2 * whole[None]])

        def anew(trace: Trace) -> None:
            pyro.sample(address, known.of(trace).mixture(shares, centers, covariances))

        return anew

    return Fitted(fit)


class Mixture(NamedTuple):
    """A fitted mixture: normalised log weights (K,), places (K, ...), covariances (K, d, d)."""

    log_weights: Tensor
    centers: Tensor
    covariances: Tensor


def _kernel_density(coordinates: Coordinates, places: Tensor, weights: Tensor) -> Mixture:
    """A normal at every particle, as wide as its neighbours are apart."""
    dimension, effective = coordinates.dimension, float(1.0 / (weights**2).sum())
    width = (4.0 / (dimension + 2.0)) ** (1.0 / (dimension + 4.0)) * effective ** (-1.0 / (dimension + 4.0))
    steps = coordinates.steps(coordinates.mean(places, weights), places)
    whole = conditioned(covariance_of(steps, weights))
    return Mixture(weights.log(), places, (width**2 * whole).expand(len(places), -1, -1))


def _maximised(coordinates: Coordinates, places: Tensor, weights: Tensor, components: int) -> Mixture:
    """Expectation maximisation; covariances from few particles are drawn towards what they have in common.

    That is the mode under an inverse Wishart prior at the pooled covariance, of as many particles as there
    are coordinates (Fraley and Raftery, Journal of Classification 24, 2007, section 3).
    """
    dimension, particles = coordinates.dimension, len(places)
    centers = places[_apart(coordinates, places, weights, components)]
    components = len(centers)
    steps = torch.stack([coordinates.steps(center, places) for center in centers])
    metric = conditioned(covariance_of(steps[0], weights)).diagonal()
    nearest = (steps.square() / metric).sum(dim=-1).argmin(dim=0)
    shares = torch.nn.functional.one_hot(nearest, components).T.to(torch.float64)
    floor = FLOOR**2 * torch.eye(dimension, dtype=torch.float64)
    mixture = None
    for _ in range(ROUNDS if components > 1 else 1):
        masses = (shares * weights).sum(dim=1)
        kept = masses * particles > 1.0
        kept = kept if bool(kept.any()) else masses == masses.max()
        masses, shares = masses[kept] / masses[kept].sum(), shares[kept]
        within = shares * weights / (shares * weights).sum(dim=1, keepdim=True)
        centers = torch.stack([coordinates.mean(places, each) for each in within])
        covariances = torch.stack(
            [
                covariance_of(coordinates.steps(center, places), each)
                for center, each in zip(centers, within, strict=True)
            ]
        )
        pooled = conditioned((masses[:, None, None] * covariances).sum(dim=0))
        counts = (masses * particles)[:, None, None]
        covariances = (counts * covariances + dimension * pooled) / (counts + dimension) + floor
        mixture = Mixture(masses.log(), centers, covariances)
        if len(masses) == 1:
            break
        shares = _shares(coordinates, mixture, places)
    assert mixture is not None
    return mixture


def _shares(coordinates: Coordinates, mixture: Mixture, places: Tensor) -> Tensor:
    """How much of each particle (K, N) belongs to each component, in the tangent spaces at their centres."""
    each = []
    for share, center, covariance in zip(*mixture, strict=True):
        scale = torch.linalg.cholesky(covariance)
        score = torch.linalg.solve_triangular(scale, coordinates.steps(center, places).T, upper=False)
        each.append(share - scale.diagonal().log().sum() - 0.5 * score.square().sum(dim=0))
    return torch.softmax(torch.stack(each), dim=0)


def _apart(coordinates: Coordinates, places: Tensor, weights: Tensor, count: int) -> Tensor:
    """Particles (K,) far apart from one another, K at most `count`.

    Drawn as by Arthur and Vassilvitskii, k-means++: the advantages of careful seeding, SODA 2007.
    """
    chosen = [int(torch.multinomial(weights, 1))]
    metric = conditioned(
        covariance_of(coordinates.steps(coordinates.mean(places, weights), places), weights)
    ).diagonal()
    nearest = torch.full_like(weights, torch.inf)
    while len(chosen) < count:
        apart = (coordinates.steps(places[chosen[-1]], places).square() / metric).sum(dim=-1)
        nearest = torch.minimum(nearest, apart)
        if not bool((weights * nearest).sum() > 0.0):
            break
        chosen.append(int(torch.multinomial(weights * nearest, 1)))
    return torch.tensor(chosen)
