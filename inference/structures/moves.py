"""Moves of strata: functions `(strata, target) -> (strata, acceptance)` that leave a target invariant.

    means = by_structure(lambda s: hmc([f"mean_{j}" for j in range(s["count"])]))
    move = in_turn(within(means), jump(birth))
    for _ in range(1000):  # N reversible-jump chains
        strata, acceptance = move(strata, POSTERIOR)

Weights stay with their particles, and so does the evidence.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.kernels import Kernel, Move, Until, moved_by
from bcppl.inference.kernels.kernel import refuse_no_kernel, takes
from bcppl.inference.population import Population
from bcppl.inference.structures.strata import Strata
from bcppl.inference.targets import Target
from bcppl.traces import Structure


class MovedStrata(NamedTuple):
    """Strata whose particles were moved.

    Attributes:
        strata: with the same weights.
        acceptance: the share of proposals that were accepted, by kind of move; NaN where none was made.
    """

    strata: Strata
    acceptance: tuple[float, ...]


StrataMove = Callable[[Strata, Target], MovedStrata]


def within(kernel: Kernel, sweeps: int | Until = 1) -> StrataMove:
    """A move of every particle by a kernel that is fitted within its stratum; structures stay.

    Args:
        kernel: of the sites that all structures have, or one `by_structure`.
        sweeps: moves of every particle.

    Raises:
        InputError: the argument is no kernel.
    """
    refuse_no_kernel("within", kernel)

    def move(strata: Strata, target: Target) -> MovedStrata:
        moved = {
            structure: moved_by(each, kernel, target.within(each.trace), sweeps)
            for structure, each in strata.populations.items()
            # Where a structure determines all, there is nothing to move.
            if each.trace.choices
        }
        total = sum(len(each.population) for each in moved.values())
        accepted = sum(len(each.population) * each.acceptance for each in moved.values())
        share = accepted / total if total else math.nan
        populations = {s: moved[s].population if s in moved else p for s, p in strata.populations.items()}
        return MovedStrata(Strata(populations, strata.log_evidence), (share,))

    return move


def by_structure(choose: Callable[[Structure], Kernel]) -> Kernel:
    """The kernel that a function gives for a population's structure."""

    def kernel(population: Population) -> Move:
        return choose(population.trace.structure)(population)

    return kernel


def in_turn(*moves: StrataMove, times: int = 1) -> StrataMove:
    """Several moves one after another, all of them a number of times.

    Raises:
        InputError: there is no move, or no whole number of times, 1 or more.
    """
    times = whole_number("moves of strata are to be made {} times", times)
    for each in moves:
        refuse_no_move("in_turn", each)
    if not moves:
        raise InputError("in_turn is given no move; give one or more, such as within(kernel) and jump(...).")

    def move(strata: Strata, target: Target) -> MovedStrata:
        shares: list[tuple[float, ...]] = []
        for _ in range(times):
            made: tuple[float, ...] = ()
            for each in moves:
                strata, acceptance = each(strata, target)
                made += acceptance
            shares.append(made)
        # A jump that nobody made in a round has no share of it.
        each_round = torch.tensor(shares, dtype=torch.float64)
        return MovedStrata(strata, tuple(each_round.nanmean(dim=0).tolist()))

    return move


def refuse_no_move(where: str, move: object) -> None:
    """Refuse what cannot be a move of strata."""
    if not callable(move) or not takes(move, 2):
        given = "a kernel" if callable(move) else f"a {type(move).__name__}"
        raise InputError(
            f"{where} is given {given} in place of a move of strata; make it one with within(kernel), or "
            "give jump(Jump(...))."
        )
