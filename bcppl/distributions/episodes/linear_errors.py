"""Errors that all touches of a bench share, and that move the held peg linearly: nuisance parameters.

Each has parameters that are standard normal a priori, and gives, for each row of a probe, how the peg is
displaced from where it was measured (a twist in its frame, metres and radians) and how the gap changes,
by one unit of each parameter. What the gap makes of a twist is the same for all errors, so an error never
sees a particle. `ContactEpisodes` integrates the parameters out. `nuisances` has those of real benches.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from bcppl.cached import cached_property
from bcppl.devices import HOST, on_host
from bcppl.distributions.episodes.rows import COLUMNS, late
from bcppl.errors import InputError


class Effect(NamedTuple):
    """What M parameters do to the peg at T rows, by one standard deviation of each.

    Attributes:
        twist: (T, 6, M) of the peg in its frame, m and rad.
        offset: (T, M) of the gap besides, m.
    """

    twist: Tensor
    offset: Tensor


class Jump(NamedTuple):
    """A sudden change of an error's parameters, at the beginning of an episode.

    Attributes:
        name: in words, as "the peg slipped in the hand".
        probability: at each episode.
        variances: (M,) of the change of each parameter.
    """

    name: str
    probability: float
    variances: Tensor


class Change(NamedTuple):
    """What may happen to the errors at an episode: none of their jumps, one, or several at once.

    Attributes:
        jumps: their numbers; empty for none.
        probability: that these happen and no others.
        variances: (M,) of the change of each parameter.
    """

    jumps: tuple[int, ...]
    probability: float
    variances: Tensor


@runtime_checkable
class LinearError(Protocol):
    """An error that all touches share."""

    @property
    def name(self) -> str:
        """In words."""

    @property
    def means(self) -> Tensor:
        """(M,) prior means of the parameters, in their standard deviations."""

    @property
    def variances(self) -> Tensor:
        """(M,) prior variances of the parameters: 1, or 0 for one that only jumps."""

    @property
    def jumps(self) -> Sequence[Jump]:
        """Its sudden changes."""

    @property
    def delays(self) -> Mapping[int, float]:
        """Probabilities of the intervals (`rows.late`) of the wrench's delay; empty for another error."""

    def effect(self, rows: Tensor) -> Effect:
        """Its effect at rows (T, COLUMNS)."""


@dataclass(frozen=True)
class LinearErrors:
    """Several errors together, and which parameters are whose.

    Attributes:
        errors: each error, its name its own.

    Raises:
        InputError: two errors have one name, by which their parameters are known.
    """

    errors: tuple[LinearError, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "errors", tuple(self.errors))  # effects are cached: a list has no hash
        count = Counter(error.name for error in self.errors)
        twice = [name for name in count if count[name] > 1]
        if twice:
            raise InputError(
                f"a bench has {count[twice[0]]} errors with the name {twice[0]!r}, by which parameters are "
                "known; give one of each kind, or another name to one of your own."
            )

    @cached_property
    def slices(self) -> Mapping[str, slice]:
        """The parameters of each error, by its name."""
        ends, places = 0, {}
        for error in self.errors:
            begin, ends = ends, ends + len(error.means)
            places[error.name] = slice(begin, ends)
        return places

    @cached_property
    def means(self) -> Tensor:
        """(M,)."""
        with on_host():
            return torch.cat([torch.zeros(0, dtype=torch.float64), *(e.means for e in self.errors)])

    @cached_property
    def variances(self) -> Tensor:
        """(M,)."""
        with on_host():
            return torch.cat([torch.zeros(0, dtype=torch.float64), *(e.variances for e in self.errors)])

    @cached_property
    def jumps(self) -> list[Jump]:
        """All sudden changes that are possible, their variances (M,) over all parameters."""
        jumps, total = [], len(self.means)
        for error in self.errors:
            place = self.slices[error.name]
            for jump in (each for each in error.jumps if each.probability > 0.0):
                variances = torch.zeros(total, dtype=torch.float64, device=HOST)
                variances[place] = jump.variances
                jumps.append(jump._replace(variances=variances))
        return jumps

    @cached_property
    def changes(self) -> list[Change]:
        """All that may happen at an episode, where jumps are independent; nothing comes first."""
        changes = [Change((), 1.0, torch.zeros(len(self.means), dtype=torch.float64, device=HOST))]
        for number, jump in enumerate(self.jumps):
            none = [c._replace(probability=c.probability * (1.0 - jump.probability)) for c in changes]
            changes = none + [
                Change((*c.jumps, number), c.probability * jump.probability, c.variances + jump.variances)
                for c in changes
            ]
        return changes

    @cached_property
    def delays(self) -> Mapping[int, float]:
        """Probabilities of the intervals of the wrench's delay: of none, 0, where no error is one."""
        several = [error.delays for error in self.errors if error.delays]
        return several[0] if several else {0: 1.0}

    def effect(self, rows: Tensor) -> Effect:
        """Of all parameters, at rows (T, COLUMNS)."""
        none = Effect(rows.new_zeros(len(rows), 6, 0), rows.new_zeros(len(rows), 0))
        each = [none, *(error.effect(rows) for error in self.errors)]
        return Effect(torch.cat([e.twist for e in each], dim=2), torch.cat([e.offset for e in each], dim=1))

    def effect_again(self, rows: Tensor) -> Effect:
        """The same, remembered: for rows that many parts are compared at."""
        with on_host():
            return _effect(self, rows.numpy().tobytes())

    def late_effects(self, rows: Tensor) -> tuple[Tensor, Effect]:
        """Twists (D, R, 6) of the peg by each delay at rows (R, COLUMNS), and effects (D, R, ...) there."""
        with on_host():
            return _late_effects(self, rows.numpy().tobytes())


# The same rows are evaluated at many poses of the part.
@lru_cache(maxsize=64)
def _effect(bench: LinearErrors, rows: bytes) -> Effect:
    return bench.effect(torch.frombuffer(bytearray(rows), dtype=torch.float64).view(-1, COLUMNS))


@lru_cache(maxsize=64)
def _late_effects(bench: LinearErrors, rows: bytes) -> tuple[Tensor, Effect]:
    given = torch.frombuffer(bytearray(rows), dtype=torch.float64).view(-1, COLUMNS)
    each = [late(given, delay) for delay in bench.delays]
    effect = bench.effect(torch.cat([moved for moved, _ in each]))
    parts = (part.unflatten(0, (len(each), len(given))) for part in effect)
    return torch.stack([twist for _, twist in each]), Effect(*parts)
