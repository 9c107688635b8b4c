"""Mixtures of normals over poses: one density, and draws that have it."""

from __future__ import annotations

import math

import pytest
import torch

from bcppl import poses
from bcppl.distributions.poses import MixturePose, NormalPose
from bcppl.poses import Freedom

CENTER = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
PLANAR = Freedom("xy", "z")


@pytest.mark.parametrize("freedom", [poses.FREE, PLANAR, Freedom("z", "none")])
def test_mixture_of_poses(freedom: Freedom) -> None:
    torch.manual_seed(0)
    steps = 0.5 * torch.randn(3, freedom.dimension, dtype=torch.float64)
    centers = poses.retract(CENTER, freedom.embed(steps))
    spread = torch.diag_embed(torch.rand(3, freedom.dimension, dtype=torch.float64) + 0.1)
    weights = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    mixture = MixturePose(weights.log() + 7.0, centers, spread, freedom)
    drawn = mixture.sample((20_000,))
    by_hand = sum(
        w * NormalPose(c, s, freedom).log_prob(drawn).exp()
        for w, c, s in zip(weights, centers, spread, strict=True)
    )
    log_prob = mixture.log_prob(drawn)
    torch.testing.assert_close(log_prob.exp(), torch.as_tensor(by_hand))
    mirrored = torch.cat([drawn[:, :3], -drawn[:, 3:]], dim=-1)
    torch.testing.assert_close(mixture.log_prob(mirrored), log_prob)
    # The mean of q / p over draws from p is the mass of q, whatever q.
    one = NormalPose(centers[0], spread[0], freedom)
    ratio = (one.log_prob(drawn) - log_prob).exp()
    assert float((ratio.mean() - 1.0).abs() / (ratio.std() / math.sqrt(len(ratio)))) < 4.5
    held = [k for k in range(6) if k not in freedom.axes]
    if held:
        off = torch.zeros(6, dtype=torch.float64)
        off[held[0]] = 1e-3
        assert bool((mixture.log_prob(poses.retract(drawn[:5], off)) == -torch.inf).all())
