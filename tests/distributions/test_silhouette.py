"""A silhouette's likelihood: a density of masks, whose best pose is the true one; beside a depth image."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.silhouette import Silhouette, binned_mask
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.extrusion import block, block_with_square_hole
from bcppl.rendering.ray_casting import RayCaster

PART = block_with_square_hole((0.1, 0.08, 0.03), 0.02, (0.01, 0.005))
RENDERER = RayCaster(PART)
CAMERA = Camera("c", 64, 48, 80.0, 80.0, 31.5, 23.5, looking_at([0.2, -0.25, 0.3], [0.0, 0.0, 0.0]))
TRUTH = poses.retract(poses.identity(), torch.tensor([0.004, -0.003, 0.002, 0.05, 0.1, -0.2]).double())


def moved(step: float, turn: float) -> Tensor:
    """The truth, then poses off it along and about each axis, both ways."""
    steps = torch.diag(torch.tensor([step] * 3 + [turn] * 3)).double()
    return poses.retract(TRUTH, torch.cat([torch.zeros(1, 6).double(), steps, -steps]))


def shown() -> Tensor:
    return torch.from_numpy(np.isfinite(RENDERER.images(CAMERA, TRUTH[None])[0])).double()


def test_all_masks_together_have_probability_one() -> None:
    torch.manual_seed(0)
    small = Camera("s", 4, 3, 8.0, 8.0, 1.5, 1.0, looking_at([0.0, -0.02, 0.4], [0.05, 0.0, 0.0]))
    pose = poses.retract(poses.identity(), torch.randn(3, 6).double() * 0.03)
    masks = torch.tensor(list(itertools.product([0.0, 1.0], repeat=12))).double().reshape(-1, 3, 4)
    rim = torch.tensor([0.4, -0.8, 0.0]).double()
    likelihood = Silhouette(RENDERER, small, pose, 0.7, 0.1, rim=rim)
    assert 0.1 < float(likelihood.probabilities().min()) + 0.05 < float(likelihood.probabilities().max())
    count = len(masks)
    every = Silhouette(
        RENDERER, small, pose.repeat_interleave(count, 0), 0.7, 0.1, rim=rim.repeat_interleave(count)
    )
    total = every.log_prob(masks.repeat(3, 1, 1)).reshape(3, count).logsumexp(dim=1)
    assert torch.allclose(total, torch.zeros(3).double(), atol=1e-5)
    torch.testing.assert_close(every.log_prob(masks[7])[::count], likelihood.log_prob(masks[7]))


def test_draws_are_those_of_the_density() -> None:
    likelihood = Silhouette(RENDERER, CAMERA, TRUTH.expand(400, 7), 1.0, 0.05)
    torch.manual_seed(0)
    masks = likelihood.sample()
    chance = torch.from_numpy(likelihood.probabilities()[0]).double()
    off = (masks.mean(dim=0) - chance) / (chance * (1.0 - chance) / 400).sqrt()
    assert 0.93 < float(off.square().mean()) < 1.07
    entropy = -(chance * chance.log() + (1.0 - chance) * (1.0 - chance).log()).sum()
    assert float(likelihood.log_prob(masks).mean()) == pytest.approx(-float(entropy), rel=0.02)


@pytest.mark.parametrize("width", [0.5, 2.0])
def test_the_truth_is_likelier_than_what_is_off_it(width: float) -> None:
    log_p = Silhouette(RENDERER, CAMERA, moved(0.01, 0.08), width).log_prob(shown())
    assert int(log_p.argmax()) == 0 and float(log_p[0] - log_p[1:].max()) > 1.0


def test_a_hole_in_the_mask_hardly_moves_the_best_pose() -> None:
    mask = shown()
    sides = [torch.where(mask.sum(dim=1 - k) > 0)[0] for k in (0, 1)]
    row, column = (int(side.double().mean()) for side in sides)
    mask[row - 2 : row + 3, column - 10 : column - 1] = 0.0
    assert float((mask != shown()).sum()) > 35
    log_p = Silhouette(RENDERER, CAMERA, moved(0.006, 0.08), 1.0).log_prob(mask)
    assert int(log_p.argmax()) == 0
    unknown = torch.where(mask == shown(), mask, torch.nan)
    masked = Silhouette(RENDERER, CAMERA, moved(0.006, 0.08), 1.0).log_prob(unknown)
    assert int(masked.argmax()) == 0 and float(masked[0]) > float(log_p[0]) + 35.0


def test_a_rim_moves_a_straight_outline_by_so_many_pixels() -> None:
    """A wide block's edge: with a rim of two pixels the chance of a half is two pixels farther out."""
    camera = Camera(
        "e", 60, 20, 100.0, 100.0, 29.5, 9.5, looking_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0, 1, 0])
    )
    renderer = RayCaster(block((0.2, 5.0, 0.01)))
    rims = torch.tensor([0.0, 2.0, -2.0]).double()
    chances = Silhouette(renderer, camera, poses.identity(3), 1.5, rim=rims).probabilities()[:, 10]
    right = [float(np.interp(-0.5, -row[30:], np.arange(30.0))) for row in chances]
    assert np.allclose(np.diff(right), [2.0, -4.0], atol=0.1)


def test_a_mask_and_a_depth_image_are_rendered_once() -> None:
    renderer = RayCaster(PART)
    pose, mask = moved(0.004, 0.03), shown()
    image = torch.from_numpy(renderer.images(CAMERA, TRUTH[None])[0])
    image[~torch.isfinite(image)] = 1.0
    inside = binned_mask(mask.numpy(), 1) > 0.5
    depth = RobustDepth(renderer, CAMERA, pose, 0.003, region=inside)
    alone = RobustDepth(renderer, CAMERA, pose, 0.003, region=inside).log_prob(image)
    rim = torch.full((len(pose),), 0.3).double()
    before = renderer.effort.items
    beside = Silhouette.from_depth(depth, 1.0, 0.02, rim=rim, temperature=4.0)
    both = depth.log_prob(image), beside.log_prob(mask)
    assert renderer.effort.items - before == len(pose)
    assert torch.allclose(both[0], alone)
    whole = Silhouette(renderer, CAMERA, pose, 1.0, 0.02, rim=rim).log_prob(mask)
    assert torch.allclose(4.0 * both[1], whole)


@pytest.mark.parametrize("images", [0, 1, 2])
def test_a_mask_has_pixels_outside_the_region_of_a_depth_image_that_was_compared_before(images: int) -> None:
    image = torch.from_numpy(RENDERER.images(CAMERA, TRUTH[None])[0])
    image[~torch.isfinite(image)] = 1.0
    left = np.zeros(image.shape, dtype=bool)
    left[:, : CAMERA.width // 2] = True
    depth = RobustDepth(RENDERER, CAMERA, moved(0.004, 0.03), 0.003, region=left)
    compared = [depth.log_prob(image) for _ in range(images)]
    beside = Silhouette.from_depth(depth, 1.0, 0.02)
    whole = Silhouette(RENDERER, CAMERA, moved(0.004, 0.03), 1.0, 0.02)
    torch.testing.assert_close(beside.log_prob(shown()), whole.log_prob(shown()))
    for each in compared:
        torch.testing.assert_close(depth.log_prob(image), each)


def test_a_mask_is_binned_by_most_of_its_pixels() -> None:
    mask = np.zeros((5, 6))
    mask[:2, :3], mask[2, 4:] = 255, 1
    assert np.array_equal(binned_mask(mask, 2), [[1, 0, 0], [0, 0, 0]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.log_prob(shown().T), r"shape \(64, 48\); give \(48, 64\) or \(13, 48, 64\)"),
        (lambda s: s.log_prob(255.0 * shown()), "other values than 0 and 1; give 1 where"),
        (lambda s: Silhouette(RENDERER, CAMERA, s.pose, 1.0, rim=torch.zeros(4)), r"a rim of shape \(4,\)"),
        (lambda s: Silhouette(RENDERER, CAMERA, s.pose * torch.nan, 1.0).sample(), "have a pose that"),
        (lambda s: binned_mask(np.zeros((4, 4, 3)), 2), "cannot be binned by 2; give one"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(call: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call(Silhouette(RENDERER, CAMERA, moved(0.01, 0.1), 1.0))  # type: ignore[operator]
