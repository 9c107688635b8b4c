"""How surprising each measurement is under the belief: posterior predictive checks.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling
    from bcppl.inference.criticism import surprise

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    population = importance_sampling(weighed, (), {"reading": torch.tensor(2.4).double()}, 1000)
    print(surprise(population))  # by address

A belief that is sure and wrong often shows in what was measured: an image that no pose explains, for
something unknown stands before the camera; a camera that would have to be farther off than its stated error;
contacts where the belief has none. Such a measurement is one whose p value is small: the probability that
a measurement as unlikely, or more so, comes of the model at the particles' values, averaged over them.

The check compares the whole measurement with the belief that it helped to make, so p values are rather too
large than too small: seldom below 0.1 where all is well. Warn far below that.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.arguments import address_list, whole_number
from bcppl.devices import HOST, on_host
from bcppl.distributions.checks import Check, Checked, chi_square
from bcppl.distributions.poses import NormalPose
from bcppl.inference.population import Population
from bcppl.inference.resampling import seeded, systematic
from bcppl.traces import Trace
from bcppl.traces.run import inward
from bcppl.traces.series import SeriesTrace
from bcppl.traces.verbs import trace_to_device

PARTICLES = 4
REPLICAS = 10  # images for each particle


def surprise(
    population: Population,
    addresses: Collection[str] | str | None = None,
    *,
    particles: int = PARTICLES,
    replicas: int = REPLICAS,
    seed: int = 0,
) -> Mapping[str, Check]:
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
        addresses: those to be checked, or one; all of the trace unless given. Others are left out silently.
        particles: of the population, drawn by weight, at which it is checked.
        replicas: images drawn for each of them.
        seed: same seed, same p values.

    Raises:
        InputError: a number is out of range.
        InferenceError: no particle has any weight.
    """
    particles = whole_number("a surprise is to be taken over {} particles", particles)
    replicas = whole_number("a surprise is to be taken of {} replicas", replicas, least=2)
    trace = population.trace
    if isinstance(trace, SeriesTrace):
        return {}
    asked = address_list(trace.addresses if addresses is None else addresses)
    wanted = [a for a in trace.addresses if a in trace and a in asked]
    checks: dict[str, Check] = {}
    with seeded(seed), torch.no_grad():
        chosen = systematic(population.log_weights, particles)
        # They are few: on the host, wherever the particles are.
        few = trace_to_device(trace.chosen(chosen), HOST)
        copies: list[Trace] = []

        def replicated(address: str) -> Any:
            if not copies:
                copies.append(few.chosen(torch.arange(particles).repeat_interleave(replicas)))
            return copies[0].distributions[address]

        with on_host():
            for address in wanted:
                site, value = few.distributions[address], few[address]
                if isinstance(site, Checked):
                    check = site.predictive_check(value, partial(replicated, address))
                    if check is not None:
                        checks[address] = check
                else:
                    error = _whitened(site, value, particles)
                    if error is not None:
                        checks[address] = chi_square(error.square().sum(dim=-1), error.shape[-1])
    return checks


def _whitened(site: Any, value: Tensor, particles: int) -> Tensor | None:
    """A value as numbers (P, d) that are standard normal; None where the site is not normal."""
    given = site
    while isinstance(site, dist.Independent | dist.MaskedDistribution | dist.ExpandedDistribution):
        if isinstance(site, dist.MaskedDistribution):
            return None
        site = site.base_dist
    if not isinstance(site, NormalPose | torch.distributions.Normal | torch.distributions.MultivariateNormal):
        return None
    # The particles are the last axis of the batch, behind the plates.
    batch, value = given.batch_shape, inward(value, given)
    if isinstance(site, NormalPose):
        error, scale = site.coordinates(value), torch.linalg.cholesky(site.covariance)
    elif isinstance(site, torch.distributions.Normal):
        error, scale = (value - site.mean) / site.stddev, None
    else:
        error, scale = value - site.mean, site.scale_tril
    if scale is not None:
        error = torch.linalg.solve_triangular(scale, error[..., None], upper=False)[..., 0]
    whole = error.double().expand(*batch, *error.shape[len(batch) :])
    return whole.movedim(len(batch) - 1, 0).reshape(particles, -1)
