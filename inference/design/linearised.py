"""Expected information gain of precise measurements: information matrices added in the tangent space.

A touch is precise to a tenth of a millimetre, and after vision particles lie millimetres apart: reweighting
them by any touch leaves a single one, so that all candidates look alike. Here none is reweighted. Particles
serve as the true value in turn (the outer samples), as in Algorithm 1 of BayesContact; the information of a
candidate is the Gauss-Newton approximation of its log-likelihood there, added to the precision of the
belief's modes. (The expected gain of a Bayesian linear model: D. Lindley, On a measure of the information
provided by an experiment, 1956; K. Chaloner and I. Verdinelli, Bayesian experimental design: a review, 1995,
section 4.2.)
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.errors import InferenceError
from bcppl.inference.design.observations import Arguments
from bcppl.inference.design.predicted import (
    Information,
    PredictedObservations,
    predict_observations,
    sum_log_probs,
    sum_quadratics,
)
from bcppl.inference.design.ranking import (
    Cost,
    Costs,
    OuterSamples,
    Ranking,
    Utility,
    checked,
    draw_outer_samples,
    mean_and_error,
    rank,
    warn_of_failures,
)
from bcppl.inference.design.relative_mixture import HeldPeg, RelativeMixture, entropy_reduction
from bcppl.inference.design.tangent_mixture import TangentMixture
from bcppl.inference.population import Population
from bcppl.inference.resampling import seeded
from bcppl.traces import Trace

_ITERATIONS = 6  # of Gauss-Newton, to the maximum of another mode's posterior density
_TRUST_RADIUS = 2.0  # standard deviations: no iteration moves farther


def linearised_information_gain(
    population: Population,
    candidates: Iterable[Any],
    extend_args: Arguments,
    address: str | None = None,
    *,
    outer_samples: int | None = None,
    information: Information | None = None,
    cost: Costs | None = None,
    rate: Cost = 1.0,
    horizon: int = 1,
    peg: HeldPeg | None = None,
    translation: float = 0.01,
    rotation: float = 0.2,
    seed: int | None = None,
) -> Ranking:
    """Candidates ranked by the expected information gain about a pose (nats) less cost.

        ranking = linearised_information_gain(population, touches, lambda touch: (scene, [*done, touch]))

    Under an outer sample in which a touch misses, the information is that the part is not on the peg's path,
    and no more. Where the belief has several modes, the evidence of each is computed for every outer sample's
    observation by a Laplace approximation; the entropy reduction over modes counts as well. Of errors that
    touches share each outer sample has values of its own, and every mode explains the observation by others.

    Only the outer samples are simulated, the touches of all candidates in one batch. All candidates have the
    same outer samples, and the same noise as far as they have equally many contact stamps. Information that
    is given by `information` does not discriminate between modes: where there are several, the gain of such
    candidates is underestimated, with a warning.

    With `horizon=2` each candidate gains the joint information of it and the best candidate after it, if that
    is worth its cost. The second is chosen before the first is measured, and adds its information within a
    mode only. Of two candidates that are equally informative in either order, the more informative ranks
    first.

    Args:
        population: weighted particles.
        candidates: anything that `extend_args` understands.
        extend_args: the program's arguments once a candidate is measured as well, those of all measurements
            so far included; a `Plan` is no action, `bcppl.sensors.candidates.action_of(plan)` is.
        address: of the pose; the first latent address unless given.
        outer_samples: how many particles serve as the true value, drawn systematically by weight; None: every
            particle, once.
        information: of a candidate at the outer samples, (S, 6, 6) in the tangent space at their poses, for
            sites that cannot be linearised; where it gives None, and by default, the `quadratic` of the
            candidate's sites is used (`bcppl.distributions.manifold.ContactManifold`).
        cost: of a candidate, in any unit: a function of it or a mapping, with a number or several by name.
        rate: nats for one unit of cost; by name where costs are.
        horizon: 1, or 2 for two-step look-ahead.
        peg: whose touches share errors (the grasp, the arm), and from which the pose is to be known, as an
            insertion needs it. None: the pose in the world, as if touches shared none.
        translation: the gap between modes, metres; both gaps are widened where particles are sparse.
        rotation: the gap between modes, radians.
        seed: None draws it from torch's generator.

    Raises:
        InputError: there are no candidates; the population has no weight, has collapsed to a point or does
            not span the pose's axes; a candidate adds no site to observe, or one that cannot be linearised;
            `information` gives matrices that are not symmetric, or negative; a cost, a rate or a setting is
            out of range.
        InferenceError: the simulation of a candidate failed under every outer sample.
    """
    candidates, costs, seed = checked(candidates, cost, rate, horizon, seed)
    with seeded(seed):
        outer = draw_outer_samples(population, outer_samples)
    address = next(iter(population.trace.choices)) if address is None else address
    belief = TangentMixture.fit(population, address, translation, rotation)
    interest = RelativeMixture.alone(belief)
    if peg is not None and peg.errors.errors:
        interest = RelativeMixture.fit(population, address, belief, peg)
    trace = population.trace.chosen(outer.particles)
    mode = belief.label[outer.particles]
    with seeded(seed ^ 1):  # other numbers than the noise of observations
        drawn = torch.randn(len(outer), interest.shared, dtype=torch.float64)
    whitened: list[Tensor] = []
    uncounted: list[int] = []
    utilities: list[Utility] = []
    predicted = predict_observations(trace, candidates, extend_args, information, seed)
    for k, observations in enumerate(predicted):
        white = interest.whiten(observations.information(interest.shared), trace[address], mode)
        gains = interest.reduction(white, mode)
        if bool(torch.isnan(gains).all()):
            raise InferenceError(f"the simulation of candidate {k} failed under every outer sample.")
        warn_of_failures(k, torch.isnan(gains))
        if len(belief) > 1 and observations.sites:
            after = _posterior_entropies(interest, observations, trace, address, mode, drawn, gains)
            gains = interest.entropy - after
        elif len(belief) > 1:
            uncounted.append(k)
        whitened.append(white)
        utilities.append(Utility.of(candidates[k], k, gains, outer, interest.entropy, costs[k]))
    if uncounted:
        warnings.warn(
            f"the belief has {len(belief)} modes, and the gain of {len(uncounted)} of {len(candidates)} "
            f"candidates (the first is candidate {uncounted[0]}) does not include the discrimination between "
            "modes: their `information` does not state it.",
            stacklevel=2,
        )
    if horizon == 2:
        reduction = partial(interest.reduction, mode=mode)
        utilities = [_two_steps(one, whitened, costs, outer, reduction) for one in utilities]
    return rank(utilities, interest.entropy)


def _posterior_entropies(
    interest: RelativeMixture,
    predicted: PredictedObservations,
    trace: Trace,
    address: str,
    mode: Tensor,
    drawn: Tensor,
    own_reductions: Tensor,
) -> Tensor:
    """Entropies (S,) of a belief of several modes after each outer sample's observation.

    The evidence of a mode is a Laplace approximation: the likelihood and the mode's density at the maximum of
    their product over the pose and the shared errors, and the volume around it. The true errors are those of
    the outer sample's mode, given its pose, at standard normal numbers (S, M) that are `drawn`.
    """
    belief = interest.pose
    white = torch.cat([belief.white_coordinates(trace[address], mode), drawn], dim=1)
    measured = predicted.with_shared_errors(_errors(interest, white, mode))
    log_evidence, reductions = [], []
    for k in range(len(belief)):
        modes, own = torch.full_like(mode, k), (mode == k)[:, None]
        start = torch.where(own, trace[address], belief.mean[k]), torch.where(own, drawn, 0.0)
        at, white = _maximum(interest, measured, trace, address, modes, start)
        sites, errors = measured.at(trace.at({address: at})), _errors(interest, white, modes)
        information = interest.whiten(sum_quadratics(sites, errors).information, at, modes)
        volume = entropy_reduction(information)
        reductions.append(torch.where(mode == k, own_reductions, interest.reduction(information, modes)))
        log_evidence.append(sum_log_probs(sites, errors) - 0.5 * white.square().sum(dim=1) - volume)
    shares = torch.softmax(belief.mass.log()[:, None] + torch.stack(log_evidence), dim=0)
    entropies = interest.entropies[:, None] - torch.stack(reductions)
    return (torch.special.entr(shares) + shares * entropies).sum(dim=0)


def _errors(interest: RelativeMixture, white: Tensor, mode: Tensor) -> Tensor:
    """Shared errors (S, M) at whitened coordinates (S, d + M) of modes (S,)."""
    lower = interest.factor[mode][:, interest.factor.shape[1] - interest.shared :]
    return interest.errors[mode] + (lower @ white[..., None])[..., 0]


def _maximum(
    interest: RelativeMixture,
    predicted: PredictedObservations,
    trace: Trace,
    address: str,
    modes: Tensor,
    start: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Where likelihood times the density of modes (S,) is largest: poses (S, 7), whitened coordinates.

    From poses and whitened errors (S, M) to start at; the coordinates (S, d + M) are of both.
    """
    at, left = start
    belief = interest.pose
    d = belief.freedom.dimension
    eye = torch.eye(d + interest.shared, dtype=torch.float64)
    axes = [*belief.freedom.axes, *range(6, 6 + interest.shared)]
    factor = interest.factor[modes]
    white = torch.cat([belief.white_coordinates(at, modes), left], dim=1)
    for _ in range(_ITERATIONS):
        sites = predicted.at(trace.at({address: at}))
        gradient, information = sum_quadratics(sites, _errors(interest, white, modes))
        curvature = torch.nan_to_num(interest.whiten(information, at, modes))
        descent = torch.nan_to_num((gradient[:, None, axes] @ factor)[:, 0])
        step = -torch.linalg.solve(eye + curvature, (descent + white)[..., None])[..., 0]
        step = step * (_TRUST_RADIUS / step.norm(dim=1, keepdim=True).clamp(min=_TRUST_RADIUS))
        moved = (factor[:, :d, :d] @ step[:, :d, None])[..., 0]
        at = poses.retract(at, belief.freedom.embed(moved))
        white = torch.cat([belief.white_coordinates(at, modes), white[:, d:] + step[:, d:]], dim=1)
    return at, white


def _two_steps(
    first: Utility,
    whitened: Sequence[Tensor],
    costs: Sequence[float],
    outer: OuterSamples,
    reduction: Callable[[Tensor], Tensor],
) -> Utility:
    """The utility of a candidate and the best second step, chosen before the first is measured."""
    alone = reduction(whitened[first.number])
    both = torch.stack([reduction(whitened[first.number] + white) for white in whitened])
    # The added gain is over outer samples that are valid for both: those that fail for one may gain less.
    added = [mean_and_error(joint - alone, outer.weights)[0] for joint in both]
    values = torch.tensor([gain - cost for gain, cost in zip(added, costs, strict=True)]).nan_to_num(-1.0)
    best = int(values.argmax())
    if not float(values[best]) > 0.0:
        return replace(first, horizon=2, second=torch.full((len(outer),), -1), myopic=first.value)
    gains = first.gains + both[best] - alone
    gain, (_, error) = first.information_gain + added[best], mean_and_error(gains, outer.weights)
    return first.with_second_step(gains, gain, error, costs[best], torch.full((len(outer),), best))
