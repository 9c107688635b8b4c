"""How surprising each measurement is under the belief: posterior predictive checks.

A belief that is sure and wrong often shows in what was measured: an image that no pose explains, for
something unknown stands before the camera; a camera that would have to be farther off than it is said to be;
contacts where the belief has none. Such a measurement is one whose p value is small: the probability that
a measurement as unlikely, or more so, comes of the model at the particles' values, averaged over them.

The check compares the whole measurement with the belief that it helped to make, so p values are rather too
large than too small: seldom below 0.1 where all is well. Warn far below that.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import pyro.distributions as dist
import torch
from scipy.stats import binom, chi2, norm
from torch import Tensor

from bcppl import poses
from bcppl.arguments import seed_number, whole_number
from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.manifold import ContactManifold
from bcppl.distributions.poses import NormalPose
from bcppl.inference.population import Population
from bcppl.inference.resampling import systematic
from bcppl.traces import Trace
from bcppl.traces.series import SeriesTrace

# p values below it are worth a warning. On the accuracy bench none of 318 measurements of 23 scenes that are
# as stated came below it, and one of 60 images in looks alone; all of 8 occluders came below 1e-38.
THRESHOLD = 1e-3
PARTICLES = 4
REPLICAS = 10  # images for each particle
DEEP = 4.0  # standard deviations by which a stamp without contact is well within the part


class Surprise(NamedTuple):
    """How well one address fits the belief.

    Attributes:
        probability: the p value, from 0 to 1, averaged over particles.
        kind: "image", "contacts", or "normal" for a latent or observed value with a normal distribution.
        excess: how far off it is in standard deviations of what the model would give: of an image's
            log-density, of the chi-square of contacts or of a normal value.
    """

    probability: float
    kind: str
    excess: float

    @property
    def surprising(self) -> bool:
        """Whether it is worth a warning: below `THRESHOLD`."""
        return self.probability < THRESHOLD


def surprise(
    population: Population,
    addresses: Collection[str] | None = None,
    *,
    particles: int = PARTICLES,
    replicas: int = REPLICAS,
    seed: int = 0,
) -> Mapping[str, Surprise]:
    """The check of every address that can be checked for little, in the trace's order.

    - A depth image (any `DepthDistribution`): images are drawn at the particles' values, missing where the
      observed one is, and their log-densities compared with the observed one's: the discrepancy is
      -log p(y | theta) (Gelman, Meng and Stern, Posterior predictive assessment of model fitness via realized
      discrepancies, Statistica Sinica 6, 1996), which is a sum over pixels and so nearly normal. A power of
      the likelihood (`temperature`, `effective_pixels`) changes neither the draws nor the order.
    - Contacts (`ContactManifold`): squares of its residuals, whitened by its noise and shared error, against
      chi-square, and how many stamps without contact lie four standard deviations deep in the part against
      how many outliers there may be. The less of the two p values, doubled.
    - A latent or observed value that is normal given the others (`Normal`, `MultivariateNormal`,
      `NormalPose`), such as a camera's error: its square, whitened, against chi-square. Of a draw of the
      posterior it has that distribution exactly (Johnson, Bayesian model assessment using pivotal quantities,
      Bayesian Analysis 2, 2007).

    Other addresses are left out: those that take physics to be drawn, those that the program observes itself
    (`obs=`), and all of a `Series`. It draws from a generator of its own.

    Args:
        population: the particles.
        addresses: those to be checked; all of the trace unless given. Others are left out silently.
        particles: of the population, drawn by weight, at which it is checked.
        replicas: images drawn for each of them.
        seed: same seed, same p values.

    Raises:
        InputError: a number is out of range.
        InferenceError: no particle has any weight.
    """
    particles = whole_number("a surprise is to be taken over {} particles", particles)
    replicas = whole_number("a surprise is to be taken of {} replicas", replicas, least=2)
    seed_number(seed)
    trace = population.trace
    if isinstance(trace, SeriesTrace):
        return {}
    wanted = [a for a in trace.addresses if a in trace and (addresses is None or a in addresses)]
    found: dict[str, Surprise] = {}
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        chosen = systematic(population.log_weights, particles)
        few = trace.chosen(chosen)
        many: Trace | None = None
        for address in wanted:
            site, value = few.distributions[address], few[address]
            if isinstance(site, DepthDistribution):
                many = trace.chosen(chosen.repeat_interleave(replicas)) if many is None else many
                found[address] = _of_image(site, many.distributions[address], value, particles)
            elif isinstance(site, ContactManifold):
                if bool((value[:, 7] == value[:, 7]).any()):
                    found[address] = _of_contacts(site, value)
            else:
                error = _whitened(site, value, particles)
                if error is not None:
                    found[address] = _of_squares(error.square().sum(dim=-1), error.shape[-1])
    return found


def _of_image(site: Any, many: Any, image: Tensor, particles: int) -> Surprise:
    """An image (H, W) at P particles, and at R copies of each."""
    observed = -site.log_prob(image)
    replicated = -many.log_prob(_drawn_like(site, many, image)).reshape(particles, -1)
    # One spread for all: that of a sum over pixels hardly hangs on the pose.
    spread = float(replicated.var(dim=1).mean().sqrt())
    if not spread > 0.0:  # no pixel of the image counts
        return Surprise(1.0, "image", 0.0)
    excess = (observed - replicated.mean(dim=1)) / spread
    return Surprise(float(norm.sf(excess.numpy()).mean()), "image", float(excess.mean()))


def _drawn_like(site: Any, many: Any, image: Tensor) -> Tensor:
    """Images (P * R, H, W) drawn from the model, missing where the observed one is."""
    missing = torch.from_numpy(~site.observed(image).valid.any(axis=0)).reshape(image.shape)
    return torch.where(missing, torch.nan, many.sample())


def _of_contacts(site: ContactManifold, window: Tensor) -> Surprise:
    """A window (T, 8) of stamps."""
    residual, felt = site.residual(window), window[:, 7]
    contact, free = residual[:, felt == 1.0], residual[:, felt == 0.0]
    variance, common, count = site.noise**2, site.shared**2, contact.shape[1]
    share = common / (variance + count * common)
    squared = (contact.square().sum(dim=1) - share * contact.sum(dim=1).square()) / variance
    whole = _of_squares(squared, count) if count else Surprise(1.0, "contacts", 0.0)
    deep = (free < -DEEP * math.hypot(site.noise, site.shared)).sum(dim=1)
    outliers = float(binom.sf(deep.numpy() - 1, free.shape[1], site.outlier).mean())
    least = min(whole.probability, outliers)
    return Surprise(min(1.0, 2.0 * least), "contacts", whole.excess)


def _of_squares(squared: Tensor, degrees: int) -> Surprise:
    """Sums (P,) of so many squares of normal numbers."""
    probability = float(chi2.sf(squared.numpy(), degrees).mean())
    return Surprise(
        probability, "normal", float((squared.double().mean() - degrees) / math.sqrt(2.0 * degrees))
    )


def _whitened(site: Any, value: Tensor, particles: int) -> Tensor | None:
    """A value as numbers (P, d) that are standard normal; None where the site is not normal."""
    while isinstance(site, dist.Independent | dist.MaskedDistribution | dist.ExpandedDistribution):
        if isinstance(site, dist.MaskedDistribution):
            return None
        site = site.base_dist
    if isinstance(site, NormalPose):
        error = poses.local(site.center, value)[..., site.freedom.axes]
        scale = torch.linalg.cholesky(site.covariance)
    elif isinstance(site, torch.distributions.Normal):
        error = (value - site.mean) / site.stddev
        return error.double().expand(particles, *error.shape[1:]).reshape(particles, -1)
    elif isinstance(site, torch.distributions.MultivariateNormal):
        error, scale = value - site.mean, site.scale_tril
    else:
        return None
    white = torch.linalg.solve_triangular(scale, error[..., None], upper=False)[..., 0]
    return white.double().reshape(particles, -1) if white.shape[0] == particles else None
