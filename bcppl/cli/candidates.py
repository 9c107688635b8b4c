"""The candidates that `bcppl probe` ranks, from its options."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.cli.arm import arm_with_peg
from bcppl.errors import InputError
from bcppl.geometry.gap import PegGap
from bcppl.geometry.holes import hole_of
from bcppl.geometry.parts import Part
from bcppl.inference.planning.candidate_layout import MIXED, plan_candidates
from bcppl.inference.planning.constraints import Candidates, Constraint, feasible, require_candidates
from bcppl.inference.planning.generators import MOTIONS, candidate_kinds
from bcppl.inference.planning.motion_constraints import (
    above_table,
    approach_within,
    collision_free,
    duration_at_most,
    force_at_most,
    within_reach,
)
from bcppl.recordings import Recording
from bcppl.recordings.action_file import SUFFIXES, load_actions
from bcppl.sensors.candidates import Candidate, name_of, planner_of

COUNT = 8  # of a kind that is named without a number
MOST = 10_000  # of a kind: more fit no memory, and are ranked in hours

# A user's own candidates, or how many of each kind are to be planned.
Asked = Sequence[Candidate] | Mapping[str, int]


def asked_for(words: str | None) -> Asked:
    """The candidates in a file, or numbers by kind, of words such as touch:20,slide."""
    if words is None:
        return dict(MIXED)
    if Path(words).suffix in SUFFIXES or "/" in words:
        own = load_actions(words)
        require_candidates(Candidates(tuple(own)))
        names = [name_of(each) for each in own]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"two candidates are called {twice!r}; give each a name of its own.")
        return own
    counts: dict[str, int] = {}
    for word in filter(None, (each.strip() for each in words.split(","))):
        kind, _, count = word.partition(":")
        if kind not in candidate_kinds() or (count and not count.isdecimal()):
            raise InputError(
                f"--candidates has {word!r}; give kinds ({', '.join(candidate_kinds())}), each with a number "
                "if you like (touch:20,slide:12), or a file that ends in .h5 or .json."
            )
        if len(count) > len(str(MOST)) or int(count or COUNT) > MOST:
            raise InputError(f"--candidates asks for {count[:20]} of {kind}; give {MOST} at most.")
        counts[kind] = counts.get(kind, 0) + int(count or COUNT)
    if not any(counts.values()):
        raise InputError(f"there are no candidates: --candidates is {words!r}; give touch:20 or a file.")
    return counts


def refuse_without_peg(asked: Asked, recording: Recording) -> None:
    """Refuse a recording without a peg where a candidate needs one."""
    if isinstance(asked, Mapping):
        needing = [kind for kind, count in asked.items() if count and kind in MOTIONS]
    else:
        needing = [name_of(each) for each in asked if planner_of(each).needs_peg]
    if needing and recording.peg is None:
        raise InputError(
            f"the recording holds no peg to carry out {needing[0]!r} with; add the peg, or where the model "
            "explains depth images ask for views (--candidates view:8)."
        )


def constraints(
    force: float | None, seconds: float | None = None, above: float | None = None
) -> list[Constraint]:
    """The constraints on candidates by force (N), duration (s) and angle from straight above (degrees)."""
    chosen = [] if seconds is None else [duration_at_most(seconds)]
    if force is not None:
        chosen.append(force_at_most(force))
    if above is not None:
        violation = f"approach at more than {above:g}° from straight above"
        chosen.append(approach_within((0.0, 0.0, -1.0), math.radians(above), violation))
    return chosen


def off_table(table: float | None, peg: Part | None) -> list[Constraint]:
    """The constraint on candidates by the height (m) of a table, where one is given."""
    if table is None:
        return []
    number_within("--table is {}", table)
    return [above_table(peg, table)]


def reach(
    robot: str | None, link: str | None, link_from_peg: str | None, world_from_base: str | None, seed: int
) -> list[Constraint]:
    """The constraint on candidates by the reach of an arm, where one is given."""
    arm = arm_with_peg(robot, link, link_from_peg, world_from_base)
    return [] if arm is None else [within_reach(arm, seed=seed)]


def point_inside(words: str | None) -> tuple[float, float] | None:
    """The point of --inside, m in the part's frame, where it is given."""
    if words is None:
        return None
    x, y = numbers("--inside", words, "two", "x y")
    return float(x), float(y)


def numbers(option: str, words: str, count: str, names: str) -> Array:
    """The numbers of an option, as many as it has names."""
    try:
        given = np.array([float(word) for word in words.replace(",", " ").split()])
    except ValueError:
        given = np.empty(0)
    if len(given) != len(names.split()) or not np.isfinite(given).all():
        raise InputError(f"{option} is {words[:60]!r}; give {count} numbers in metres: {names}.")
    return given


def planned(
    asked: Asked,
    belief: Belief,
    recording: Recording,
    constraints: Sequence[Constraint],
    table: float | None,
    seed: int,
    inside: tuple[float, float] | None = None,
) -> Candidates:
    """The candidates that satisfy the constraints, a table's height (m) among them.

    Searches and attempts are for the hole around a point, m in the part's frame, where one is given.
    """
    constraints = [*off_table(table, recording.peg), *constraints]
    part, peg = recording.part, recording.peg
    hole = None if inside is None or peg is None else hole_of(part, inside, peg)
    if isinstance(asked, Mapping):
        like = [m.action for m in recording.measurements]
        return plan_candidates(
            belief, part, peg, asked, constraints=constraints, hole=hole, like=like, seed=seed
        )
    if peg is not None and any(planner_of(each).needs_peg for each in asked):
        constraints = [collision_free(PegGap(part, peg), belief.mean), *constraints]
    return require_candidates(feasible(asked, constraints))
