"""BayesContact's own filter, as a baseline: every particle drifts before a measurement and is then weighed.

The paper weighs a drifted particle by w p(o | q) p(q) / pi, which is right for the first measurement only:
the pose does not move, so the measurements before belong in the weight too. The weight used here is that of
the SMC sampler with the drift as its forward and its backward kernel (Del Moral, Doucet and Jasra, JRSS B 68,
2006, eq. 12), p(q') p(o_1..o_t | q') / (p(q) p(o_1..o_{t-1} | q)) times backward over forward. There is no
tempering and no accept-reject step.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.smcp3 import Pair, moved, smcp3
from bcppl.inference.filters.step import StepFunction
from bcppl.inference.population import Population
from bcppl.inference.proposals import Proposal, drift
from bcppl.inference.resampling import Resample, adaptive
from bcppl.traces import Model


def drifted(population: Population, proposal: Proposal) -> Population:
    """Every particle moved by a proposal program, and weighed for it; each half learns from the other."""
    return moved(population, Pair(proposal, proposal))


def drift_and_weigh(proposal: Proposal, resample: Resample) -> StepFunction:
    """A step that takes a measurement in by drifting, weighing and, when needed, resampling."""
    return smcp3(Pair(proposal, proposal), resample=resample)


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
