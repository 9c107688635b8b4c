"""The outer samples of nested Monte Carlo, the expected utility of candidates under them, and a ranking."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import LARGEST_SEED, number_within, seed_number, whole_number
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.resampling import systematic
from bcppl.inference.summaries import WEIGHTLESS

Cost = float | Mapping[str, float]
# The cost of a candidate in any unit: a function of it or a mapping, with a number or several by name.
Costs = Callable[[Any], Cost] | Mapping[Any, Cost]

_ALIKE = 6  # decimals of a nat; differences beyond are rounding


@dataclass(frozen=True, eq=False)
class OuterSamples:
    """Particles (S,) that serve as the true value in turn, and their normalised weights (S,).

    The outer samples of nested Monte Carlo. One may occur several times, each time with its own noise.
    """

    particles: Tensor
    weights: Tensor

    def __len__(self) -> int:
        return len(self.particles)


def draw_outer_samples(population: Population, count: int | None) -> OuterSamples:
    """`count` particles drawn systematically by weight; None: every one with weight once, by its weight."""
    if not math.isfinite(population.log_total):
        raise InputError(WEIGHTLESS)
    weights = torch.softmax(population.log_weights, 0)
    if count is None:
        particles = (weights > 0).nonzero().flatten()
        return OuterSamples(particles, weights[particles])
    count = whole_number("{} outer samples were asked for", count, least=2)
    particles = systematic(population.log_weights, count)
    return OuterSamples(particles, torch.full((count,), 1.0 / count, dtype=torch.float64))


def mean_and_error(values: Tensor, weights: Tensor) -> tuple[float, float]:
    """The weighted mean of values (S,) and its standard error, as if outer samples were independent.

    Systematic draws are not independent, so the error is a little too large: by the share of the variance
    that is between particles rather than between draws of the noise. NaN values are left out; if all are
    NaN, the mean is NaN and the error infinite.
    """
    valid = ~torch.isnan(values)
    if not bool(valid.any()):
        return math.nan, math.inf
    values, weights = values[valid], weights[valid] / weights[valid].sum()
    mean = weights @ values
    squares = weights.square()
    remaining = float(1.0 - squares.sum())
    variance = float(squares @ (values - mean).square())
    return float(mean), math.sqrt(variance / remaining) if remaining > 1e-12 else math.inf


def warn_of_failures(number: int, failed: Tensor) -> None:
    """Warn where the information gain of a candidate leaves out some of its outer samples (S,)."""
    if bool(failed.any()):
        warnings.warn(
            f"the expected information gain of candidate {number} leaves out {int(failed.sum())} of "
            f"{len(failed)} outer samples: their simulation failed, or no particle can explain the result.",
            stacklevel=3,
        )


@dataclass(frozen=True, eq=False)
class Utility:
    """The expected utility of a candidate: its expected information gain less its cost, nats.

    Attributes:
        candidate: the candidate.
        number: its place in the list of candidates, from 0.
        information_gain: the expected reduction of the entropy, nats.
        standard_error: of the gain, over the outer samples.
        entropy: expected after the measurement, nats.
        cost: nats; with a horizon of 2 the expected cost of the second step is included.
        horizon: the number of steps that are planned, this one included.
        gains: (S,) the gain under each outer sample, NaN where its simulation failed. The k-th one is the
            same true value with the same noise for every candidate.
        weights: (S,) of the outer samples.
        myopic: with a horizon of 2, the utility of the candidate alone; of candidates of equal utility the
            one with the larger myopic utility ranks first. NaN with a horizon of 1.
        second: (S,) int64 the number of the best candidate for the second step under each outer sample, -1
            where none is worth its cost; None with a horizon of 1.
    """

    candidate: Any
    number: int
    information_gain: float
    standard_error: float
    entropy: float
    cost: float
    horizon: int
    gains: Tensor = field(repr=False)
    weights: Tensor = field(repr=False)
    second: Tensor | None = field(default=None, repr=False)
    myopic: float = math.nan

    @classmethod
    def of(
        cls, candidate: Any, number: int, gains: Tensor, outer: OuterSamples, entropy: float, cost: float
    ) -> Utility:
        """That of one step, given the gains (S,) under outer samples and the present entropy."""
        gain, error = mean_and_error(gains, outer.weights)
        return cls(candidate, number, gain, error, entropy - gain, cost, 1, gains, outer.weights)

    def with_second_step(
        self, gains: Tensor, gain: float, error: float, cost: float, second: Tensor
    ) -> Utility:
        """That of two steps, given the gains (S,) of both, their mean and error, and the second's cost."""
        return replace(
            self,
            information_gain=gain,
            standard_error=error,
            entropy=self.entropy + self.information_gain - gain,
            cost=self.cost + cost,
            horizon=2,
            gains=gains,
            second=second,
            myopic=self.value,
        )

    @property
    def value(self) -> float:
        """Information gain less cost, nats."""
        return self.information_gain - self.cost


@dataclass(frozen=True, eq=False)
class Ranking(Sequence[Utility]):
    """Candidates by their expected utility, the best first; those with the longer horizon precede the others.

    The entropy is that of the population now, nats.
    """

    utilities: tuple[Utility, ...]
    entropy: float

    @property
    def best(self) -> Utility:
        """The first."""
        return self.utilities[0]

    def __len__(self) -> int:
        return len(self.utilities)

    def __getitem__(self, index: Any) -> Any:
        return self.utilities[index]

    def of(self, number: int) -> Utility:
        """The utility of the candidate at a place in the list of candidates, from 0."""
        return next(each for each in self.utilities if each.number == number)

    def difference(self, first: Utility, second: Utility) -> tuple[float, float]:
        """The difference of two information gains, nats, and its standard error.

        The outer samples and the seed of the noise are the same for both, so the error is smaller than those
        of the two gains together. It is the error of one step alone. (nan, inf) where no outer sample is
        valid for both.
        """
        return mean_and_error(first.gains - second.gains, first.weights)

    def __str__(self) -> str:
        rows = [f"entropy now {self.entropy:.3f} nats", "number   gain (nats)    error     cost    value"]
        rows += [
            f"{u.number:6d} {u.information_gain:13.3f} {u.standard_error:8.3f} {u.cost:8.3f} {u.value:8.3f}"
            f"  {_name(u.candidate)}".rstrip()
            for u in self.utilities
        ]
        return "\n".join(rows)


def _name(candidate: Any) -> str:
    """A candidate's name, or its camera's; empty where it has none."""
    return str(getattr(getattr(candidate, "camera", candidate), "name", ""))


def rank(utilities: Sequence[Utility], entropy: float) -> Ranking:
    """Utilities in order; of equal ones those first with the larger myopic utility, then as they were given.

    Two touches are equally informative in either order, and the second may never be executed.
    """

    def key(one: Utility) -> tuple[float, ...]:
        myopic = one.value if math.isnan(one.myopic) else one.myopic
        return -one.horizon, -round(one.value, _ALIKE), -myopic, one.number

    return Ranking(tuple(sorted(utilities, key=key)), entropy)


def checked(
    candidates: Iterable[Any], cost: Costs | None, rate: Cost, horizon: int, seed: int | None
) -> tuple[list[Any], list[float], int]:
    """The candidates, the cost of each in nats, and the seed; None draws one from torch's generator."""
    candidates = list(candidates)
    if not candidates:
        raise InputError("there are no candidates to choose from; give one action or more.")
    whole_number("a horizon of {} steps was asked for", horizon, most=2)
    costs = costs_in_nats(candidates, cost, rate)
    return candidates, costs, int(torch.randint(LARGEST_SEED, ())) if seed is None else seed_number(seed)


def costs_in_nats(candidates: Sequence[Any], cost: Costs | None, rate: Cost) -> list[float]:
    """The cost of each candidate in nats; without costs all are free.

    A cost is a number, or several by name ({"time": 2.0, "force": 5.0}); the rate is nats for one unit of it,
    by name where costs are.
    """
    if cost is None and rate != 1.0:
        raise InputError(
            f"a rate of {rate} is given without a cost; give cost=..., a function of a candidate."
        )
    return [0.0 if cost is None else _cost(k, one, cost, rate) for k, one in enumerate(candidates)]


def _cost(number: int, candidate: Any, cost: Any, rate: Cost) -> float:
    if isinstance(cost, Mapping) and candidate not in cost:
        raise InputError(f"candidate {number} is missing in the mapping of costs; give the cost of each.")
    price = cost[candidate] if isinstance(cost, Mapping) else cost(candidate)
    if not isinstance(price, Mapping):
        if isinstance(rate, Mapping):
            raise InputError(
                f"candidate {number} costs a single number and the rates are {', '.join(rate)}; "
                "give one rate in nats per unit, or costs by these names."
            )
        price, rate = {"": price}, {"": rate}
    total = 0.0
    for name, amount in price.items():
        if not isinstance(rate, Mapping) or name not in rate:
            raise InputError(
                f"candidate {number} costs {name!r}, which has no rate; "
                f'give nats per unit for each, rate={{"{name}": ...}}.'
            )
        what = repr(name) if name else "the cost"
        total += number_within(f"candidate {number} costs {{}}", amount) * number_within(
            f"the rate of {what} is {{}} nats per unit", rate[name], least=0.0
        )
    return total
