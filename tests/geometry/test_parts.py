"""A part's mesh encloses a solid: its faces are all wound outwards, but for those of cavities."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from bcppl.errors import InputError
from bcppl.geometry.parts import Guess, Part


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


def test_numbers_in_lists_are_a_guess_and_what_is_no_number_stays_for_the_check() -> None:
    guess = Guess([0, 0, 0.1, 1, 0, 0, 0], (0.01, 0.01, 0), tilt=0.1)
    assert guess.world_from_part.dtype == guess.translation.dtype == np.float64
    assert guess.farthest(np.zeros(3)) == pytest.approx(0.01 * 2.0**0.5)
    assert Guess(["here"], [0, 0, 0]).world_from_part == ["here"]


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


@pytest.mark.parametrize(
    "bounds", [{"tilt": 0.4, "yaw": 2.0}, {"yaw": 3.0}, {"tilt": 0.2}, {"angle": 1.0}, {"angle": 3.2}]
)
def test_no_point_of_a_part_is_farther_from_the_guess_than_its_bounds_lead(bounds: dict[str, float]) -> None:
    draws = np.random.default_rng(1)
    guess = Guess(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.array([0.01, 0.02, 0.0]), **bounds)
    point, away = np.array([0.06, -0.02, 0.05]), []
    for _ in range(3000):
        heading = draws.uniform(0.0, 2.0 * np.pi)
        if guess.angle is None:
            lean = draws.uniform(0.0, guess.tilt) * np.array([np.cos(heading), np.sin(heading), 0.0])
            turned = Rotation.from_rotvec([0.0, 0.0, draws.uniform(-guess.yaw, guess.yaw)]).apply(point)
            turned = Rotation.from_rotvec(lean).apply(turned)
        else:
            axis = draws.normal(size=3)
            axis *= draws.uniform(0.0, min(guess.angle, np.pi)) / np.linalg.norm(axis)
            turned = Rotation.from_rotvec(axis).apply(point)
        shift = draws.uniform(-1.0, 1.0, 3) * guess.translation
        away.append(np.linalg.norm(turned + shift - point))
    assert 0.6 * guess.farthest(point) < max(away) <= guess.farthest(point)
