"""A search for other modes where an image refutes all particles.

An image is approximated by a fit that starts from draws of the prior and ends in one mode, or its images
under a part's near symmetries. Where the prior is wide the part is sometimes elsewhere. Then the image is
improbable under its posterior predictive distribution, or no particle explains it better than no part does:
the part is believed to be where nothing was measured. Climbs from all over the prior, in all images together
(`bcppl.inference.proposals.climbing`), lead to other modes; fits follow these too, and particles drawn from
the new approximation are joined with the old by evidence (`bcppl.inference.filters.second_search`).

The check renders `PARTICLES` times `REPLICAS` images (`bcppl.inference.criticism.predictive`), and draws from
a generator of its own. A search costs about `CLIMBS` * 8 + 4,000 renderings of each image, and
`COPIES` for each particle: some ten times a view's own step.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import torch

from bcppl.distributions.checks import THRESHOLD
from bcppl.distributions.depth import DepthDistribution
from bcppl.distributions.support import freedom_of
from bcppl.errors import NoWeightError
from bcppl.inference.criticism.predictive import surprise
from bcppl.inference.filters.second_search import Searched, pooled_with_draws
from bcppl.inference.population import Population
from bcppl.inference.proposals.climbing import modes
from bcppl.traces import Trace, generate

CLIMBS = 960
SHOWN = 10.0  # nats: an image that shows the part is at least so much more probable with it than without


def is_refuted(population: Population, addresses: Collection[str]) -> bool:
    """Whether sites are improbable under their posterior predictive distributions, or show no part."""
    trace = population.trace
    for address in addresses:
        site = trace.distributions[address]
        if isinstance(site, DepthDistribution):
            gain = trace.log_prob(address) - site.without_part(trace[address])
            if bool((gain < SHOWN).all()):
                return True
    checks = surprise(population, addresses)
    return bool(checks) and len(checks) * min(c.probability for c in checks.values()) < THRESHOLD


def searched_by_climbing(
    population: Population,
    pose: str,
    approximated: Callable[[Trace, torch.Tensor], Any],
    proposal: Callable[[Any], Callable[..., Any]],
) -> Searched:
    """The population, joined by evidence with one about the modes that climbs lead to.

    Args:
        population: weighted for all measurements of its trace.
        pose: the address of the part's pose.
        approximated: the approximation given a trace's measurements, their fits following poses (K, 7).
        proposal: of all latent values, given the approximation.
    """
    trace = population.trace
    climbers, _ = generate(trace.program, trace.args, trace.observations, CLIMBS)
    # Cameras that err see the part where it is while it climbs: their other errors are 0.
    along = [a for a in climbers.choices if a != pose and freedom_of(climbers.distributions[a]) is not None]
    others = [a for a in climbers.choices if a != pose and a not in along]
    climbers = climbers.at({a: torch.zeros_like(climbers[a]) for a in others})
    try:
        ends = modes(climbers, pose, along)
    except NoWeightError:
        return Searched(population)
    return pooled_with_draws(population, approximated(trace, ends.centers), proposal)
