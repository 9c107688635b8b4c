"""Resampling: schemes, ancestors (count,) from log weights (N,), and when to resample.

    import torch
    from bcppl.inference.resampling import systematic

    log_weights = torch.tensor([0.1, 0.2, 0.7]).double().log()
    print(systematic(log_weights, 10).bincount())  # 1, 2 and 7 offspring

Each scheme is unbiased: a particle's expected number of offspring is count times its normalised weight. A
particle without weight has none. Ancestors are in increasing order. All take time linear in N and count,
except `multinomial` and the remainder of `residual`, which search. Douc, Cappe and Moulines, Comparison of
resampling schemes for particle filtering, ISPA 2005; Gerber, Chopin and Whiteley, Negative association,
ordering and convergence of resampling methods, Annals of Statistics 47, 2019.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

import torch
from torch import Tensor

from bcppl.arguments import number_within, seed_number, whole_number
from bcppl.beliefs import normalised
from bcppl.devices import same_random_state, seed_here
from bcppl.errors import InputError
from bcppl.inference.population import Population


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Torch's generator seeded within, and restored afterwards."""
    with same_random_state():
        seed_here(seed_number(seed))
        yield


class Scheme(Protocol):
    """Ancestors (count,) int64 of particles with log weights (N,); N of them unless a count is given."""

    def __call__(self, log_weights: Tensor, count: int | None = None, /) -> Tensor:
        """Draw the ancestors; `count` is 1 or more."""
        ...


def systematic(log_weights: Tensor, count: int | None = None) -> Tensor:
    """One uniform draw and equal steps: offspring are the expected number, rounded down or up.

    Carpenter, Clifford and Fearnhead, Improved particle filter for nonlinear problems, IEE Proc. 146, 1999.
    """
    weights, count = _checked(log_weights, count)
    offset = torch.rand((), dtype=torch.float64)
    below = weights.cumsum(0).mul_(count).sub_(offset).ceil_()
    return _ancestors(_closed(below, weights, count), count)


def stratified(log_weights: Tensor, count: int | None = None) -> Tensor:
    """One uniform draw in each of `count` equal strata (Kitagawa, JCGS 5, 1996)."""
    weights, count = _checked(log_weights, count)
    draws = torch.rand(count, dtype=torch.float64)
    place = weights.cumsum(0).mul_(count)
    stratum = place.floor().clamp_(max=count - 1)
    place -= stratum
    below = stratum.add_(draws[stratum.long()] < place)
    return _ancestors(_closed(below, weights, count), count)


def multinomial(log_weights: Tensor, count: int | None = None) -> Tensor:
    """Independent draws by weight (Gordon, Salmond and Smith, IEE Proc. F 140, 1993)."""
    weights, count = _checked(log_weights, count)
    return _independent(weights, count)


def residual(log_weights: Tensor, count: int | None = None) -> Tensor:
    """Each particle's expected number rounded down, and independent draws of the remainder.

    Liu and Chen, Sequential Monte Carlo methods for dynamic systems, JASA 93, 1998.
    """
    weights, count = _checked(log_weights, count)
    copies, remainder = _parts(weights, count)
    rest = count - int(copies.sum())
    if rest:
        copies += torch.bincount(_independent(remainder / remainder.sum(), rest), minlength=len(copies))
    return torch.repeat_interleave(copies, output_size=count)


def ssp(log_weights: Tensor, count: int | None = None) -> Tensor:
    """Srinivasan sampling process: expected numbers rounded down or up, negatively associated.

    In each pair of neighbours one is rounded, and the other is paired again in the next round (Srinivasan,
    Distributions on level-sets with applications to approximation algorithms, FOCS 2001, section 2). Gerber,
    Chopin and Whiteley (algorithm 1) pair in a line, here it is a tree: their theorem 1 holds for any order
    of pairs.
    """
    weights, count = _checked(log_weights, count)
    copies, left = _parts(weights, count)
    index = torch.arange(len(weights))
    while len(index) > 1:
        odd = index[-1:] if len(index) % 2 else index[:0]
        first, second = index[: len(index) - len(odd)].reshape(-1, 2).T
        p, q = left[first], left[second]
        total = p + q
        up = total >= 1.0
        # Below 1 one of the two takes the sum and stays; from 1 up one is rounded up, the other stays.
        chance = torch.where(up, (1.0 - q) / (2.0 - total), p / total)
        wins = torch.rand(len(first), dtype=torch.float64) < chance
        winner, loser = torch.where(wins, first, second), torch.where(wins, second, first)
        copies[winner[up]] += 1
        staying = torch.where(up, loser, winner)
        left[staying] = torch.where(up, total - 1.0, total)
        index = torch.cat([staying, odd])
    # The last remainder is a whole number, but for rounding.
    copies[index] += count - copies.sum()
    return torch.repeat_interleave(copies, output_size=count)


def _checked(log_weights: Tensor, count: int | None) -> tuple[Tensor, int]:
    weights = torch.softmax(log_weights, 0)
    if not bool(torch.isfinite(weights.sum())):
        normalised(log_weights)
    if count is None:
        return weights, len(log_weights)
    return weights, whole_number("resampling is given the count {}", count)


def _last(weights: Tensor) -> int:
    """The last particle with any weight: it takes the rounding error at the end of a cumulative sum."""
    return int(weights.nonzero()[-1])


def _closed(below: Tensor, weights: Tensor, count: int) -> Tensor:
    """The number of points below the end of each particle's interval; all of them for the last."""
    below.clamp_(max=count)
    if float(below[-1]) < count:
        below[_last(weights) :] = count
    return below


def _ancestors(below: Tensor, count: int) -> Tensor:
    """The particle (count,) whose interval contains each point."""
    # Point j is beyond the intervals of all particles with j points or fewer below their ends; this count
    # takes half to a third of the time of repeating each index.
    return torch.bincount(below.long(), minlength=count)[:count].cumsum(0)


def _independent(weights: Tensor, count: int) -> Tensor:
    # Sums of exponential draws over their total are sorted uniform ones, without sorting.
    sums = torch.empty(count + 1, dtype=torch.float64).exponential_().cumsum_(0)
    points = sums[:-1] / sums[-1]
    return torch.searchsorted(weights.cumsum(0), points, right=True).clamp_max(_last(weights))


def _parts(weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Expected offspring of each particle: the whole part (N,) int64, and the remainder."""
    expected = weights * count
    whole = expected.floor()
    return whole.long(), expected.sub_(whole)


# The resampled population and its ancestors (N,), or the same population and None.
Resample = Callable[[Population], tuple[Population, Tensor | None]]


def always(scheme: Scheme = systematic) -> Resample:
    """Resample at every opportunity."""

    def resample(population: Population) -> tuple[Population, Tensor | None]:
        ancestors = scheme(population.log_weights)
        return population.selected(ancestors), ancestors

    return resample


def refuse_no_resampling(where: str, resample: object) -> None:
    """Check that an argument is a `Resample`, and not a scheme by itself."""
    if not callable(resample) or resample in (systematic, stratified, multinomial, residual, ssp):
        name = getattr(resample, "__name__", type(resample).__name__)
        raise InputError(
            f"{where} is given {name} as resample, which does not define when to resample; "
            "give always(scheme), adaptive(scheme, 0.5) or never."
        )


def never(population: Population) -> tuple[Population, Tensor | None]:
    """Do not resample."""
    return population, None


def adaptive(scheme: Scheme = systematic, threshold: float = 0.5) -> Resample:
    """Resample when the effective sample size falls below a share `threshold`, 0 to 1, of the particles."""
    threshold = number_within("adaptive is given the threshold {}", threshold, least=0.0, most=1.0)
    resample = always(scheme)

    def when_needed(population: Population) -> tuple[Population, Tensor | None]:
        if population.effective_sample_size >= threshold * len(population):
            return population, None
        return resample(population)

    return when_needed
