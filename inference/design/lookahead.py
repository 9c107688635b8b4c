"""Two steps ahead: what the best candidate is expected to tell after another one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.inference.design.entropies import EntropyOf
from bcppl.inference.design.hypotheses import Hypotheses

# A hypothesis that is less likely than this after the first step is not looked at in the second.
UNLIKELY = 1e-6


@dataclass(frozen=True, eq=False)
class Step:
    """One candidate, weighed.

    Attributes:
        first: (H, N) log-likelihoods of what the hypotheses would observe; rows of NaN are lost.
        second: the same of an independent draw of the noise, for a second step; None where none is asked for.
        after: (H,) entropies after the first draw; NaN where it is lost.
        cost: nats.
    """

    first: Tensor
    second: Tensor | None
    after: Tensor
    cost: float


@dataclass(frozen=True, eq=False)
class Following:
    """The best second step under every hypothesis.

    Attributes:
        gains: (H,) nats that it is expected to tell; 0 where none is worth its cost, NaN where lost.
        numbers: (H,) int64 which candidate it is; -1 for none.
        costs: (H,) nats.
        standard_error: of the mean gain, by what the second steps' hypotheses have in common.
    """

    gains: Tensor
    numbers: Tensor
    costs: Tensor
    standard_error: float


def entropies(log_weights: Tensor, log_likelihoods: Tensor, entropy_of: EntropyOf) -> Tensor:
    """Entropies (M,) of log weights (N,) or (M, N) reweighed by (M, N); NaN where nothing has weight."""
    total = log_weights + log_likelihoods
    told = ~torch.isnan(total).any(dim=1) & (total > -torch.inf).any(dim=1)
    found = torch.full((len(total),), torch.nan, dtype=torch.float64)
    if bool(told.any()):
        found[told] = entropy_of(torch.softmax(total[told], dim=1))
    return found


def following(
    number: int, steps: Sequence[Step], log_weights: Tensor, truths: Hypotheses, entropy_of: EntropyOf
) -> Following:
    """The best candidate after the one at `number`, under each of its hypotheses.

    Each hypothesis reweighs the particles (N,), and with them the hypotheses themselves: these play the truth
    again, with the second draw of the noise.

    Args:
        number: which candidate comes first.
        steps: all candidates (C), with their second draws.
        log_weights: (N,) of the population.
        truths: (H) hypotheses.
        entropy_of: what is to fall.
    """
    seconds = torch.stack([_second(step) for step in steps])
    costs = torch.tensor([step.cost for step in steps], dtype=torch.float64)
    here = steps[number]
    count = len(truths)
    gains = torch.full((count,), torch.nan, dtype=torch.float64)
    numbers, paid = torch.full((count,), -1), torch.zeros(count, dtype=torch.float64)
    told = ~torch.isnan(here.after)
    shares = torch.where(told, truths.weights, 0.0) / truths.weights[told].sum()
    influence = torch.zeros(count, dtype=torch.float64)
    for h in told.nonzero().flatten().tolist():
        chances = truths.weights.log() + here.first[h, truths.particles]
        if not bool((chances > -torch.inf).any()):
            continue
        chances = torch.softmax(chances, 0)
        likely = (chances > UNLIKELY).nonzero().flatten()
        then = seconds[:, likely].reshape(-1, len(log_weights))
        after = entropies(log_weights + here.first[h], then, entropy_of).reshape(len(steps), -1)
        known = ~torch.isnan(after)
        weights = torch.where(known, chances[likely], 0.0)
        weights = weights / weights.sum(dim=1, keepdim=True)
        told_by = torch.where(known, here.after[h] - after, 0.0)
        expected = (weights * told_by).sum(dim=1)
        values = torch.nan_to_num(expected - costs, nan=-torch.inf)
        best = int(values.argmax())
        gains[h] = 0.0
        if float(values[best]) > 0.0:
            gains[h], numbers[h], paid[h] = expected[best], best, costs[best]
            influence[likely] += shares[h] * weights[best] * (told_by[best] - expected[best])
    return Following(gains, numbers, paid, float(influence.norm()))


def _second(step: Step) -> Tensor:
    assert step.second is not None
    return step.second
