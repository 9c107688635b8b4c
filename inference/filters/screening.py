"""Physics is run for few: a cheap likelihood chooses among copies of the particles, and decides moves first.

Contact physics takes a hundred times as long as the gap between two solids. Where a likelihood is simulated
and another one of the same measurements is cheap (`bcppl.sensors.capabilities.Screens`), the cheap one takes
its place in a target of its own: copies of the particles are weighted for that and resampled, and only those
that survive are simulated and weighted by what remains, the ratio of the two targets. Both steps are proper
weightings (Naesseth, Lindsten and Schoen, Nested sequential Monte Carlo methods, ICML 2015), so the result
targets the posterior whatever the cheap likelihood is; a poor one costs effective particles. In moves it is
the surrogate of transitions (`bcppl.inference.kernels.surrogate_transition`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from bcppl.errors import NoWeightError
from bcppl.inference.filters.smcp3 import Pair, move_and_weight
from bcppl.inference.filters.step import Observed
from bcppl.inference.population import Population
from bcppl.inference.resampling import systematic
from bcppl.inference.sizing import replicate
from bcppl.inference.targets import PHYSICS, POSTERIOR, cost_of
from bcppl.traces import Trace, Update, propose
from bcppl.traces.verbs import constrained

COPIES = 12  # of each particle, that are weighted by the cheap target


def approximated(population: Population) -> Callable[[Trace], Tensor]:
    """A surrogate of the log-density of a trace: what is approximated takes the place of physics."""
    approximation = population.approximation
    return lambda trace: _cheap_log_density(trace, approximation)


def screened(
    population: Population,
    before: Any,
    observed: Observed,
    pair: Pair,
) -> tuple[Population, Tensor] | None:
    """N particles given one more measurement, of copies that the cheap target has weighted.

    Args:
        population: of N particles, whose approximation is given the measurement.
        before: the approximation that is not.
        observed: the measurement; latent values that come with it are drawn from the program.
        pair: moves a particle.

    Returns:
        The population, and which particle each was made of; None where none keeps any weight.
    """
    after = population.approximation

    def ratio(updated: Update) -> Tensor:
        now, then = _cheap_log_density(updated.trace, after), _cheap_log_density(updated.previous, before)
        # What came with the measurement was drawn from the program.
        return now - then - (updated.trace.log_prob(*updated.drawn) if updated.drawn else 0.0)

    many = replicate(population, COPIES)
    try:
        by_cheap = move_and_weight(many, pair, observed, ratio)
        chosen = by_mode(by_cheap, len(population))
        few, old = by_cheap.selected(chosen), many.trace[chosen]
        drawn = frozenset(address for address in few.trace.choices if address not in old.choices)
        change = Update(few.trace, old, {}, drawn)
        return few.reweighed(change.log_ratio - ratio(change)), chosen // COPIES
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
