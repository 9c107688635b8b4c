"""The gap by Warp is the processor's, wherever peg and part are near one another."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses
from bcppl.geometry.gap import PegGap
from bcppl.geometry.parts import Part
from bcppl.inference import guided_smc
from bcppl.models import load_recording
from bcppl.models.look_and_touch import model
from bcppl.models.worlds.bench.parts import bench_part

if not find_spec("warp"):  # an optional group
    pytest.skip("Warp is not installed", allow_module_level=True)

from bcppl.geometry.gap.warp_gap import WarpGap

PLACES = {"hexagon 12 mm": (0.069, 0.077), "round 16 mm": (0.069, 0.077), "rectangular tray": (0.0, 0.03)}


def about_a_hole(name: str) -> tuple[Part, Part, Tensor]:
    """A part of the bench, its peg, and poses (300, 7) of the peg in, over and through the part."""
    kind, rng = bench_part(name), np.random.default_rng(5)
    place = np.stack([*rng.uniform(-0.002, 0.002, (2, 300)), rng.uniform(*PLACES[name], 300)], axis=1)
    turn = Rotation.from_rotvec(rng.uniform(-0.02, 0.02, (300, 3))).as_quat()[:, [3, 0, 1, 2]]
    away = torch.from_numpy(np.concatenate([place, turn], axis=1))
    return kind.part, kind.peg(0.0005), poses.compose(torch.from_numpy(kind.part_from_hole), away)


@pytest.mark.long
@pytest.mark.parametrize("name", PLACES)
def test_near_contact_it_is_that_of_the_processor_and_farther_away_to_a_grid(name: str) -> None:
    part, peg, stood = about_a_hole(name)
    torch.manual_seed(0)
    where = poses.retract(poses.identity(3), 1e-4 * torch.randn(3, 6, dtype=torch.float64))
    mine, theirs = WarpGap(part, peg, "cpu")(where, stood), PegGap(part, peg)(where, stood)
    near = theirs.distance.abs() < 0.003
    assert near.sum() > 500 and (theirs.distance < 0.0).any() and (theirs.distance > 0.0).any()
    torch.testing.assert_close(mine.distance[near], theirs.distance[near], rtol=0.0, atol=2e-8)
    torch.testing.assert_close(mine.distance, theirs.distance, rtol=0.0, atol=1e-4)
    # Of several places that are as close either may be the witness.
    gradients = [each.gradient(where)[near] for each in (mine, theirs)]
    assert ((gradients[0] - gradients[1]).abs().amax(dim=1) < 1e-5).double().mean() > 0.99


def test_one_peg_for_each_part_and_none_at_all() -> None:
    part, peg, stood = about_a_hole("hexagon 12 mm")
    gap = WarpGap(part, peg, "cpu")
    where = poses.retract(poses.identity(3), torch.full((3, 6), 1e-4, dtype=torch.float64))
    each = gap(where, stood[:6].reshape(3, 2, 7))
    for k in range(3):
        alone = gap(where[k : k + 1], stood[2 * k : 2 * k + 2])
        assert torch.equal(each.distance[k], alone.distance[0])
    assert gap(where, stood[:0]).distance.shape == (3, 0)


@pytest.mark.long
def test_a_recording_ends_at_the_same_belief() -> None:
    recording = load_recording("peg_probe")
    ends = []
    for gap in (PegGap, WarpGap):
        *_, last = guided_smc.infer(model.with_settings(gap=gap, profile="perfect"), recording)
        ends.append(last.belief)
    mean, spread = ends[0].mean, ends[0].covariance.diagonal().sqrt()
    assert bool((poses.local(mean, ends[1].mean).abs() < spread).all())
