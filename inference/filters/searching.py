"""Steps that search for all modes of the posterior: where a measurement surprises, or at every measurement.

Where no particle explains a measurement, all have the same likelihood: that of an outlier. Then the effective
sample size stays as it is, nothing is resampled, and nothing moves. In a search, climbs from draws of the
prior lead to modes of the posterior given all measurements so far, and fresh particles are drawn about them,
from a mixture with a wide component (defensive: Hesterberg, Technometrics 37, 1995). The old particles and
the fresh ones are two estimates of the same posterior and of its evidence, and are pooled by those. So modes
that the old particles lost come back. Of their shares that holds on average over runs: in one run half of the
particles are drawn from the old ones, whichever modes these kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.inference.filters.step import Observed, StepFunction, StepInfo, Stepped, descended
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import Kernel, Until, moved_by
from bcppl.inference.kernels.kernel import scattered
from bcppl.inference.kernels.rejuvenation import Moved
from bcppl.inference.population import Population
from bcppl.inference.proposals.climbing import Modes, jumps, modes
from bcppl.inference.resampling import seeded, systematic
from bcppl.inference.targets import POSTERIOR, cost_of
from bcppl.inference.verbs import update
from bcppl.traces import Trace, generate

# How far the discrepancy -log p(y | particle) of a measurement lies above the median of replicated ones, in
# standard deviations that are taken from their quartiles: outliers among the replicas do not hide an outlier.
# One good measurement in fifty to a hundred is farther off (a normal value by 2.2 to 3 standard deviations).
EXCESS = 5.0
QUARTILES = 1.349  # of a normal, in standard deviations
LEAST = 0.45  # their distance in standard deviations so taken, for the discrepancy of one normal value
FRESH = 8  # fresh particles for each old one: a large batch costs little more than a small one
ENOUGH = 0.15  # effective fresh particles for each old one, with which tempering adds nothing


@dataclass(frozen=True, eq=False)
class Searching:
    """A step that searches for modes where a measurement surprises, or `always`.

    Only programs without a simulator are searched because of a surprise.

    Attributes:
        step: assimilates a measurement where no search does.
        program: of the model.
        address: of the sought pose.
        kernel: moves the particles after a search, given the modes.
        climbs: the number of draws of the prior that climb.
        sweeps: moves of every particle after a search.
        always: search at every measurement, and take `step` only where too few of the fresh particles count.
    """

    step: StepFunction
    program: Callable[..., Any]
    address: str
    kernel: Callable[[Modes], Kernel]
    climbs: int
    sweeps: int | Until
    always: bool = False

    def __call__(self, population: Population, observed: Observed) -> Stepped:
        """Assimilate observations at new addresses."""
        if self.always:
            observations = {**population.trace.observations, **observed.observations}
            ends, fresh = self._search(observed._replace(observations=observations), len(population))
            enough = fresh.effective_sample_size >= ENOUGH * len(population)
            done = _reweighed(population, observed) if enough else self.step(population, observed)
        else:
            done = self.step(population, observed)
            if not excess(self.program, observed.args, done.population, population.trace) > EXCESS:
                return done
            every = Observed(observed.args, done.population.trace.observations)
            ends, fresh = self._search(every, len(population))
        both, chosen = pooled_by_evidence(done.population, fresh)
        moved = moved_by(both, self.kernel(ends), POSTERIOR, self.sweeps)
        return Stepped(moved.population, _record(done, population, moved, chosen))

    def _search(self, observed: Observed, particles: int) -> tuple[Modes, Population]:
        """Modes of the posterior given all observations, and fresh particles about them."""
        climbers, _ = generate(self.program, *observed, self.climbs)
        ends = modes(climbers, self.address)
        near = jumps(self.address, ends)
        return ends, importance_sampling(
            self.program, *observed, FRESH * particles, lambda *_: near(climbers)
        )


def excess(program: Callable[..., Any], args: tuple[Any, ...], later: Population, before: Trace) -> float:
    """How far a measurement's discrepancy exceeds that of replicas at the particles that assimilated it.

    Discrepancies are those of Gelman, Meng and Stern (Statistica Sinica 6, 1996). -inf where the program has
    sites that cost more than arithmetic, for then replicas and a search would take a simulator.

    Args:
        program: of the model.
        args: its arguments up to and including the measurement.
        later: the particles afterwards.
        before: the trace without the measurement.
    """
    new = [a for a in later.trace.since(before) if a in later.trace.observations]
    if not new or any(cost_of(site) > 0 for site in later.trace.distributions.values()):
        return -math.inf
    with seeded(0):
        few = later.trace.chosen(systematic(later.log_weights))
        again, _ = generate(program, args, before.observations, len(later), few.choices)
    replicas = -again.log_prob(*new)
    low, middle, high = replicas.quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)).tolist()
    return float(-few.log_prob(*new).mean() - middle) / max((high - low) / QUARTILES, LEAST)


def _reweighed(population: Population, observed: Observed) -> Stepped:
    later = update(population, observed)
    size = later.effective_sample_size
    return Stepped(later, StepInfo(effective_sample_size_before=size, effective_sample_size=size))


def _record(done: Stepped, before: Population, moved: Moved, chosen: Tensor) -> StepInfo:
    info = done.info
    return info._replace(
        acceptance=moved.acceptance,
        resampled=info.resampled + 1,
        effective_sample_size_before=done.population.effective_sample_size,
        effective_sample_size=moved.population.effective_sample_size,
        log_evidence=moved.population.log_evidence - before.log_evidence,
        ancestors=descended(info.ancestors, chosen, len(before)),
    )


def pooled_by_evidence(old: Population, fresh: Population) -> tuple[Population, Tensor]:
    """As many particles as `old` has, drawn from two populations of one posterior by weight and evidence.

    Each counts as its estimate of the evidence, as islands do (Verge, Dubarry, Del Moral and Moulines,
    Statistics and Computing 25, 2015). The evidence is the mean of the two estimates, which is unbiased if
    both are.

    Raises:
        NoWeightError: one has no particle with any weight.

    Returns:
        The population, and the particle (N,) from which each comes, those of `fresh` counted after the old.
    """
    parts = [normalised(p.log_weights).log() + p.log_evidence for p in (old, fresh)]
    chosen = systematic(torch.cat(parts), len(old))
    is_fresh = (chosen >= len(old)).nonzero().flatten()
    trace = old.trace.chosen(chosen.clamp(max=len(old) - 1))
    trace = scattered(trace, is_fresh, fresh.trace.chosen(chosen[is_fresh] - len(old)))
    both = torch.tensor([old.log_evidence, fresh.log_evidence], dtype=torch.float64)
    population = Population(
        trace,
        torch.zeros(len(old), dtype=torch.float64),
        float(torch.logsumexp(both, 0)) - math.log(2.0),
        torch.cat([old.founders, int(old.founders.max()) + 1 + fresh.founders])[chosen],
        math.inf,  # the variance of this evidence cannot be estimated from founders
        approximation=old.approximation,
    )
    return population, chosen
