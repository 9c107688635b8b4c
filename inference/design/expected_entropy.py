"""Where to touch next: the entropy that a candidate is expected to leave.

Algorithm 1 of BayesContact. Every candidate is simulated once for all particles. Then particles play the
truth in turn: what a particle would observe is drawn from its own likelihood, sensor noise included, all are
reweighed by it as inference would reweigh them, and the entropy of what results is averaged by the weights of
those that played the truth.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import LARGEST_SEED, seed_number, whole_number
from bcppl.errors import InputError
from bcppl.inference.design.entropies import Entropy, weight_entropy
from bcppl.inference.design.hypotheses import chosen_hypotheses, mean_and_error
from bcppl.inference.design.lookahead import Following, Step, entropies, following
from bcppl.inference.design.observations import (
    Arguments,
    Batched,
    Forecast,
    Forecasted,
    Simulated,
    forecasted,
    seeded,
    simulated,
)
from bcppl.inference.design.ranking import Price, Prospect, Ranking, costs_in_nats, ranked
from bcppl.inference.population import Population


def expected_information_gain(
    population: Population,
    candidates: Iterable[Any],
    extend_args: Arguments | Batched,
    entropy: Entropy | None = None,
    *,
    hypotheses: int | None = None,
    latent: Collection[str] = (),
    forecast: Forecast | None = None,
    cost: Callable[[Any], Price] | Mapping[Any, Price] | None = None,
    rate: Price = 1.0,
    depth: int = 1,
    shortlist: int = 8,
    seed: int | None = None,
) -> Ranking:
    """Candidates ranked by how many nats each is expected to tell, less what it costs.

        ranking = expected_information_gain(population, touches, lambda touch: (scene, [*done, touch]))
        ranking.best.candidate, ranking.best.information_gain, ranking.best.standard_error

    All sites that a candidate's arguments add are what it would observe. Observations are drawn by the sites'
    `sample` and weighed by their `log_prob`. The work is C candidates simulated for N particles, and C H N
    log-probabilities for H hypotheses; fewer hypotheses make it cheaper, or a smaller population
    (`population.selected(systematic(population.log_weights, n))`). All candidates have the same hypotheses
    and the same seed of the noise, so that their differences are told more sharply than their gains
    (`Ranking.difference`).

    With `depth=2` the best `shortlist` candidates are looked at again, and ranked before the others: each
    gains what it tells and what the best candidate after it, chosen by what was observed, is expected to
    tell, if that is worth its cost. Observations of two candidates are taken as independent given the
    particle, so that nothing is simulated again: it suits parts that stay where they are. It costs another
    C H N log-probabilities, and shortlist x H rankings of C candidates, each H entropies of N weights: keep H
    small. Being the best of several estimates, what comes after is estimated a little too high.

    Args:
        population: weighted particles.
        candidates: what may be done next; anything that `extend_args` understands.
        extend_args: the program's arguments once a candidate is done as well, those of all measurements so
            far included; for a `Series`, those of its next step. `Batched` simulates several at once. A
            `Plan` is no action yet: `bcppl.sensors.candidates.action_of(plan)` is.
        entropy: what is to fall: `weight_entropy()` (the default, the paper's), `mode_entropy(address)`,
            `neighbour_entropy(address)`, `value_entropy(address)`, or what answers alike.
        hypotheses: how many play the truth, drawn systematically by weight; None: every particle, once.
        latent: new addresses that are not observed, with wildcards: each particle keeps what it drew there.
        forecast: for programs whose likelihood weighs what was measured and cannot say what will be (its
            sites have no `sample`): `forecast(candidate, trace)` gives what would be observed at the
            particles of a trace, noise included, as (H, *event) by address, drawn from torch's generator.
            Then only hypotheses are simulated; with `depth=2`, twice.
        cost: of a candidate, in any unit: a function of it or a mapping, giving a number or several by name.
        rate: nats that one unit of cost is worth; by name where costs are.
        depth: 1, or 2 to look ahead.
        shortlist: how many candidates are looked ahead from.
        seed: None draws it from torch's generator.

    Raises:
        InputError: there are no candidates; the population has no weight, or has collapsed to a point; a
            candidate adds nothing to observe; a cost, a rate or a setting is out of range.
        InferenceError: nothing that was simulated for a candidate has a log-probability.
    """
    candidates = list(candidates)
    if not candidates:
        raise InputError("there are no candidates to choose from; give one action or more.")
    depth = whole_number("probes are to be looked ahead by {} steps", depth, most=2)
    shortlist = whole_number("a shortlist of {} candidates was asked for", shortlist)
    costs = costs_in_nats(candidates, cost, rate)
    seed = int(torch.randint(LARGEST_SEED, ())) if seed is None else seed_number(seed)
    with seeded(seed):
        truths = chosen_hypotheses(population, hypotheses)
        entropy_of = (weight_entropy() if entropy is None else entropy)(population)
        seeds = [int(each) for each in torch.randint(LARGEST_SEED, (3,))]
    now = float(entropy_of(torch.softmax(population.log_weights, 0)[None])[0])

    steps: list[Step] = []
    prospects: list[Prospect] = []
    trace = population.trace
    each: Iterator[Simulated | Forecasted] = (
        simulated(trace, candidates, extend_args, latent, seeds[0])
        if forecast is None
        else forecasted(trace, candidates, extend_args, forecast, seeds[0])
    )
    for k, one in enumerate(each):
        first = one.log_likelihoods(one.drawn(truths.particles, seeds[1]))
        second = one.log_likelihoods(one.drawn(truths.particles, seeds[2])) if depth == 2 else None
        after = entropies(population.log_weights, first, entropy_of)
        warn_of_lost(k, torch.isnan(after))
        steps.append(Step(first, second, after, costs[k]))
        gain, error = mean_and_error(now - after, truths.weights)
        prospects.append(
            Prospect(
                candidates[k],
                k,
                gain,
                error,
                now - gain,
                costs[k],
                1,
                gains=now - after,
                weights=truths.weights,
            )
        )
    if depth == 2:
        for ahead in ranked(prospects, now)[:shortlist]:
            then = following(ahead.number, steps, population.log_weights, truths, entropy_of)
            prospects[ahead.number] = _after_both(ahead, then)
    return ranked(prospects, now)


def _after_both(first: Prospect, then: Following) -> Prospect:
    """A prospect that holds what the best second step is expected to tell, and its expected cost."""
    gains = first.gains + then.gains
    gain, error = mean_and_error(gains, first.weights)
    paid, _ = mean_and_error(then.costs, first.weights)
    return replace(
        first,
        information_gain=gain,
        standard_error=math.hypot(error, then.standard_error),
        entropy=first.entropy + first.information_gain - gain,
        cost=first.cost + paid,
        steps=2,
        immediate=first.value,
        gains=gains,
        then=then.numbers,
    )


def warn_of_lost(number: int, lost: Tensor) -> None:
    """Says how many hypotheses (H,) tell nothing of a candidate."""
    if bool(lost.any()):
        warnings.warn(
            f"{int(lost.sum())} of {len(lost)} hypotheses are left out of what candidate {number} is "
            "expected to tell: their simulation failed, or no particle can explain what it gave.",
            stacklevel=3,
        )
