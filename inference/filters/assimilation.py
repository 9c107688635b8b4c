"""One more measurement by a pair of kernels (SMCP3), with as many copies of the particles as it needs."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress

from bcppl.errors import NoWeightError
from bcppl.inference.approximations.approximation import Approximation
from bcppl.inference.filters.screening import COPIES, by_mode, screened, screened_and_moved
from bcppl.inference.filters.smcp3 import Pair, move_and_weight
from bcppl.inference.filters.step import Assimilated, Observed
from bcppl.inference.kernels.rejuvenation import Moved
from bcppl.inference.population import Population
from bcppl.inference.sizing import replicate
from bcppl.inference.targets import Target

FEW = 0.2  # the effective sample size that SMCP3 is to leave, as a share of N
AMPLE = 30.0  # the same, enough for any N
# Where it does not, it is run again with more copies of each particle, as many as seem needed; at most so
# many of each and in all: memory and time grow with them. N of all are kept. Where even these leave less,
# the measurement is tempered: of 75 particles 3 were left along a bent ridge, sure of a part of it.
MOST, ROOM = 40, 40_000
LEAST = 0.03  # of N: where the screening of copies leaves less, the measurement is tempered


def assimilate(population: Population, observed: Observed, pair: Pair, least: int = 1) -> Assimilated | None:
    """The particles moved and weighted by a pair of kernels; None where too few keep weight.

    `least` is how many copies of each are made at least.
    """
    count = len(population)

    def weighted(population: Population) -> Population | None:
        try:
            return move_and_weight(population, pair, observed)
        except NoWeightError:
            return None

    goal, allowed = min(FEW * count, AMPLE), max(1, min(MOST, ROOM // count))
    times = min(least, allowed)
    reached = weighted(population if times == 1 else replicate(population, times))
    while times < allowed and (reached is None or reached.effective_sample_size < goal):
        before = 0.0 if reached is None else reached.effective_sample_size
        # The estimate is often too large: ask for more copies than would just do.
        times = min(allowed, max(2 * times, math.ceil(1.5 * goal * times / max(before, goal * times / MOST))))
        reached = weighted(replicate(population, times))
        if before and (reached is None or reached.effective_sample_size < before):
            return None  # more copies find what the proposal had missed
    if reached is None or reached.effective_sample_size < goal:
        return None
    effective = reached.effective_sample_size
    if times == 1:
        return Assimilated(reached, effective)
    chosen = by_mode(reached, count)
    return Assimilated(reached.selected(chosen), effective, chosen // times)


def assimilate_screened(
    population: Population,
    before: Approximation,
    observed: Observed,
    pair: Pair,
    moves: Callable[[Population, Target], Moved],
    threshold: float,
    least: int = 1,
) -> Assimilated | None:
    """The same where a cheap likelihood chooses among copies, and the others are simulated.

    They have been `moved` before that where physics says so little beyond it that a share `threshold` of the
    particles stays effective.
    """
    count, copies = len(population), max(least, COPIES)
    few: Assimilated | None = None
    with suppress(NoWeightError):
        few = screened_and_moved(population, before, observed, pair, moves, threshold * count, copies)
    with suppress(NoWeightError):
        few = few or screened(population, before, observed, pair, copies)
    return None if few is None or few.effective < LEAST * count else few
