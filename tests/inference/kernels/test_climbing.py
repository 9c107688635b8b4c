"""Modes by climbs: the place that an image shows is found from afar, and jumps leave the posterior alone."""

from __future__ import annotations

import math

import numpy as np
import pyro
import pytest
import torch
import trimesh
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import average_distance
from bcppl.distributions.depth import ClutteredDepth
from bcppl.distributions.poses import NormalPose, UniformPose
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import metropolis_hastings, moved_by
from bcppl.inference.proposals.climbing import Modes, jumps, modes
from bcppl.inference.targets import POSTERIOR
from bcppl.rendering.ray_casting import RayCaster
from bcppl.traces import Trace, generate

BOX = trimesh.creation.box((0.06, 0.04, 0.03))
RENDERER = RayCaster(Part("box", np.asarray(BOX.vertices), np.asarray(BOX.faces, dtype=np.int64)))
LENS = Camera(
    "front", 80, 60, 200.0, 200.0, 39.5, 29.5, np.array([0, 0, -0.4, 1.0, 0, 0, 0]), near=0.2, far=0.8
)


def program(image: Tensor | None = None) -> None:
    """A box up to 30 mm and 0.3 rad off, before a table."""
    middle = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    part = pyro.sample("part", UniformPose(middle, 0.03, 0.3))
    pyro.sample("depth_0", ClutteredDepth(RENDERER, LENS, part, 0.004), obs=image)


def test_climbs_find_what_an_image_shows() -> None:
    torch.manual_seed(0)
    truth = poses.retract(poses.identity(1), torch.tensor([[0.015, -0.01, 0.01, 0.0, 0.1, 0.15]]).double())
    image = np.minimum(RENDERER.images(LENS, truth)[0], 0.43)
    image = torch.from_numpy(image + np.random.default_rng(0).laplace(size=image.shape) * 1e-3)
    start, _ = generate(program, (), {"depth_0": image}, 40)
    found = modes(start, "part")
    best = found.centers[found.log_mass.argmax()]
    corners = torch.as_tensor(np.asarray(BOX.vertices))
    assert float(average_distance(best, corners, truth[0])) < 0.004
    assert float(average_distance(start["part"], corners, truth[0]).median()) > 0.02
    with pytest.raises(InputError, match="depth_0"):
        modes(start, "depth_0")


@pytest.mark.parametrize("seen", [False, True])
def test_jumps_leave_the_prior_as_it_is(seen: bool) -> None:
    """Modes that are none: particles drawn from the prior stay draws of the prior."""

    error = torch.tensor([0.01] * 3 + [0.1] * 3, dtype=torch.float64)

    def prior() -> None:
        part = pyro.sample("part", UniformPose(poses.identity(), 0.03, 0.3))
        if seen:
            pyro.sample("seen", NormalPose(part, error))

    def conditional(trace: Trace) -> None:
        """The part given where it is seen, but for the prior's edges, and a little wider."""
        pyro.sample("part", NormalPose(trace["seen"], 1.2 * error))

    torch.manual_seed(1)
    count = 4000
    population = importance_sampling(prior, (), {}, count)
    away = torch.tensor([[0.02, 0.0, 0.0, 0.0, 0.0, 0.1], [-0.01, 0.01, 0.0, 0.1, 0.0, 0.0]]).double()
    scale = torch.tensor([0.017] * 3 + [0.13] * 3, dtype=torch.float64)
    wrong = Modes(
        poses.retract(poses.identity(2), away),
        torch.diag((0.4 * scale) ** 2).expand(2, -1, -1),
        torch.tensor([0.0, -1.0], dtype=torch.float64),
        scale,
    )
    jump = jumps("part", wrong, ["seen"], conditional) if seen else jumps("part", wrong)
    moved = moved_by(population, metropolis_hastings(jump), POSTERIOR, 10)
    place = moved.population["part"]
    assert 0.02 < moved.acceptance < 0.9
    assert bool((place[:, :3].abs() <= 0.03).all())
    deviation = 0.03 / math.sqrt(3.0 * count)
    assert float(place[:, :3].mean(dim=0).abs().max()) < 5.0 * deviation
    assert float(place[:, :3].std(dim=0).max()) == pytest.approx(0.03 / math.sqrt(3.0), rel=0.05)
    if seen:
        off = poses.local(place, moved.population["seen"]) / error
        assert float(off.mean(dim=0).abs().max()) < 5.0 / math.sqrt(count)
        assert float((off.std(dim=0) - 1.0).abs().max()) < 0.06
