"""Physics is run for few: a cheap likelihood chooses among copies of the particles, and moves them first.

Contact physics takes a hundred times as long as the gap between two solids. Where a likelihood is simulated
and another one of the same measurements is cheap (`bcppl.sensors.capabilities.Screens`), the cheap one takes
its place in a target of its own: copies of the particles are weighted for that and resampled, and only those
that survive are simulated and weighted by what remains, the ratio of the two targets. Where physics has said
little beyond the cheap target so far, the particles are weighted for that target before, and survivors are
moved by it, so that each is simulated once. All are proper weightings (Naesseth, Lindsten and Schoen, Nested
sequential Monte Carlo methods, ICML 2015), so the result targets the posterior whatever the cheap likelihood
is; a poor one costs effective particles. In other moves it is the surrogate of transitions
(`bcppl.inference.kernels.surrogate_transition`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bcppl.inference.filters.smcp3 import Pair, move_and_weight
from bcppl.inference.filters.step import Assimilated, Observed
from bcppl.inference.kernels.kernel import marked
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


marked(approximated, reversible=False, learns=False)


def screened(
    population: Population, before: Any, observed: Observed, pair: Pair, copies: int = COPIES
) -> Assimilated:
    """N particles given one more measurement, of copies that the cheap target has weighted.

    What physics has decided about a particle before stays with its copies.

    Args:
        population: of N particles, whose approximation is given the measurement.
        before: the approximation that is not.
        observed: the measurement; latent values that come with it are drawn from the program.
        pair: moves a particle.
        copies: of each particle.

    Raises:
        NoWeightError: no particle keeps any weight.
    """
    few, origin = _survivors(population, before, observed, pair, copies)
    decided = _beyond(population.trace[origin], before)
    simulated = few.reweighed(_beyond(few.trace, few.approximation) - decided)
    return Assimilated(simulated, simulated.effective_sample_size, origin)


def screened_and_moved(
    population: Population,
    before: Any,
    observed: Observed,
    pair: Pair,
    moves: Callable[[Population, Target], Moved],
    least: float,
    copies: int = COPIES,
) -> Assimilated | None:
    """The same, where survivors are moved by the cheap target before each is simulated.

    What physics has decided before is divided out, and decided again for the particles where they are then.

    Args:
        population: as for `screened`.
        before: as for `screened`.
        observed: the measurement.
        pair: moves a particle.
        moves: of particles towards a target.
        least: the effective sample size that physics is to leave, before and after the measurement.
        copies: of each particle.

    Returns:
        None where it leaves less: then physics says much beyond the cheap target, and is not to be lost.

    Raises:
        NoWeightError: no particle keeps any weight.
    """
    alive = population.log_weights > -torch.inf
    by_cheap = population.reweighed(torch.where(alive, -_beyond(population.trace, before), 0.0))
    if by_cheap.effective_sample_size < least:
        return None
    few, origin = _survivors(by_cheap, before, observed, pair, copies)
    few = few.with_trace(few.trace.without_states())
    moved = moves(few, SurrogateTarget(log_density=approximated(few)))
    simulated = moved.population.reweighed(_beyond(moved.population.trace, few.approximation))
    effective = simulated.effective_sample_size
    return Assimilated(simulated, effective, origin, moved) if effective >= least else None


def _survivors(
    population: Population, before: Any, observed: Observed, pair: Pair, copies: int
) -> tuple[Population, Tensor]:
    """N of the copies, which the cheap target has weighted, and which particle (N,) each was made of."""
    after = population.approximation

    def ratio(updated: Update) -> Tensor:
        now, then = _cheap_log_density(updated.trace, after), _cheap_log_density(updated.previous, before)
        # What came with the measurement was drawn from the program.
        return now - then - (updated.trace.log_prob(*updated.drawn) if updated.drawn else 0.0)

    # All are moved: what has been simulated for where they were would be copied, and never asked for.
    begun = population.with_trace(population.trace.without_states())
    by_cheap = move_and_weight(replicate(begun, copies), pair, observed, ratio)
    chosen = by_mode(by_cheap, len(population))
    return by_cheap.selected(chosen), chosen // copies


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
    return few.reweighed(_beyond(few.trace, approximation))


def by_mode(population: Population, count: int) -> Tensor:
    """Systematic ancestors (count,), so that each mode keeps its share but for one particle."""
    order = population.approximation.stratum(population.trace).argsort(stable=True)
    return order[systematic(population.log_weights[order], count)].sort().values


def _cheap_log_density(trace: Trace, approximation: Any) -> Tensor:
    cheap = [address for address, site in trace.distributions.items() if cost_of(site) < PHYSICS]
    likelihood: Tensor = approximation.log_likelihood(trace)
    return trace.log_prob(*cheap) + likelihood


def _beyond(trace: Trace, approximation: Any) -> Tensor:
    """Log ratio (N,) of the posterior to the cheap target: what physics says beyond it."""
    return POSTERIOR(trace) - _cheap_log_density(trace, approximation)
