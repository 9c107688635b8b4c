"""Candidates for the next measurement (touches, slides, searches, attempts, views), planned for a belief."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any

import torch

from bcppl.arguments import seed_number, whole_number
from bcppl.beliefs import Belief
from bcppl.errors import InferenceError, InputError
from bcppl.geometry.gap import PegGap
from bcppl.geometry.holes import Hole
from bcppl.geometry.parts import Part
from bcppl.inference.planning.constraints import Candidates, Constraint, feasible, require_candidates
from bcppl.inference.planning.generators import MOTIONS, SHORT, PlanningProblem, candidate_kinds, generate
from bcppl.inference.planning.insertion import InsertionParameters
from bcppl.inference.planning.motion_constraints import (
    collision_free,
    contact_at_mid_stroke,
    not_from_below,
)
from bcppl.inference.planning.touching import TouchParameters
from bcppl.inference.summaries import COLLAPSED, WEIGHTLESS
from bcppl.sensors import sensor_of
from bcppl.sensors.candidates import Candidate, name_of, planner_of

MIXED: Mapping[str, int] = {"touch": 12, "lean": 4, "slide": 12, "pair": 4}
STROKES = ("touch", "lean", "slide", "pair")  # kinds that meet the part half-way
_AT_ONCE = 8  # candidates that are checked together, at least
_DRAWS = 8  # candidates generated for each that is asked for, at most


def plan_candidates(
    belief: Belief,
    part: Part,
    peg: Part | None = None,
    kinds: Mapping[str, int] | None = None,
    *,
    constraints: Sequence[Constraint] = (),
    gap: PegGap | None = None,
    hole: Hole | None = None,
    touch_parameters: TouchParameters | None = None,
    insertion_parameters: InsertionParameters | None = None,
    like: Sequence[Any] = (),
    seed: int = 0,
) -> Candidates:
    """Feasible candidates of several kinds, as many of each as are asked for where so many are feasible.

    With the part at the belief's mean, plans must not come from below or lead through the part, and their
    strokes must meet it half-way. Infeasible candidates are replaced by others.

    Args:
        belief: over world_from_part.
        part: its z axis points out of its top.
        peg: the held peg, its frame where it is held and its tip at its lowest z; None for views alone.
        kinds: how many of "touch", "lean" (a touch with the peg turned), "slide", "pair" (two touches),
            "search", "attempt" and "view"; None: 12 touches, 4 that lean, 12 slides and 4 pairs.
        constraints: further ones (`bcppl.inference.planning.motion_constraints`).
        gap: of part and peg; computed unless given.
        hole: for searches and attempts; the part's only one unless given.
        touch_parameters: of touches and slides.
        insertion_parameters: of searches and attempts.
        like: actions that candidates of their kinds resemble, such as the recording's views.
        seed: same seed, same candidates.

    Raises:
        InputError: a kind is unknown or its number is none; a mesh is broken or in millimetres; the
            belief has no weight or has collapsed to a point; no candidate is feasible; a search is asked for
            and the part has no hole.
    """
    require_uncertain(belief)
    asked = MIXED if kinds is None else kinds
    if not isinstance(asked, Mapping):
        raise InputError(f"kinds of candidates are {asked!r}; give a number of each: {{'touch': 8}}.")
    if isinstance(constraints, Constraint) or not isinstance(constraints, Sequence):
        raise InputError("constraints are given that are no list; give a list of them: [force_at_most(5.0)].")
    known = candidate_kinds()
    if peg is not None:
        peg.check(closed=False)
    for kind, count in asked.items():
        if kind not in known:
            raise InputError(f"there are no candidates of kind {kind!r}; kinds are {', '.join(known)}.")
        whole_number(f"{{}} candidates of kind {kind!r} were asked for", count, least=0)
    if peg is not None and gap is None and any(asked.get(kind) for kind in MOTIONS):
        gap = PegGap(part, peg)
    problem = PlanningProblem(
        belief,
        part,
        peg,
        gap,
        hole,
        TouchParameters() if touch_parameters is None else touch_parameters,
        SHORT if insertion_parameters is None else insertion_parameters,
        {sensor_of(each).kind: each for each in reversed(like)},
        seed_number(seed),
    )
    of_kinds = [_of_kind(kind, count, problem, constraints) for kind, count in asked.items()]
    candidates = tuple(candidate for each in of_kinds for candidate in each)
    excluded = sum((each.excluded for each in of_kinds), Counter[str]())
    return require_candidates(Candidates(candidates, excluded))


def require_uncertain(belief: Belief) -> None:
    """Raise InputError where a belief has no weight, or no uncertainty that a measurement could reduce."""
    try:
        distinct = belief.distinct
    except InferenceError as error:
        if not bool((belief.log_weights < torch.inf).all()):
            raise InputError(
                "the belief has a weight that is no number (NaN or +inf); give log weights, -inf for a "
                "particle without weight."
            ) from error
        raise InputError(WEIGHTLESS) from error
    if distinct < 2:
        raise InputError(f"the belief {COLLAPSED}")


def _of_kind(
    kind: str, count: int, problem: PlanningProblem, constraints: Sequence[Constraint]
) -> Candidates:
    """The first `count` feasible candidates of a kind, numbered."""
    if not count:
        return Candidates(())
    every = [*_usual(kind, problem), *constraints]
    generated = generate(kind, problem, _DRAWS * count)
    kept, excluded = list[Candidate](), Counter[str]()
    while len(kept) < count:
        batch = list(islice(generated, max(2 * (count - len(kept)), _AT_ONCE)))
        if not batch:
            break
        checked = feasible(batch, every)
        kept += checked
        excluded += checked.excluded
    return Candidates(tuple(_numbered(c, k + 1) for k, c in enumerate(kept[:count])), excluded)


def _usual(kind: str, problem: PlanningProblem) -> list[Constraint]:
    """The constraints on every candidate of a kind."""
    if kind not in MOTIONS:
        return []
    mean, gap = problem.belief.mean, problem.peg_gap
    usual = [not_from_below(), collision_free(gap, mean)]
    return [*usual, contact_at_mid_stroke(gap, mean)] if kind in STROKES else usual


def _numbered(candidate: Candidate, number: int) -> Candidate:
    """The same with `#` in its name replaced."""
    name = name_of(candidate).replace("#", str(number))
    return planner_of(candidate).renamed(candidate, name)
