"""What may be done next: touches, slides, searches, attempts and views, laid out around a belief."""

from __future__ import annotations

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
from bcppl.inference.planning.filters import (
    Candidates,
    Filter,
    clear_of_part,
    meeting,
    not_from_below,
    refuse_none,
    sifted,
)
from bcppl.inference.planning.insertion import Attempt
from bcppl.inference.planning.kinds import SHORT, SOURCES, Setup, kinds as known_kinds, source
from bcppl.inference.planning.touching import Touching
from bcppl.sensors import sensor_of
from bcppl.sensors.candidates import Candidate, name_of, planner_of

MIXED: Mapping[str, int] = {"touch": 16, "slide": 12, "pair": 4}
_AT_ONCE = 8  # places that are looked at together, at least
_DRAWS = 8  # times as many places as candidates that are asked for are looked at, at most


def candidates(
    belief: Belief,
    part: Part,
    peg: Part | None = None,
    kinds: Mapping[str, int] | None = None,
    *,
    filters: Sequence[Filter] = (),
    gap: PegGap | None = None,
    hole: Hole | None = None,
    touching: Touching | None = None,
    attempt: Attempt | None = None,
    like: Sequence[Any] = (),
    seed: int = 0,
) -> Candidates:
    """Candidates of several kinds, so many of each as are asked for if so many can be carried out.

    Plans that come from below, that lead through the part or whose stroke would meet it elsewhere than
    half-way, all with the part at the belief's mean, are left out and others take their place.

    Args:
        belief: over world_from_part.
        part: its z axis points out of its top.
        peg: what is held, its frame at the wrench sensor and its tip at its lowest z; None for views alone.
        kinds: how many of "touch", "slide", "pair" (two touches), "search", "attempt" and "view"; None: 16
            touches, 12 slides and 4 pairs.
        filters: further ones (`bcppl.inference.planning.filters`).
        gap: of part and peg, if it is at hand.
        hole: the one that is searched for; None: the part's only one.
        touching: speeds and forces of touches and slides.
        attempt: speeds and forces of searches and attempts.
        like: actions that candidates of their kinds resemble, such as the recording's views.
        seed: same seed, same candidates.

    Raises:
        InputError: a kind is unknown or its number is none; a mesh is broken or in millimetres; the
            belief has no weight or has collapsed to a point; no candidate is left; a search is asked for and
            the part has no hole.
    """
    refuse_settled(belief)
    asked = MIXED if kinds is None else kinds
    if not isinstance(asked, Mapping):
        raise InputError(f"kinds of candidates are given as {asked!r}; say how many of each: {{'touch': 8}}.")
    kinds_known = known_kinds()
    if peg is not None:
        peg.check(closed=False)
    for kind, count in asked.items():
        if kind not in kinds_known:
            raise InputError(f"there are no candidates of kind {kind!r}; kinds are {', '.join(kinds_known)}.")
        whole_number(f"{{}} candidates of kind {kind!r} were asked for", count, least=0)
    if peg is not None and gap is None and any(asked.get(kind) for kind in SOURCES):
        gap = PegGap(part, peg)
    setup = Setup(
        belief,
        part,
        peg,
        gap,
        hole,
        Touching() if touching is None else touching,
        SHORT if attempt is None else attempt,
        {sensor_of(each).kind: each for each in reversed(like)},
        seed_number(seed),
    )
    found: list[Candidate] = []
    removed: dict[str, int] = {}
    for kind, count in asked.items():
        own = _of_kind(kind, count, setup, filters)
        found += own.kept
        for why, gone in own.removed.items():
            removed[why] = removed.get(why, 0) + gone
    whole = Candidates(tuple(found), removed)
    refuse_none(whole)
    return whole


def refuse_settled(belief: Belief) -> None:
    """Refuse a belief under which nothing is left to be told.

    Raises:
        InputError: no particle has weight, or all with weight are at one pose.
    """
    try:
        distinct = belief.distinct
    except InferenceError as error:
        if not bool((belief.log_weights < torch.inf).all()):
            raise InputError(
                "the belief has a weight that is no number (NaN or +inf); give log weights, -inf for a "
                "particle without weight."
            ) from error
        raise InputError(
            "the belief has no weight: every particle's is zero, so it says nothing of where to touch; "
            "widen the prior, use more particles, or check the measurements (`bcppl check`)."
        ) from error
    if distinct < 2:
        raise InputError(
            "the belief has collapsed to a point: all particles with weight are at one pose, so no candidate "
            "can tell more; use more particles, or move them apart first (rejuvenation)."
        )


def _of_kind(kind: str, count: int, setup: Setup, filters: Sequence[Filter]) -> Candidates:
    """The first `count` of a kind that are kept, numbered."""
    if not count:
        return Candidates(())
    every = [*_usual(kind, setup), *filters]
    drawn = source(kind, setup, _DRAWS * count)
    kept: list[Candidate] = []
    removed: dict[str, int] = {}
    while len(kept) < count:
        batch = list(islice(drawn, max(2 * (count - len(kept)), _AT_ONCE)))
        if not batch:
            break
        found = sifted(batch, every)
        kept += found.kept
        for why, gone in found.removed.items():
            removed[why] = removed.get(why, 0) + gone
    return Candidates(tuple(_numbered(c, k + 1) for k, c in enumerate(kept[:count])), removed)


def _usual(kind: str, setup: Setup) -> list[Filter]:
    """The filters that every candidate of a kind passes."""
    if kind not in SOURCES:
        return []
    mean, gap = setup.belief.mean, setup.measured
    found = [not_from_below(), clear_of_part(gap, mean)]
    return [*found, meeting(gap, mean)] if kind in ("touch", "slide", "pair") else found


def _numbered(candidate: Candidate, number: int) -> Candidate:
    """The same with `#` in its name replaced."""
    name = name_of(candidate).replace("#", str(number))
    renamed: Candidate = planner_of(candidate).renamed(candidate, name)
    return renamed
