"""What candidates are expected to tell, put in order."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.inference.design.hypotheses import mean_and_error

Price = float | Mapping[str, float]

_ALIKE = 6  # decimals of a nat, beyond which is rounding


@dataclass(frozen=True, eq=False)
class Prospect:
    """What one candidate is expected to tell.

    Attributes:
        candidate: as it was given.
        number: its place in the list that was given, from 0.
        information_gain: nats by which the entropy is expected to fall.
        standard_error: of that, over the hypotheses.
        entropy: expected afterwards, nats.
        cost: of the candidate, in nats, and what a second step is expected to cost.
        steps: how many steps it is looked ahead, this one included.
        gains: (H,) the gain under every hypothesis, NaN where it could not be simulated. The k-th is the same
            truth with the same noise for every candidate.
        weights: (H,) of the hypotheses.
        immediate: nats that it tells by itself less its own cost; of candidates that are worth the same it
            comes first that has more of it. NaN where nothing was looked ahead: `value` says it.
        then: (H,) int64 the number of the best candidate after this one, under every hypothesis; -1 where
            none is worth its cost. None where nothing was looked ahead.
    """

    candidate: Any
    number: int
    information_gain: float
    standard_error: float
    entropy: float
    cost: float
    steps: int
    gains: Tensor = field(repr=False)
    weights: Tensor = field(repr=False)
    then: Tensor | None = field(default=None, repr=False)
    immediate: float = math.nan

    @property
    def value(self) -> float:
        """Information less cost, nats: what candidates are ranked by."""
        return self.information_gain - self.cost


@dataclass(frozen=True, eq=False)
class Ranking(Sequence[Prospect]):
    """Candidates, the best first: by value, those that were looked ahead farthest before the others.

    Attributes:
        prospects: in that order.
        entropy: of the population now, nats.
    """

    prospects: tuple[Prospect, ...]
    entropy: float

    @property
    def best(self) -> Prospect:
        """The first."""
        return self.prospects[0]

    def __len__(self) -> int:
        return len(self.prospects)

    def __getitem__(self, index: Any) -> Any:
        return self.prospects[index]

    def of(self, number: int) -> Prospect:
        """What is expected of the candidate that was given at a place, from 0."""
        return next(each for each in self.prospects if each.number == number)

    def difference(self, first: Prospect, second: Prospect) -> tuple[float, float]:
        """By how many nats the gain of one exceeds that of another, and the standard error of that.

        The hypotheses and the noise's seed are the same for both, so it is smaller than the two errors
        together. It counts one step of look-ahead's error only. (nan, inf) where no hypothesis told of both.
        """
        return mean_and_error(first.gains - second.gains, first.weights)

    def __str__(self) -> str:
        rows = [f"entropy now {self.entropy:.3f} nats", "number   gain (nats)    error     cost    value"]
        rows += [
            f"{p.number:6d} {p.information_gain:13.3f} {p.standard_error:8.3f} {p.cost:8.3f} {p.value:8.3f}"
            f"  {_named(p.candidate)}".rstrip()
            for p in self.prospects
        ]
        return "\n".join(rows)


def _named(candidate: Any) -> str:
    """A candidate's name, or its camera's; empty where it has none."""
    return str(getattr(getattr(candidate, "camera", candidate), "name", ""))


def ranked(prospects: Sequence[Prospect], entropy: float) -> Ranking:
    """Prospects in order; of equal ones those first that tell more at once, then as they were given.

    Two touches tell as much in either order, and the rest of a plan may never be carried out.
    """

    def place(one: Prospect) -> tuple[float, ...]:
        at_once = one.value if math.isnan(one.immediate) else one.immediate
        return -one.steps, -round(one.value, _ALIKE), -at_once, one.number

    return Ranking(tuple(sorted(prospects, key=place)), entropy)


def costs_in_nats(
    candidates: Sequence[Any],
    cost: Callable[[Any], Price] | Mapping[Any, Price] | None,
    rate: Price,
) -> list[float]:
    """The cost of every candidate in nats.

    Args:
        candidates: what may be done next.
        cost: of a candidate, as a function or by candidate: a number, or several by name ({"time": 2.0,
            "force": 5.0}). None: all are free.
        rate: nats for one unit of it; by name where costs are.

    Raises:
        InputError: a candidate has no cost, a cost has no rate or a rate no cost, or one of them is no finite
            number.
    """
    if cost is None and rate != 1.0:
        raise InputError(
            f"a rate of {rate} is given without a cost; give cost=..., a function of a candidate."
        )
    if not (cost is None or callable(cost) or isinstance(cost, Mapping)):
        raise InputError(
            f"the cost is a {type(cost).__name__}; give a function of a candidate, or what maps candidates "
            "to costs."
        )
    return [0.0 if cost is None else _cost(k, one, cost, rate) for k, one in enumerate(candidates)]


def _cost(number: int, candidate: Any, cost: Any, rate: Price) -> float:
    if isinstance(cost, Mapping):
        try:
            price = cost[candidate]
        except (KeyError, TypeError):
            raise InputError(
                f"candidate {number} has no cost in what maps candidates to costs; "
                "add it, or give a function of the candidate."
            ) from None
    else:
        price = cost(candidate)
    if not isinstance(price, Mapping):
        if isinstance(rate, Mapping):
            raise InputError(
                f"candidate {number} costs a single number and the rates are {', '.join(rate)}; "
                "give one rate in nats per unit, or costs by these names."
            )
        return _number(number, price) * _rate("the cost", rate)
    total = 0.0
    for name, amount in price.items():
        if not isinstance(rate, Mapping) or name not in rate:
            raise InputError(
                f"candidate {number} costs {name!r}, which has no rate; "
                f'give nats per unit for each, rate={{"{name}": ...}}.'
            )
        total += _number(number, amount) * _rate(f"{name!r}", rate[name])
    return total


def _number(number: int, price: Any) -> float:
    return number_within(f"candidate {number} costs {{}}", price)


def _rate(name: str, rate: Any) -> float:
    return number_within(f"the rate of {name} is {{}} nats per unit", rate, least=0.0)
