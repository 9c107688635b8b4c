"""A position that measurements leave as open as the prior is named, with its direction; others are not."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.cli.predictive_checks import open_sentence
from bcppl.distributions.poses import NormalPose, UniformPose
from bcppl.inference.criticism.undetermined import undetermined
from bcppl.inference.population import Population
from bcppl.traces import generate
from tests.made_recordings import assert_one_sentence

COUNT = 75
GUESS = UniformPose(poses.identity(), (0.02, 0.02, 0.001), 0.3)


def believed(x: Tensor, y: Tensor, prior: Any = GUESS, *, observed: bool = True) -> Population:
    """Particles at places (N,) in the plane, metres, and between the prior's limits in height."""

    def program() -> None:
        pose = pyro.sample("part", prior)
        if observed:
            pyro.sample("reading", dist.Normal(pose[..., 0], 1.0))

    pose = poses.identity(COUNT)
    pose[:, 0], pose[:, 1], pose[:, 2] = x, y, 0.001 * torch.cos(3.1 * torch.arange(COUNT))
    known = {"reading": torch.tensor(0.0).double()} if observed else {}
    trace, _ = generate(program, (), known, COUNT, {"part": pose})
    return Population(trace)


ALONG = torch.linspace(-0.018, 0.018, COUNT, dtype=torch.float64)
NOWHERE = torch.zeros(COUNT, dtype=torch.float64)


def test_a_part_that_may_slide_along_a_face_is_named_with_the_direction() -> None:
    where = undetermined(believed(ALONG, -ALONG), "part")
    assert where is not None
    along = torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64) / math.sqrt(2.0)
    assert abs(float(where.direction @ along)) == pytest.approx(1.0, abs=1e-3)
    assert where.deviation == pytest.approx(0.036 * math.sqrt(2.0) / math.sqrt(12.0), rel=0.03)
    assert where.before == pytest.approx(0.02 / math.sqrt(3.0))
    assert_one_sentence(open_sentence(where))
    assert "0.71, " in open_sentence(where) and "15 mm" in open_sentence(where)


def test_two_places_far_apart_are_named_though_each_is_narrow() -> None:
    far = torch.where(torch.arange(COUNT) < 20, 0.018, -0.018).double()
    assert undetermined(believed(NOWHERE, far), "part") is not None


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_a_position_that_is_determined_is_not_named(share: float) -> None:
    """Nor a height that is as open as it was, where the prior was narrow."""
    assert undetermined(believed(share * ALONG, NOWHERE), "part") is None


def test_without_measurements_or_a_uniform_prior_nothing_is_named() -> None:
    assert undetermined(believed(ALONG, ALONG, observed=False), "part") is None
    normal = NormalPose(poses.identity(), torch.full((6,), 0.02, dtype=torch.float64))
    assert undetermined(believed(ALONG, ALONG, normal), "part") is None
