"""A part's mesh encloses a solid: its faces are all wound outwards, but for those of cavities."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from bcppl.errors import InputError
from bcppl.geometry.parts import Part


def box(side: float, at: float = 0.0, inverted: bool = False) -> Any:
    made = trimesh.creation.box((side, side, side))
    made.apply_translation([at, 0.0, 0.0])
    if inverted:
        made.invert()
    return made


def part(*bodies: Any, turned: int = 0) -> Part:
    whole = trimesh.util.concatenate(list(bodies))
    faces = np.array(whole.faces)
    faces[:turned] = faces[:turned, ::-1]
    return Part("boxes", np.asarray(whole.vertices), faces)


def test_solids_are_accepted() -> None:
    for bodies in (
        [box(0.1)],
        [box(0.1), box(0.02, at=0.2)],
        [box(0.1), box(0.02, inverted=True)],
        [box(0.1), box(0.05, inverted=True), box(0.02)],
        [box(0.1), box(0.1, at=0.04)],
    ):
        solid = part(*bodies)
        solid.check()
        assert solid.is_closed


def test_faces_wound_both_ways_are_refused() -> None:
    for turned in (1, 5):
        wrong = part(box(0.1), turned=turned)
        with pytest.raises(InputError, match=r"'boxes' has faces wound both ways \(\d edges between them\)"):
            wrong.check()
        assert not wrong.is_closed


def test_a_body_inside_out_is_refused_unless_it_is_a_cavity() -> None:
    with pytest.raises(InputError, match="has a body of 12 faces that is inside out"):
        part(box(0.1), box(0.02, at=0.2, inverted=True)).check()
    with pytest.raises(InputError, match="has a body of 12 faces that is inside out"):
        part(box(0.1), box(0.05, inverted=True), box(0.02, inverted=True)).check()
    with pytest.raises(InputError, match="'boxes' is inside out"):
        part(box(0.1, inverted=True)).check()
