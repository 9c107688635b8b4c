"""Physics is run for few: a cheap likelihood chooses among copies of the particles, and moves them first.

Contact physics takes a hundred times as long as the gap between two solids. Where a likelihood is simulated
and another one of the same measurements is cheap (`bcppl.sensors.capabilities.Screens`), the cheap one takes
its place in a target of its own. At each measurement the particles are weighted for that target, copied,
given the measurement, resampled and moved, all without physics; then each is simulated once and weighted by
the ratio of the posterior to the cheap target. Every stage is a proper weighting (Naesseth, Lindsten and
Schoen, Nested sequential Monte Carlo methods, ICML 2015), so the result targets the posterior whatever the
cheap likelihood is; a poor one costs effective particles. Where these are few, particles are resampled, and
moved by transitions that the cheap target decides first (`bcppl.inference.kernels.surrogate_transition`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl.errors import NoWeightError
from bcppl.inference.filters.smcp3 import Pair, move_and_weight
from bcppl.inference.filters.step import Observed
from bcppl.inference.kernels.rejuvenation import Moved
from bcppl.inference.kernels.staged import SurrogateTarget
from bcppl.inference.population import Population
from bcppl.inference.resampling import systematic
from bcppl.inference.sizing import replicate
from bcppl.inference.targets import PHYSICS, POSTERIOR, Target, cost_of
from bcppl.traces import Trace, Update, propose
from bcppl.traces.verbs import constrained

COPIES = 12  # of each particle, that are weighted by the cheap target


def approximated(population: Population) -> Callable[[Trace], Tensor]:
    """A surrogate of the log-density of a trace: what is approximated takes the place of physics."""
    approximation = population.approximation
    return lambda trace: _cheap_log_density(trace, approximation)


class Survivors(NamedTuple):
    """A population given one more measurement.

    Attributes:
        population: of N particles.
        origin: (N,) which particle each was made of.
        moved: what moves by the cheap target did.
    """

    population: Population
    origin: Tensor
    moved: Moved


def screened(
    population: Population,
    before: Any,
    observed: Observed,
    pair: Pair,
    moves: Callable[[Population, Target], Moved],
    copies: int = COPIES,
) -> Survivors | None:
    """N particles given one more measurement, of copies that the cheap target has weighted and moved.

    Args:
        population: of N particles, whose approximation is given the measurement.
        before: the approximation that is not.
        observed: the measurement; latent values that come with it are drawn from the program.
        pair: moves a particle.
        moves: of the particles that survive, towards a target.
        copies: of each particle.

    Returns:
        None where no particle keeps any weight.
    """
    after = population.approximation

    def ratio(updated: Update) -> Tensor:
        now, then = _cheap_log_density(updated.trace, after), _cheap_log_density(updated.previous, before)
        # What came with the measurement was drawn from the program.
        return now - then - (updated.trace.log_prob(*updated.drawn) if updated.drawn else 0.0)

    # What the physics of the measurements before has decided is divided out, and decided again at the end.
    weighing = _cheap_log_density(population.trace, before) - POSTERIOR(population.trace)
    alive = population.log_weights > -torch.inf
    try:
        many = replicate(population.reweighed(torch.where(alive, weighing, 0.0)), copies)
        by_cheap = move_and_weight(many, pair, observed, ratio)
        chosen = by_mode(by_cheap, len(population))
        few = by_cheap.selected(chosen)
        few = few.with_trace(few.trace.without_states())
        moved = moves(few, SurrogateTarget(log_density=approximated(few)))
        few = moved.population
        weighed = few.reweighed(POSTERIOR(few.trace) - _cheap_log_density(few.trace, after))
        return Survivors(weighed, chosen // copies, moved)
    except NoWeightError:
        return None


def screened_draws(
    trace: Trace,
    approximation: Any,
    proposal: Callable[..., Any],
) -> Population:
    """As many particles as a trace has, of draws of a proposal that the cheap target has weighted.

    Args:
        trace: the program, its arguments and its observations.
        approximation: given all of these.
        proposal: of all latent values.

    Raises:
        NoWeightError: none has any weight.
    """
    count = COPIES * trace.particles
    proposed = propose(proposal, trace.args, count)
    drawn, _ = constrained(trace.program, trace.args, count, trace.observations, proposed.choices)
    log_weights = _cheap_log_density(drawn, approximation) - proposed.log_prob
    many = Population(drawn, log_weights, approximation=approximation)
    few = many.selected(by_mode(many, trace.particles))
    return few.reweighed(POSTERIOR(few.trace) - _cheap_log_density(few.trace, approximation))


def by_mode(population: Population, count: int) -> Tensor:
    """Systematic ancestors (count,), so that each mode keeps its share but for one particle."""
    order = population.approximation.stratum(population.trace).argsort(stable=True)
    return order[systematic(population.log_weights[order], count)].sort().values


def _cheap_log_density(trace: Trace, approximation: Any) -> Tensor:
    cheap = [address for address, site in trace.distributions.items() if cost_of(site) < PHYSICS]
    likelihood: Tensor = approximation.log_likelihood(trace)
    return trace.log_prob(*cheap) + likelihood
