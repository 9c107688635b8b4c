"""Independence proposals: a mixture fitted to particles, whatever the moved particle's value."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pyro
import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.inference.population import Population
from bcppl.inference.proposals.coordinates import Coordinates
from bcppl.inference.proposals.proposal import Fittable
from bcppl.inference.proposals.spread import (
    Places,
    conditioned,
    covariance_about_mean,
    weighted_places,
)
from bcppl.inference.resampling import systematic
from bcppl.inference.summaries import weighted_covariance
from bcppl.traces import Trace

MOST_FITTED = 1000  # particles; their covariance is accurate to a few percent
ROUNDS = 10  # of expectation maximisation; more hardly change the acceptance


def independent(
    address: str,
    components: int | None = 2,
    *,
    inflation: float = 1.05,
    wide: tuple[float, float] = (0.05, 2.0),
) -> Fittable:
    """A proposal from a mixture of normals fitted to the particles, independent of the particle's value.

    The independence sampler of Tierney (Annals of Statistics 22, 1994, section 2.3.3). One more component is
    wider than the whole population: it bounds the ratio of target to proposal in the tails, where particles
    would be stuck (Hesterberg, Weighted average importance sampling and defensive mixture distributions,
    Technometrics 37, 1995). Poses are fitted in their tangent spaces, other values in unbounded coordinates
    of their support. Of more than a thousand particles a thousand are resampled for the fit.

    D coordinates have D (D + 3) / 2 means and covariances to learn from half of the particles. Where these
    are not several times as many, hardly a move is accepted, the population dies out, and evidence is off by
    nats: that of a Gaussian of D = 50 by +5.6 +- .4 with 1,000 particles (hmc: -.12 +- .05), of D = 100 by
    +45 +- 2. Where they are, a normal that is wider along every axis keeps particles near the
    mode from moving: with 10,000 and one component an inflation of 1.05 leaves -.34 +- .07 at D = 50, and
    1.006 nothing (`benchmarks/exact.py`); give 1.05^(6 / D).

    Args:
        address: of the latent value.
        components: the number of normals, fitted by expectation maximisation; None for a kernel density
            estimate, one normal at every particle, its width by Silverman's rule (Density Estimation, 1986,
            eq. 4.14).
        inflation: factor of the fitted standard deviations.
        wide: the weight of the wide component, and its standard deviations in the population's.

    Raises:
        InputError: no whole number of components, a weight not in (0, 1), or a factor not above 0; when it is
            fitted: the address is not latent, or is discrete.
    """
    if components is not None:
        components = whole_number("an independent proposal is given {} components", components)
    inflation = number_within("an independent proposal is given the inflation {}", inflation, above=0.0)
    share, width = wide
    what = "the wide component of an independent proposal has the"
    share = number_within(f"{what} weight {{}}", share, above=0.0, below=1.0)
    width = number_within(f"{what} width {{}}", width, above=0.0)

    def fit(population: Population) -> Callable[[Trace], None]:
        fitted = weighted_places(population, address)
        if len(population) > MOST_FITTED:
            drawn = fitted.places[systematic(fitted.weights.log(), MOST_FITTED)]
            alike = fitted.weights.new_full((MOST_FITTED,), 1.0 / MOST_FITTED)
            fitted = fitted._replace(places=drawn, weights=alike)
        known, places, weights, *_ = fitted
        mixture = _kernel_density(fitted) if components is None else _maximised(fitted, components)
        whole = covariance_about_mean(fitted)
        shares = torch.cat([mixture.log_weights.exp() * (1.0 - share), weights.new_tensor([share])])
        centers = torch.cat([mixture.centers, known.mean(places, weights)[None]])
        covariances = torch.cat([inflation**2 * mixture.covariances, width**2 * whole[None]])

        def independently(trace: Trace) -> None:
            pyro.sample(address, known.of(trace).mixture(shares.log(), centers, covariances))

        return independently

    return Fittable(fit)


class Mixture(NamedTuple):
    """A fitted mixture: normalised log weights (K,), places (K, ...), covariances (K, d, d)."""

    log_weights: Tensor
    centers: Tensor
    covariances: Tensor


def _kernel_density(fitted: Places) -> Mixture:
    """A kernel density estimate: a normal at every particle, of Silverman's width."""
    coordinates, places, weights, *_ = fitted
    dimension, effective = coordinates.dimension, float(1.0 / (weights**2).sum())
    width = (4.0 / (dimension + 2.0)) ** (1.0 / (dimension + 4.0)) * effective ** (-1.0 / (dimension + 4.0))
    whole = covariance_about_mean(fitted)
    return Mixture(weights.log(), places, (width**2 * whole).expand(len(places), -1, -1))


def _maximised(fitted: Places, components: int) -> Mixture:
    """A mixture fitted by expectation maximisation, its covariances shrunk towards the pooled one.

    They are posterior modes under an inverse Wishart prior at the pooled covariance, worth as many particles
    as there are coordinates (Fraley and Raftery, Journal of Classification 24, 2007, section 3).
    """
    coordinates, places, weights, *_ = fitted
    dimension, particles, prior = coordinates.dimension, len(places), torch.diag(fitted.least)
    centers = places[_apart(fitted, components)]
    components = len(centers)
    steps = torch.stack([coordinates.steps(center, places) for center in centers])
    metric = (weighted_covariance(steps[0], weights) + prior).diagonal()
    nearest = (steps.square() / metric).sum(dim=-1).argmin(dim=0)
    shares = torch.nn.functional.one_hot(nearest, components).T.to(torch.float64)
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
                weighted_covariance(coordinates.steps(center, places), each) + prior
                for center, each in zip(centers, within, strict=True)
            ]
        )
        # As of few particles whatever their number: the more there are, the less this counts.
        pooled = conditioned((masses[:, None, None] * covariances).sum(dim=0), dimension)
        counts = (masses * particles)[:, None, None]
        covariances = (counts * covariances + dimension * pooled) / (counts + dimension)
        mixture = Mixture(masses.log(), centers, covariances)
        if len(masses) == 1:
            break
        shares = _shares(coordinates, mixture, places)
    assert mixture is not None
    return mixture


def _shares(coordinates: Coordinates, mixture: Mixture, places: Tensor) -> Tensor:
    """Responsibilities (K, N) of the components for each particle, in the tangent spaces at their centres."""
    each = []
    for share, center, covariance in zip(*mixture, strict=True):
        scale = torch.linalg.cholesky(covariance)
        score = torch.linalg.solve_triangular(scale, coordinates.steps(center, places).T, upper=False)
        each.append(share - scale.diagonal().log().sum() - 0.5 * score.square().sum(dim=0))
    return torch.softmax(torch.stack(each), dim=0)


def _apart(fitted: Places, count: int) -> Tensor:
    """Initial centres: the indices (K,), K at most `count`, of particles far apart from one another.

    Arthur and Vassilvitskii, k-means++: the advantages of careful seeding, SODA 2007.
    """
    coordinates, places, weights, *_ = fitted
    chosen = [int(torch.multinomial(weights, 1))]
    metric = covariance_about_mean(fitted).diagonal()
    nearest = torch.full_like(weights, torch.inf)
    while len(chosen) < count:
        apart = (coordinates.steps(places[chosen[-1]], places).square() / metric).sum(dim=-1)
        nearest = torch.minimum(nearest, apart)
        if not bool((weights * nearest).sum() > 0.0):
            break
        chosen.append(int(torch.multinomial(weights * nearest, 1)))
    return torch.tensor(chosen)
