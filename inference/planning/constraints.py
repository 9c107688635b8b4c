"""Constraints on candidates: which may be executed, and why the others may not.

A constraint is evaluated for all candidates at once. `feasible` applies several, one after another, and
counts the candidates that each excludes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from bcppl.arguments import named
from bcppl.errors import InputError
from bcppl.sensors.candidates import Candidate


class Constraint(NamedTuple):
    """A constraint on candidates: C booleans for C candidates.

    The violation is a phrase for the candidates that violate it: "are out of the arm's reach".
    """

    violation: str
    satisfied: Callable[[Sequence[Candidate]], Sequence[bool]]


@dataclass(frozen=True, eq=False)
class Candidates(Sequence[Candidate]):
    """Feasible candidates, and how many others violate each constraint, by its violation."""

    feasible: tuple[Candidate, ...]
    excluded: Counter[str] = field(default_factory=Counter)

    def __len__(self) -> int:
        return len(self.feasible)

    def __getitem__(self, index: Any) -> Any:
        return self.feasible[index]

    def __str__(self) -> str:
        excluded = f"; excluded those that {self.violations}" if self.violations else ""
        return f"{len(self)} candidate{'s' * (len(self) != 1)}{excluded}"

    @property
    def violations(self) -> str:
        """The exclusions in words: "come from below (9), lead through the part (1)"; empty without any."""
        return ", ".join(f"{violation} ({count})" for violation, count in self.excluded.items() if count)


def per_candidate(violation: str, satisfies: Callable[[Candidate], bool]) -> Constraint:
    """The constraint that every candidate satisfies a predicate."""
    return Constraint(violation, lambda candidates: [satisfies(one) for one in candidates])


def feasible(candidates: Iterable[Candidate], constraints: Sequence[Constraint]) -> Candidates:
    """The candidates that satisfy all constraints.

    Raises:
        InputError: a constraint is none, or does not give a boolean for each candidate.
    """
    remaining, excluded = list(candidates), Counter[str]()
    for constraint in constraints:
        if not isinstance(constraint, Constraint):
            raise InputError(
                f"{named('{} is given in place of a constraint on candidates', constraint)}; of a function "
                'of one candidate make one by per_candidate("are too long", function).'
            )
        flags = np.asarray(constraint.satisfied(remaining) if remaining else np.ones(0, dtype=bool))
        if flags.dtype != bool or flags.shape != (len(remaining),):
            raise InputError(
                f"the constraint on candidates that {constraint.violation} gives no boolean for each; let "
                f"it give {len(remaining)} booleans for {len(remaining)} candidates."
            )
        kept = [one for one, flag in zip(remaining, flags, strict=True) if flag]
        excluded[constraint.violation] += len(remaining) - len(kept)
        remaining = kept
    return Candidates(tuple(remaining), excluded)


def require_candidates(candidates: Candidates) -> Candidates:
    """The candidates; InputError where there is none."""
    if len(candidates):
        return candidates
    if not candidates.violations:
        raise InputError("there are no candidates to choose from; give one plan or view, or a kind of them.")
    total = candidates.excluded.total()
    raise InputError(
        f"none of {total} candidate{'s' * (total != 1)} is feasible: they {candidates.violations}; "
        "give other candidates, or weaker constraints."
    )
