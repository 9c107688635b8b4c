"""BayesContact's own filter, as a baseline: every particle drifts before a measurement and is then weighed.

The paper weighs a drifted particle by w p(o | q) p(q) / pi, which is right for the first measurement only:
the pose does not move, so the measurements before belong in the weight too. The weight used here is that of
the SMC sampler with the drift as its forward and its backward kernel (Del Moral, Doucet and Jasra, JRSS B 68,
2006, eq. 12), p(q') p(o_1..o_t | q') / (p(q) p(o_1..o_{t-1} | q)) times backward over forward. There is no
tempering and no accept-reject step.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch

from bcppl.inference.kernels import replaced
from bcppl.inference.population import Population
from bcppl.inference.proposals import Proposal, drift, program_of
from bcppl.inference.resampling import Resample, adaptive
from bcppl.inference.smc import Step, smc
from bcppl.inference.step import Observed, StepFunction, StepInfo, Stepped
from bcppl.traces import Model, assess, extend, propose, update


def drifted(population: Population, proposal: Proposal) -> Population:
    """Every particle moved by a proposal program, and weighed for it; each half learns from the other."""
    order = torch.randperm(len(population))
    halves = [order[: len(order) // 2], order[len(order) // 2 :]]
    factor = torch.zeros(len(population), dtype=torch.float64)
    for mine, others in (halves, halves[::-1]):
        if len(mine) == 0 or len(others) == 0:
            continue
        program = program_of(proposal, (), population[others])
        trace = population.trace[mine]
        forward = propose(program, (trace,), len(mine))
        updated = update(trace, {a: v for a, v in forward.choices.items() if a in trace.choices})
        back = {**forward.choices, **updated.discarded}
        backward = assess(program, (updated.trace,), back, len(mine))
        ratio = updated.log_ratio + backward - forward.log_prob
        # A particle without weight stays without: it is not brought back by drifting where it could be.
        factor[mine] = torch.where(population.log_weights[mine] == -torch.inf, 0.0, ratio)
        population = replaced(population, mine, updated.trace)
    return population.reweighed(factor)


def drift_and_weigh(proposal: Proposal, resample: Resample) -> StepFunction:
    """A step that takes a measurement in by drifting, weighing and, when needed, resampling."""

    def step(population: Population, observed: Observed) -> Stepped:
        start = population.log_evidence
        population = drifted(population, proposal)
        longer, log_likelihood = extend(population.trace, *observed)
        weighed = replace(population, trace=longer).reweighed(log_likelihood)
        population, ancestors = resample(weighed)
        info = StepInfo(
            resampled=int(ancestors is not None),
            effective_sample_size_before=weighed.effective_sample_size,
            effective_sample_size=population.effective_sample_size,
            log_evidence=population.log_evidence - start,
            ancestors=ancestors,
        )
        return Stepped(population, info)

    return step


def infer(
    model: Model, recording: Any, *, particles: int = 75, seed: int = 0, scale: float = 0.2, scene: Any = None
) -> Iterator[Step]:
    """Beliefs over a recording, one step for each measurement, the prior first.

    Args:
        model: what explains the recording.
        recording: a `bcppl.recordings.Recording`.
        particles: how many; the paper uses 75.
        seed: same seed, same beliefs.
        scale: the drift, as a share of 2.38 / sqrt(d) times the particles' spread.
        scene: what `model.prepare(recording)` gives, if it is at hand.
    """
    step = drift_and_weigh(drift(model.pose, (scale, scale * 1.0001)), adaptive())
    return smc(model, recording, step=step, particles=particles, seed=seed, scene=scene)
