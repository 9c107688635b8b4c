"""A part with fewer triangles is the same solid to within micrometres."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.parts import Part
from bcppl.geometry.simplified import SEEN, TOUCHED, simplified


def comb(teeth: int = 12) -> Part:
    """A plate with round pins, by a boolean union of needless triangles, every face divided."""
    solids = [trimesh.creation.box((0.06, 0.02, 0.01))]
    for x in np.linspace(-0.025, 0.025, teeth):
        pin = trimesh.creation.cylinder(0.0015, 0.01, sections=24)
        solids.append(pin.apply_translation((x, 0.0, 0.007)))
    mesh = trimesh.boolean.union(solids).subdivide_to_size(0.004)
    return Part("comb", np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.mark.parametrize("tolerance", [TOUCHED, SEEN])
def test_the_surface_hardly_moves_either_way_and_triangles_go(tolerance: float) -> None:
    part = comb()
    fewer = simplified(part, tolerance)
    assert len(fewer.faces) < 0.5 * len(part.faces)
    fewer.check()
    for one, other in ((part, fewer), (fewer, part)):
        points = torch.from_numpy(np.concatenate([one.surface_points(5000), one.vertices]))
        assert float(SignedDistance(other)(points).distance.abs().max()) < 2.0 * tolerance
    assert fewer.mesh.volume == pytest.approx(part.mesh.volume, rel=1e-3)


def test_a_part_of_which_nothing_can_go_and_an_open_one_stay_the_same_objects() -> None:
    box = trimesh.creation.box((0.06, 0.02, 0.01))
    closed = Part("box", np.asarray(box.vertices), np.asarray(box.faces))
    lidless = Part("open", np.asarray(box.vertices), np.asarray(box.faces)[:-2])
    assert simplified(closed) is closed
    assert simplified(lidless) is lidless


def test_vertices_that_are_doubled_at_seams_are_no_holes() -> None:
    part = comb()
    torn = Part(
        "torn", part.vertices[part.faces].reshape(-1, 3), np.arange(3 * len(part.faces)).reshape(-1, 3)
    )
    assert len(simplified(torn).faces) == len(simplified(part).faces)
