"""Expected information gain by nested Monte Carlo over weighted particles.

Algorithm 1 of BayesContact. Every candidate is simulated once at all particles. Then particles serve as the
true value in turn (the outer samples): an observation is drawn from the particle's likelihood, sensor noise
included, all particles are reweighted by it as in inference, and the entropy of the result is averaged by the
weights of the outer samples.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from typing import Any

import torch

from bcppl.arguments import LARGEST_SEED, whole_number
from bcppl.inference.design.entropies import Entropy, weight_entropy
from bcppl.inference.design.look_ahead import (
    EvaluatedCandidate,
    SecondStep,
    best_second_step,
    posterior_entropies,
)
from bcppl.inference.design.observations import (
    Arguments,
    BatchedArguments,
    PredictedCandidate,
    PredictiveSampler,
    SimulatedCandidate,
    simulate_candidates,
)
from bcppl.inference.design.ranking import (
    Cost,
    Costs,
    Ranking,
    Utility,
    checked,
    draw_outer_samples,
    mean_and_error,
    rank,
    warn_of_failures,
)
from bcppl.inference.population import Population
from bcppl.inference.resampling import seeded


def expected_information_gain(
    population: Population,
    candidates: Iterable[Any],
    extend_args: Arguments | BatchedArguments,
    entropy: Entropy | None = None,
    *,
    outer_samples: int | None = None,
    latent: Collection[str] = (),
    predictive: PredictiveSampler | None = None,
    cost: Costs | None = None,
    rate: Cost = 1.0,
    horizon: int = 1,
    shortlist: int = 8,
    seed: int | None = None,
) -> Ranking:
    """Candidates ranked by expected information gain (the expected entropy reduction, nats) less cost.

        ranking = expected_information_gain(population, touches, lambda touch: (scene, [*done, touch]))
        ranking.best.candidate, ranking.best.information_gain, ranking.best.standard_error

    All sites that a candidate's arguments add are observations, drawn by the sites' `sample` and evaluated by
    their `log_prob`. The work is C candidates simulated at N particles, and C S N log-probabilities for S
    outer samples. Fewer outer samples make it cheaper, or a smaller population
    (`population.selected(systematic(population.log_weights, n))`). All candidates share the outer samples and
    the seed of the noise, so that differences of gains have smaller errors than gains
    (`Ranking.difference`).

    With `horizon=2` the best `shortlist` candidates are evaluated again and ranked before the others: each
    gain includes the expected gain of the best candidate after it, chosen by the first observation, if that
    is worth its cost. Observations of two candidates are taken as independent given the particle, so that
    nothing is simulated again; this suits parts that do not move. It takes another C S N log-probabilities,
    and shortlist x S rankings of C candidates, each S entropies of N weights: keep S small. The second gain
    is a maximum over estimates and so biased a little upwards.

    Args:
        population: weighted particles.
        candidates: anything that `extend_args` understands.
        extend_args: the program's arguments once a candidate is measured as well, those of all measurements
            so far included; for a `Series`, those of its next step. `BatchedArguments` simulates several
            candidates at once. A `Plan` is no action: `bcppl.sensors.candidates.action_of(plan)` is.
        entropy: the entropy to be reduced: `weight_entropy()` (the default, the paper's),
            `mixture_entropy(address)`, `neighbour_entropy(address)`, `discrete_entropy(address)`, or a
            function of the same signature.
        outer_samples: how many particles serve as the true value, drawn systematically by weight; None: every
            particle, once.
        latent: new addresses that are not observed, with wildcards: each particle keeps its draw there.
        predictive: for programs whose sites have no `sample`: `predictive(candidate, trace)` draws
            observations, noise included, at the particles of a trace from torch's generator, (S, *event) by
            address. Then only outer samples are simulated; with `horizon=2`, twice.
        cost: of a candidate, in any unit: a function of it or a mapping, with a number or several by name.
        rate: nats for one unit of cost; by name where costs are.
        horizon: 1, or 2 for two-step look-ahead.
        shortlist: how many candidates are evaluated two steps ahead.
        seed: None draws it from torch's generator.

    Raises:
        InputError: there are no candidates; the population has no weight, or has collapsed to a point; a
            candidate adds nothing to observe; a cost, a rate or a setting is out of range.
        InferenceError: no simulated observation of a candidate has a log-probability.
    """
    shortlist = whole_number("a shortlist of {} candidates was asked for", shortlist)
    candidates, costs, seed = checked(candidates, cost, rate, horizon, seed)
    with seeded(seed):
        outer = draw_outer_samples(population, outer_samples)
        entropy_of = (weight_entropy() if entropy is None else entropy)(population)
        seeds = [int(each) for each in torch.randint(LARGEST_SEED, (3,))]
    now = float(entropy_of(torch.softmax(population.log_weights, 0)[None])[0])

    trace, evaluated, utilities = population.trace, list[EvaluatedCandidate](), list[Utility]()
    predicted: Iterator[SimulatedCandidate | PredictedCandidate] = (
        simulate_candidates(trace, candidates, extend_args, latent, seeds[0])
        if predictive is None
        else (
            PredictedCandidate(trace, k, candidate, extend_args(candidate), predictive, seeds[0])
            for k, candidate in enumerate(candidates)
        )
    )
    for k, each in enumerate(predicted):
        first = each.log_likelihoods(each.draw(outer.particles, seeds[1]))
        second = each.log_likelihoods(each.draw(outer.particles, seeds[2])) if horizon == 2 else None
        after = posterior_entropies(population.log_weights, first, entropy_of)
        warn_of_failures(k, torch.isnan(after))
        evaluated.append(EvaluatedCandidate(first, second, after, costs[k]))
        utilities.append(Utility.of(candidates[k], k, now - after, outer, now, costs[k]))
    if horizon == 2:
        for best in rank(utilities, now)[:shortlist]:
            then = best_second_step(best.number, evaluated, population.log_weights, outer, entropy_of)
            utilities[best.number] = _after_both(best, then)
    return rank(utilities, now)


def _after_both(first: Utility, second: SecondStep) -> Utility:
    gains = first.gains + second.gains
    gain, error = mean_and_error(gains, first.weights)
    # Where the simulation failed, no second step was chosen.
    costs = torch.where(torch.isnan(gains), torch.nan, second.costs)
    cost, _ = mean_and_error(costs, first.weights)
    return first.with_second_step(gains, gain, math.hypot(error, second.standard_error), cost, second.numbers)
