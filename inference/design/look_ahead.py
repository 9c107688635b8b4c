"""Two-step look-ahead: the best candidate after another one has been measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.inference.design.entropies import EntropyOfWeights
from bcppl.inference.design.ranking import OuterSamples

# Outer samples that are less probable than this after the first step are left out of the second.
UNLIKELY = 1e-6


@dataclass(frozen=True, eq=False)
class EvaluatedCandidate:
    """The likelihoods of a candidate's simulated observations."""

    # (S, N) log-likelihoods of the outer samples' observations at all particles; rows of NaN failed
    first: Tensor
    # the same for an independent draw of the noise, used in a second step; None without one
    second: Tensor | None
    entropies: Tensor  # (S,) after the first draw; NaN where it failed
    cost: float  # nats


@dataclass(frozen=True, eq=False)
class SecondStep:
    """The best second step under each outer sample."""

    gains: Tensor  # (S,) expected information gains, nats; 0 where none is worth its cost, NaN where failed
    numbers: Tensor  # (S,) int64 the candidate; -1 for none
    costs: Tensor  # (S,) nats
    standard_error: float  # of the mean gain, from the inner samples that the second steps share


def posterior_entropies(log_weights: Tensor, log_likelihoods: Tensor, entropy_of: EntropyOfWeights) -> Tensor:
    """Entropies (M,) of log weights (N,) or (M, N) times likelihoods (M, N); NaN where no weight remains."""
    total = log_weights + log_likelihoods
    valid = ~torch.isnan(total).any(dim=1) & (total > -torch.inf).any(dim=1)
    entropies = torch.full((len(total),), torch.nan, dtype=torch.float64)
    if bool(valid.any()):
        entropies[valid] = entropy_of(torch.softmax(total[valid], dim=1))
    return entropies


def best_second_step(
    number: int,
    candidates: Sequence[EvaluatedCandidate],
    log_weights: Tensor,
    outer: OuterSamples,
    entropy_of: EntropyOfWeights,
) -> SecondStep:
    """The best candidate after the one at `number`, under each outer sample.

    Each outer sample's observation reweights the particles (N,), and with them the outer samples: with these
    weights and the second draw of the noise, they are the samples of the second step.
    """
    seconds = torch.stack([each.second for each in candidates if each.second is not None])
    costs = torch.tensor([each.cost for each in candidates], dtype=torch.float64)
    first = candidates[number]
    count = len(outer)
    gains = torch.full((count,), torch.nan, dtype=torch.float64)
    numbers, expected_costs = torch.full((count,), -1), torch.zeros(count, dtype=torch.float64)
    valid = ~torch.isnan(first.entropies)
    shares = torch.where(valid, outer.weights, 0.0) / outer.weights[valid].sum()
    influence = torch.zeros(count, dtype=torch.float64)
    for k in valid.nonzero().flatten().tolist():
        posterior = outer.weights.log() + first.first[k, outer.particles]
        if not bool((posterior > -torch.inf).any()):
            continue
        posterior = torch.softmax(posterior, 0)
        likely = (posterior > UNLIKELY).nonzero().flatten()
        then = seconds[:, likely].reshape(-1, len(log_weights))
        after = posterior_entropies(log_weights + first.first[k], then, entropy_of)
        after = after.reshape(len(candidates), -1)
        known = ~torch.isnan(after)
        weights = torch.where(known, posterior[likely], 0.0)
        weights = weights / weights.sum(dim=1, keepdim=True)
        reductions = torch.where(known, first.entropies[k] - after, 0.0)
        expected = (weights * reductions).sum(dim=1)
        values = torch.nan_to_num(expected - costs, nan=-torch.inf)
        best = int(values.argmax())
        gains[k] = 0.0
        if float(values[best]) > 0.0:
            gains[k], numbers[k], expected_costs[k] = expected[best], best, costs[best]
            influence[likely] += shares[k] * weights[best] * (reductions[best] - expected[best])
    return SecondStep(gains, numbers, expected_costs, float(influence.norm()))
