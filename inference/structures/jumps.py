"""Reversible jumps: Metropolis-Hastings moves of particles from one structure to another.

Green, Reversible jump Markov chain Monte Carlo computation and Bayesian model determination, Biometrika 82,
1995, eqs. 7 and 8, with everything but the programs derived (`bcppl.inference.structures.translation`).

    birth = Jump(to=lambda s: {"count": s["count"] + 1} if s["count"] < 3 else None,
                 back=lambda s: {"count": s["count"] - 1} if s["count"] > 1 else None,
                 forward=split, backward=merged)
    strata, acceptance = jump(birth)(strata, POSTERIOR)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.structures.moves import MovedStrata, StrataMove
from bcppl.inference.structures.strata import Strata
from bcppl.inference.structures.translation import sampling_nothing, translated
from bcppl.inference.targets import Target
from bcppl.traces import Program, Structure, Trace
from bcppl.traces.values import Values

Change = Callable[[Structure], Mapping[str, int] | None]


@dataclass(frozen=True)
class Jump:
    """A move to other structures, and its reverse, which is proposed as well.

    Attributes:
        to: the new values of structural sites that it leads to from a structure; None where it does not
            start there.
        back: the same for the reverse move: `back` undoes `to`.
        forward: program of a trace of the first structure (see `translated`); by default new values are
            sampled from the model.
        backward: program of a trace of the second.
        check: check at every move, not only at the first one from each structure, that one program undoes
            the other, that the Jacobians of both cancel, and that particles are not mixed.
    """

    to: Change
    back: Change
    forward: Program = sampling_nothing
    backward: Program = sampling_nothing
    check: bool = False


class _Way(NamedTuple):
    """A jump in one of its two directions, from a structure."""

    jump: Jump
    reversed: bool
    values: Mapping[str, int]

    @property
    def programs(self) -> tuple[Program, Program]:
        first, second = self.jump.forward, self.jump.backward
        return (second, first) if self.reversed else (first, second)


def jump(*jumps: Jump) -> StrataMove:
    """A move in which every particle proposes one of the jumps that start from its structure.

    Each of them is as likely as any other, in either direction; the acceptance ratio takes account of how
    many start from the new structure. Particles of one structure with the same jump move in one batch.

    Args:
        jumps: in whose directions the particles move.

    Returns:
        The move. Its acceptance is that of each jump, forward and back in turn.

    Raises:
        InputError: there is no jump; when it moves: a jump is not undone by its reverse, or leads to a
            structure that it does not start back from.
    """
    if not jumps or not all(isinstance(each, Jump) for each in jumps):
        given = ", ".join(type(each).__name__ for each in jumps) or "nothing"
        raise InputError(f"jump is given {given}; give one Jump or more, Jump(to, back, forward, backward).")
    checked: set[tuple[int, int, Structure]] = set()

    def move(strata: Strata, target: Target) -> MovedStrata:
        parts: list[tuple[Structure, Population]] = []
        made, taken = torch.zeros(len(jumps), 2), torch.zeros(len(jumps), 2)
        for structure, population in strata.populations.items():
            ways = _ways(jumps, structure)
            if not ways:
                parts.append((structure, population))
                continue
            choice = torch.randint(len(ways), (len(population),))
            stays = torch.ones(len(population), dtype=torch.bool)
            for number, way in enumerate(ways):
                mine = (choice == number).nonzero().flatten()
                if len(mine) == 0:
                    continue
                jumping = population if len(ways) == 1 else population[mine]
                which = jumps.index(way.jump), int(way.reversed)
                first = (*which, structure) not in checked
                jumped = _jumped(jumping, way, len(ways), jumps, target, way.jump.check or first)
                checked.add((*which, structure))
                if jumped.population is not None:
                    stays[mine[jumped.accepted]] = False
                    parts.append((jumped.structure, jumped.population))
                made[which] += len(mine)
                taken[which] += len(jumped.accepted)
            if bool(stays.any()):
                parts.append((structure, population if bool(stays.all()) else population[stays]))
        moved = Strata.of(parts, strata.log_evidence)
        return MovedStrata(moved, tuple((taken / made).flatten().tolist()))

    return move


def _ways(jumps: tuple[Jump, ...], structure: Structure) -> list[_Way]:
    """The jumps that start from a structure, each direction for itself."""
    ways = [
        _Way(each, backwards, values)
        for each in jumps
        for backwards, change in ((False, each.to), (True, each.back))
        if (values := change(structure)) is not None
    ]
    for way in ways:
        if not isinstance(way.values, Mapping):
            raise InputError(
                f"a jump leads from {structure} to {way.values!r}; let `to` and `back` give new values "
                "of structural sites by address, {'count': 2}, or None."
            )
    return ways


class _Jumped(NamedTuple):
    """The structure that a jump leads to, and the particles that accept it: which, and where they are now."""

    structure: Structure
    accepted: Tensor
    population: Population | None


def _jumped(
    population: Population, way: _Way, choices: int, jumps: tuple[Jump, ...], target: Target, check: bool
) -> _Jumped:
    """The particles of a population after a jump, one of so many that they had to choose from."""
    old, observations = population.trace, Structure(way.values).observations

    def renewed(values: Values) -> Trace:
        try:
            new = old.revised(values, observations=observations)
        except InputError as error:
            raise InputError(
                f"a jump from {old.structure} to {dict(way.values)} does not fit: {error} Latent values are "
                "kept by address; where one changes its shape, let `forward` and `backward` give it."
            ) from error
        for address in way.values:
            if address not in new.structure:
                raise InputError(
                    f"a jump from {old.structure} gives a value of {address!r}, which is no structural site "
                    f"of {new.structure}, where it leads to; let `to` and `back` give values of these."
                )
        return new

    new, log_factor = translated(old, *way.programs, renewed, check)
    structure = new.structure
    back = _ways(jumps, structure)
    _refuse_one_way(old.structure, structure, way, back)
    # The reverse is proposed among those that start from the new structure.
    log_ratio = log_factor + math.log(choices) - math.log(len(back))
    chance = torch.log(torch.rand(len(old), dtype=torch.float64))
    needed = chance + target.within(old)(old) - log_ratio
    accepted, trace = target.within(new).above(new, needed)
    if len(accepted) == 0:
        return _Jumped(structure, accepted, None)
    return _Jumped(structure, accepted, replace(population[accepted], trace=trace, approximation=None))


def _refuse_one_way(old: Structure, new: Structure, way: _Way, back: list[_Way]) -> None:
    """Refuse a jump whose reverse does not lead back to where it started."""
    for each in back:
        if each.jump is way.jump and each.reversed != way.reversed:
            reached = new.with_values(each.values)
            if all(reached.get(a) == v for a, v in old.items()):
                return
    raise InputError(
        f"a jump leads from {old} to {new}, from where its reverse does not lead back; let `back` undo `to`."
    )
