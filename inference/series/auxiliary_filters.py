"""Auxiliary particle filters: resampling looks ahead, and new states are drawn by a proposal.

    def ahead(trace, observed):  # about log p(y | state)
        return dist.Normal(trace["x"], 1.2).log_prob(observed.observations["y"])

    def towards(trace, observed):
        pyro.sample("x", dist.Normal((trace["x"] + observed.observations["y"]) / 2, 0.7))

    for population, info in steps(auxiliary(towards, look_ahead=ahead), start, observed): ...

Both read the trace before the step, and the observations of the step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.filters.step import Observed, StepFunction, StepInfo, Stepped
from bcppl.inference.population import Population
from bcppl.inference.resampling import Resample, adaptive, refuse_no_resampling
from bcppl.traces import Trace, extend, propose


def auxiliary(
    proposal: Callable[[Trace, Observed], Any] | None = None,
    *,
    look_ahead: Callable[[Trace, Observed], Tensor] | None = None,
    resample: Resample | None = None,
) -> StepFunction:
    """A step that resamples by the weight times a prediction of the likelihood, then proposes new values.

    Pitt and Shephard, Filtering via simulation: auxiliary particle filters, JASA 94, 1999, section 3; in the
    form with one resampling of Carpenter, Clifford and Fearnhead, 1999. The estimate of the evidence is
    unbiased, whatever the proposal (with heavier tails than the target) and the prediction. With the exact
    p(y_t | x_t-1) and p(x_t | x_t-1, y_t) all weights are equal after each step: the filter is fully adapted.

    Args:
        proposal: a Pyro program `proposal(trace, observed)` that samples new latent addresses of the step;
            others, and all without a proposal, are drawn from the program.
        look_ahead: `look_ahead(trace, observed) -> (N,)`, about log p(y_t | x_t-1) up to a constant, larger
            than -inf where the step is possible; without it resampling is by weight.
        resample: when and how; by default systematic below half the effective sample size, of the weights
            with the prediction.

    Returns:
        The step; it raises NoWeightError where no particle is left with any weight, and InputError where the
        proposal samples an observed address or one that the step does not visit.
    """
    when = adaptive() if resample is None else resample
    refuse_no_resampling("auxiliary", when)

    def step(population: Population, observed: Observed) -> Stepped:
        start = population.log_evidence
        predicted = None if look_ahead is None else look_ahead(population.trace, observed)
        if predicted is not None and predicted.shape != (len(population),):
            raise InputError(
                f"an auxiliary filter's look_ahead gives {tuple(predicted.shape)} numbers for "
                f"{len(population)} particles; give one for each."
            )
        expected = population if predicted is None else population.reweighed(predicted)
        chosen, ancestors = when(expected)
        proposed = None
        if proposal is not None:
            proposed = propose(proposal, (chosen.trace, observed), len(chosen))
            if not proposed.choices:
                raise InputError("a proposal for a step of a filter samples no address; give none.")
        longer, log_factor = extend(chosen.trace, *observed, None if proposed is None else proposed.choices)
        if proposed is not None:
            log_factor = log_factor - proposed.log_prob
        if predicted is not None:
            assumed = predicted if ancestors is None else predicted[ancestors]
            # A particle that was given no chance has no weight, whatever it explains.
            log_factor = torch.where(assumed == -torch.inf, -torch.inf, log_factor - assumed)
        now = chosen.with_trace(longer).reweighed(log_factor)
        info = StepInfo(
            resampled=int(ancestors is not None),
            effective_sample_size_before=expected.effective_sample_size,
            effective_sample_size=now.effective_sample_size,
            log_evidence=now.log_evidence - start,
            ancestors=ancestors,
        )
        return Stepped(now, info)

    return step
