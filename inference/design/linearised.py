"""Where to touch next, where touches are sharp: information added up in the tangent space.

A touch tells a tenth of a millimetre, and after vision particles lie millimetres apart: whichever touch it
is, reweighing them by it leaves a single one, and all candidates look alike. So none is reweighed here.
Particles play the truth in turn, as in Algorithm 1 of BayesContact; what a candidate then tells is its
likelihood to second order around that truth, as Gauss and Newton take it, added to the precision of the
belief's modes. (The expected gain of a Bayesian linear model: D. Lindley, On a measure of the information
provided by an experiment, 1956; K. Chaloner and I. Verdinelli, Bayesian experimental design: a review, 1995,
section 4.2.)
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import LARGEST_SEED, seed_number, whole_number
from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InferenceError, InputError
from bcppl.inference.design.expected_entropy import warn_of_lost
from bcppl.inference.design.gaussians import Gaussians, nats
from bcppl.inference.design.hypotheses import Hypotheses, chosen_hypotheses, mean_and_error
from bcppl.inference.design.observations import Arguments, seeded
from bcppl.inference.design.ranking import Price, Prospect, Ranking, costs_in_nats, ranked
from bcppl.inference.population import Population
from bcppl.traces import Trace
from bcppl.traces.update import undrawn

# What a candidate tells of the pose at particles of a trace, (H, 6, 6); None where its sites say it.
Information = Callable[[Any, Trace], Tensor | None]

_STEPS = 6  # of Gauss and Newton, to where another mode explains an observation best


def linearised_information_gain(
    population: Population,
    candidates: Iterable[Any],
    extend_args: Arguments,
    address: str | None = None,
    *,
    hypotheses: int | None = None,
    information: Information | None = None,
    cost: Callable[[Any], Price] | Mapping[Any, Price] | None = None,
    rate: Price = 1.0,
    depth: int = 1,
    translation: float = 0.01,
    rotation: float = 0.2,
    seed: int | None = None,
) -> Ranking:
    """Candidates ranked by how many nats each is expected to tell of a pose, less what it costs.

        ranking = linearised_information_gain(population, touches, lambda touch: (scene, [*done, touch]))

    A hypothesis in which a touch misses is told that the part is not on the peg's way, and no more. Where the
    belief has several modes, each is asked how well it explains what a hypothesis would observe, at the place
    in it that explains it best; what is told of which mode is right counts as well.

    Only the hypotheses are simulated, the touches of all candidates in one batch. All candidates have the
    same hypotheses, and the same noise as far as they are felt at as many stamps. What `information` says
    tells nothing of which mode is right: of several modes, such candidates are worth more than is counted
    here, and a warning says so.

    With `depth=2` each candidate gains what it and the best candidate after it tell together, if that is
    worth its cost. The second is chosen before the first is felt, and tells what it would have told alone of
    where within a mode the part is. Of two that tell as much in either order, the one that tells more by
    itself comes first.

    Args:
        population: weighted particles.
        candidates: what may be done next; anything that `extend_args` understands.
        extend_args: the program's arguments once a candidate is done as well, those of all measurements so
            far included; a `Plan` is no action yet, `bcppl.sensors.candidates.action_of(plan)` is.
        address: of the pose; the first latent address unless given.
        hypotheses: how many play the truth, drawn systematically by weight; None: every particle, once.
        information: what a candidate tells at the hypotheses, (H, 6, 6) in the tangent space at their poses,
            for what else than touches may be done; where it gives None, and if it is not given, the
            `quadratic` of the candidate's sites is asked (`bcppl.distributions.manifold.ContactManifold`).
        cost: of a candidate, in any unit: a function of it or a mapping, giving a number or several by name.
        rate: nats that one unit of cost is worth; by name where costs are.
        depth: 1, or 2 to look ahead.
        translation: the gap between modes, metres; widened, with the other one, where particles are sparse.
        rotation: the gap between modes, radians.
        seed: None draws it from torch's generator.

    Raises:
        InputError: there are no candidates; the population has no weight, has collapsed to a point or does
            not span the pose's axes; a candidate adds nothing to observe, or what cannot be linearised;
            `information` gives no symmetric matrices, or some that are negative; a cost, a rate or a setting
            is out of range.
        InferenceError: the simulation of a candidate failed for every hypothesis.
    """
    candidates = list(candidates)
    if not candidates:
        raise InputError("there are no candidates to choose from; give one action or more.")
    depth = whole_number("probes are to be looked ahead by {} steps", depth, most=2)
    costs = costs_in_nats(candidates, cost, rate)
    seed = int(torch.randint(LARGEST_SEED, ())) if seed is None else seed_number(seed)
    with seeded(seed):
        truths = chosen_hypotheses(population, hypotheses)
    address = next(iter(population.trace.choices)) if address is None else address
    belief = Gaussians.fitted(population, address, translation, rotation)
    trace = population.trace.chosen(truths.particles)
    mode = belief.label[truths.particles]
    whites: list[Tensor] = []
    uncounted: list[int] = []
    prospects: list[Prospect] = []
    for k, predicted in enumerate(_predicted(trace, candidates, extend_args, information, seed)):
        white = belief.carried(predicted.information(), trace[address], mode)
        gains = nats(white)
        if bool(torch.isnan(gains).all()):
            raise InferenceError(f"the simulation of candidate {k} failed for every hypothesis.")
        warn_of_lost(k, torch.isnan(gains))
        if len(belief) > 1 and predicted.sites:
            gains = belief.entropy - _left(belief, predicted, trace, address, mode, gains)
        elif len(belief) > 1:
            uncounted.append(k)
        whites.append(white)
        gain, error = mean_and_error(gains, truths.weights)
        prospects.append(
            Prospect(
                candidates[k],
                k,
                gain,
                error,
                belief.entropy - gain,
                costs[k],
                1,
                gains=gains,
                weights=truths.weights,
            )
        )
    if uncounted:
        warnings.warn(
            f"the belief has {len(belief)} modes, and what {len(uncounted)} of {len(candidates)} candidates "
            f"(the first is candidate {uncounted[0]}) tell of which is right is not counted: their "
            "`information` says nothing of it.",
            stacklevel=2,
        )
    if depth == 2:
        prospects = [_followed(one, whites, costs, truths) for one in prospects]
    return ranked(prospects, belief.entropy)


@dataclass(frozen=True, eq=False)
class _Predicted:
    """A candidate's predicted observations.

    Attributes:
        args: the program's arguments once it is done.
        known: (H, 6, 6) its information; None where the sites are asked for it.
        sites: those that would be observed, at the hypotheses, by address.
        values: (H, *event) samples of what would be observed there, one for each hypothesis.
    """

    args: tuple[Any, ...]
    known: Tensor | None = None
    sites: Mapping[str, Any] = field(default_factory=dict)
    values: dict[str, Tensor] = field(default_factory=dict)

    def information(self) -> Tensor:
        """(H, 6, 6) at the hypotheses."""
        if self.known is not None:
            return self.known
        own = [site.quadratic(self.values[a]).information for a, site in self.sites.items()]
        return torch.stack(own).sum(dim=0)

    def elsewhere(self, trace: Trace) -> list[tuple[Any, Tensor]]:
        """The sites at other particles of a trace, and the hypotheses' observations at them."""
        longer = undrawn(trace, self.args)
        return [(longer.distributions[a], value) for a, value in self.values.items()]


def _predicted(
    trace: Trace,
    candidates: Sequence[Any],
    arguments: Arguments,
    information: Information | None,
    seed: int,
) -> list[_Predicted]:
    """Each candidate's predicted observations at the hypotheses; alike sites are sampled in one batch."""
    found: list[_Predicted] = []
    for k, candidate in enumerate(candidates):
        args = arguments(candidate)
        known = None if information is None else information(candidate, trace)
        if known is not None:
            found.append(_Predicted(args, _positive(k, known, trace.particles)))
            continue
        with seeded(seed):
            longer = undrawn(trace, args)
        added = [a for a in longer.since(trace) if a in longer.choices]
        if not added:
            raise InputError(
                f"candidate {k} adds no site that would be observed; "
                "give arguments that hold the old measurements and the new one."
            )
        sites = {one: longer.distributions[one] for one in added}
        for one, site in sites.items():
            if not hasattr(site, "quadratic"):
                raise InputError(
                    f"candidate {k} is observed at {one!r}, whose {type(site).__name__} has no `quadratic`; "
                    "give `information` for it, or use expected_information_gain."
                )
        found.append(_Predicted(args, None, sites, {one: longer[one] for one in added}))
    _sample(found, seed)
    return found


def _sample(predicted: Sequence[_Predicted], seed: int) -> None:
    """Sample the lazy sites: those of one type that can be simulated together in one batch."""
    batches: dict[type, list[tuple[_Predicted, str, Any]]] = {}
    for each in predicted:
        for address, site in each.sites.items():
            if hasattr(type(site), "samples"):
                batches.setdefault(type(site), []).append((each, address, site))
            elif isinstance(site, LazyDistribution):
                with seeded(seed):
                    each.values[address] = site.sample()
    for kind, batch in batches.items():
        with seeded(seed):
            samples = kind.samples([site for *_, site in batch])  # type: ignore[attr-defined]
        for (each, address, _), value in zip(batch, samples, strict=True):
            each.values[address] = value


def _positive(number: int, information: object, count: int) -> Tensor:
    """What a candidate is said to tell (H, 6, 6), once it was seen that it may be so."""
    said = f"what candidate {number} is said to tell"
    try:
        known = torch.as_tensor(information, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{said} is a {type(information).__name__}; give ({count}, 6, 6) numbers.") from None
    if tuple(known.shape) != (count, 6, 6):
        raise InputError(
            f"{said} has shape {tuple(known.shape)}; give ({count}, 6, 6): a matrix for each hypothesis."
        )
    sound = known[torch.isfinite(known).all(dim=2).all(dim=1)]
    if len(sound):
        # Of less than one to the square metre or radian the sign is rounding.
        scale = sound.diagonal(dim1=1, dim2=2).abs().clamp(min=1.0).sqrt()
        unitless = sound / (scale[:, :, None] * scale[:, None, :])
        even = bool((unitless - unitless.mT).abs().max() < 1e-3)
        if not (even and float(torch.linalg.eigvalsh(unitless).min()) > -0.1):
            raise InputError(
                f"{said} is no information: its matrices are to be symmetric and not negative; check the "
                "sign."
            )
    return known


def _left(
    belief: Gaussians, predicted: _Predicted, trace: Trace, address: str, mode: Tensor, within: Tensor
) -> Tensor:
    """Entropies (H,) that are left of a belief of several modes, each asked how it explains what is felt.

    The evidence of a mode is Laplace's: the likelihood at the place that explains the observation best, that
    place's density in the mode, and the volume about it.
    """
    count = len(mode)
    log_evidence, falls = [], []
    for k in range(len(belief)):
        start = torch.where((mode == k)[:, None], trace[address], belief.center[k])
        at, white = _best(belief, predicted, trace, address, k, start)
        found = trace.at({address: at})
        log_prob = torch.stack([site.log_prob(value) for site, value in predicted.elsewhere(found)]).sum(0)
        coordinates = belief.freedom.coordinates(poses.local(belief.center[k], at))
        off = torch.linalg.solve_triangular(belief.factor[k], coordinates.T, upper=False)
        falls.append(torch.where(mode == k, within, nats(white)))
        log_evidence.append(log_prob - 0.5 * off.square().sum(dim=0) - falls[-1])
    shares = torch.softmax(belief.mass.log()[:, None] + torch.stack(log_evidence), dim=0)
    each = belief.entropies[:, None] - torch.stack(falls)
    assert shares.shape == (len(belief), count)
    return (torch.special.entr(shares) + shares * each).sum(dim=0)


def _best(
    belief: Gaussians, predicted: _Predicted, trace: Trace, address: str, k: int, start: Tensor
) -> tuple[Tensor, Tensor]:
    """Where (H, 7) a mode explains each hypothesis' observation best, and the white information (H, d, d)."""
    at, count = start, len(start)
    modes = torch.full((count,), k)
    eye = torch.eye(belief.freedom.dimension, dtype=torch.float64)
    for _ in range(_STEPS):
        own = [s.quadratic(v) for s, v in predicted.elsewhere(trace.at({address: at}))]
        gradient, information = (torch.stack(each).sum(0) for each in zip(*own, strict=True))
        white = torch.nan_to_num(belief.carried(information, at, modes))
        axes = list(belief.freedom.axes)
        pull = torch.nan_to_num(gradient[:, axes] @ belief.factor[k])
        here = belief.freedom.coordinates(poses.local(belief.center[k], at))
        off = torch.linalg.solve_triangular(belief.factor[k], here.T, upper=False).T
        step = -torch.linalg.solve(eye + white, (pull + off)[..., None])[..., 0]
        step = step * (2.0 / step.norm(dim=1, keepdim=True).clamp(min=2.0))
        at = poses.retract(at, belief.freedom.embed(step @ belief.factor[k].T))
    own = [s.quadratic(v) for s, v in predicted.elsewhere(trace.at({address: at}))]
    return at, belief.carried(torch.stack([each.information for each in own]).sum(0), at, modes)


def _followed(
    first: Prospect, whites: Sequence[Tensor], costs: Sequence[float], truths: Hypotheses
) -> Prospect:
    """A prospect that holds what the best second step, chosen now, tells as well."""
    alone = nats(whites[first.number])
    both = torch.stack([nats(whites[first.number] + white) for white in whites])
    # By what it adds, over the hypotheses that tell of both: those of which one is lost may be the poor ones.
    added = [mean_and_error(one - alone, truths.weights)[0] for one in both]
    worth = torch.tensor([more - price for more, price in zip(added, costs, strict=True)]).nan_to_num(-1.0)
    best = int(worth.argmax())
    if not float(worth[best]) > 0.0:
        return replace(
            first, steps=2, then=torch.full((len(truths),), -1, dtype=torch.int64), immediate=first.value
        )
    gain = first.information_gain + added[best]
    _, error = mean_and_error(first.gains + both[best] - alone, truths.weights)
    return replace(
        first,
        information_gain=gain,
        standard_error=error,
        entropy=first.entropy + first.information_gain - gain,
        cost=first.cost + costs[best],
        steps=2,
        gains=first.gains + both[best] - alone,
        then=torch.full((len(truths),), best),
        immediate=first.value,
    )
