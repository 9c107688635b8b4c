"""Depth with a camera's error, a bias, several parts: against moving things, and integrals."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.distributions.depth import DepthDistribution, LaplaceDepth, RobustDepth
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.parts import Part
from bcppl.rendering.ray_casting import RayCaster
from bcppl.rendering.scene import SceneRenderer, scene_poses

Kind = type[DepthDistribution]

KINDS = [LaplaceDepth, RobustDepth]
SCALE = 0.003
BOX = trimesh.creation.box((0.06, 0.04, 0.03))
PART = Part("box", np.asarray(BOX.vertices), np.asarray(BOX.faces, dtype=np.int64))
RENDERER = RayCaster(PART)
CAMERA = Camera(
    "above", 24, 18, 40.0, 42.0, 10.2, 9.1, looking_at((0.1, -0.12, 0.2), (0, 0, 0)), near=0.05, far=0.6
)
N = 7


def steps(scale: float, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn(N, 6, generator=generator, dtype=torch.float64)


POSE = poses.retract(poses.identity(N), steps(0.01, 0))
ERROR = poses.retract(poses.identity(N), steps(0.01, 1))
BIAS = steps(0.004, 2)[:, 0].contiguous()


def table() -> Array:
    depth = np.full((18, 24), 0.3)
    depth[:, :6], depth[0, 10] = np.nan, 0.0
    depth[:, 12:14] = 0.2
    return depth


def image(background: Array | None = None) -> Tensor:
    torch.manual_seed(5)
    seen = LaplaceDepth(RENDERER, CAMERA, POSE[:1], SCALE, background).sample()[0]
    seen[2, 3:6], seen[9, 10], seen[4, 4] = 0.0, math.nan, 0.7
    return seen


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_error_is_a_camera_that_stands_elsewhere(kind: Kind) -> None:
    seen, shared = image(), poses.retract(poses.identity(1), steps(0.01, 8)[:1])[0]
    together = kind(RENDERER, CAMERA, POSE, SCALE, camera_error=ERROR).log_prob(seen)
    once = kind(RENDERER, CAMERA, POSE, SCALE, camera_error=shared).log_prob(seen)
    stated = torch.from_numpy(CAMERA.world_from_camera)
    for k in range(N):
        for error, found in ((ERROR[k], together), (shared, once)):
            there = replace(CAMERA, world_from_camera=poses.compose(stated, error).numpy())
            alone = kind(RENDERER, there, POSE[k : k + 1], SCALE).log_prob(seen)
            torch.testing.assert_close(found[k], alone[0], rtol=1e-6, atol=1e-3)
    assert (together - kind(RENDERER, CAMERA, POSE, SCALE).log_prob(seen)).abs().min() > 1.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_error_moves_the_whole_scene(kind: Kind) -> None:
    """The table too, where it is a part: the same as a scene seen from elsewhere."""
    flat = trimesh.creation.box((0.5, 0.5, 0.01))
    scene = SceneRenderer([PART, Part("table", np.asarray(flat.vertices), np.asarray(flat.faces, np.int64))])
    under = torch.tensor([0, 0, -0.05, 1, 0, 0, 0], dtype=torch.float64)
    pose, seen = scene_poses(POSE, under), image(table())
    found = kind(scene, CAMERA, pose, SCALE, camera_error=ERROR, bias=BIAS).log_prob(seen)
    stated = torch.from_numpy(CAMERA.world_from_camera)
    for k in range(N):
        there = replace(CAMERA, world_from_camera=poses.compose(stated, ERROR[k]).numpy())
        alone = kind(scene, there, pose[k : k + 1], SCALE, bias=float(BIAS[k])).log_prob(seen)
        torch.testing.assert_close(found[k], alone[0], rtol=1e-6, atol=1e-2)


@pytest.mark.parametrize("kind", [LaplaceDepth, RobustDepth])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("each", [False, True])
def test_a_bias_is_an_image_that_reads_less(kind: Kind, known: bool, each: bool) -> None:
    """Their density depends on the difference alone, so the bias can be taken off the readings instead."""
    behind = table() if known else None
    camera = replace(CAMERA, near=0.0, far=9.0)  # so that the same pixels count
    base = torch.where(image(table()) > 0.0, image(table()), math.nan)
    seen = torch.stack([base + 0.001 * k for k in range(N)]) if each else base
    found = kind(RENDERER, camera, POSE, SCALE, behind, bias=BIAS).log_prob(seen)
    for k in range(N):
        less = (seen[k] if each else seen) - BIAS[k]
        alone = kind(RENDERER, camera, POSE[k : k + 1], SCALE, behind).log_prob(less)
        torch.testing.assert_close(found[k], alone[0], rtol=1e-9, atol=1e-9)
    again = kind(RENDERER, camera, POSE, SCALE, behind, bias=BIAS).log_prob(seen)  # totals that were kept
    assert torch.equal(again, found)


@pytest.mark.parametrize("kind", KINDS)
def test_a_measured_background_holds_the_bias_already(kind: Kind) -> None:
    """So a particle of bias b says what an unmeasured background that is nearer by b says."""
    seen = image(table())
    found = kind(RENDERER, CAMERA, POSE, SCALE, table(), bias=BIAS, background_is_measured=True)
    for k in range(N):
        true = np.where(table() > 0.0, table() - float(BIAS[k]), table())
        alone = kind(RENDERER, CAMERA, POSE[k : k + 1], SCALE, true, bias=float(BIAS[k]))
        assert float(found.log_prob(seen)[k]) == pytest.approx(float(alone.log_prob(seen)), abs=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_no_error_and_no_bias_change_nothing(kind: Kind) -> None:
    seen = image(table())
    plain = kind(RENDERER, CAMERA, POSE, SCALE, table()).log_prob(seen)
    zero = kind(RENDERER, CAMERA, POSE, SCALE, table(), bias=torch.zeros(N, dtype=torch.float64))
    torch.testing.assert_close(zero.log_prob(seen), plain, rtol=1e-12, atol=1e-9)
    still = kind(RENDERER, CAMERA, POSE, SCALE, camera_error=poses.identity(N)).log_prob(seen)
    torch.testing.assert_close(
        still, kind(RENDERER, CAMERA, POSE, SCALE).log_prob(seen), rtol=1e-6, atol=1e-3
    )


def test_a_temperature_divides() -> None:
    seen = image()
    whole = RobustDepth(RENDERER, CAMERA, POSE, SCALE).log_prob(seen)
    cool = RobustDepth(RENDERER, CAMERA, POSE, SCALE, temperature=4.0).log_prob(seen)
    torch.testing.assert_close(cool, whole / 4.0, rtol=1e-12, atol=0.0)
    with pytest.raises(InputError, match="both effective_pixels and temperature"):
        RobustDepth(RENDERER, CAMERA, POSE, SCALE, effective_pixels=50.0, temperature=2.0)


@pytest.mark.parametrize("written", ["image", "background", "region"])
@pytest.mark.parametrize("as_tensors", [False, True])
def test_what_is_written_to_is_read_again(written: str, as_tensors: bool) -> None:
    """What an image says is kept with it; whoever writes into an array must not get what it said before."""
    arrays = {"image": image().numpy().copy(), "background": table(), "region": np.ones((18, 24), dtype=bool)}
    value = torch.from_numpy(arrays["image"])
    given = {name: torch.from_numpy(a) if as_tensors else a for name, a in arrays.items() if name != "image"}

    def log_prob(value: Tensor, background: Array | Tensor, region: Array | Tensor) -> Tensor:
        return RobustDepth(RENDERER, CAMERA, POSE, SCALE, background, region=region).log_prob(value)

    before = log_prob(value, **given)
    assert torch.equal(log_prob(value, **given), before)
    arrays[written][3:15] = 0.0 if written == "region" else 1.02 * arrays[written][3:15]
    fresh = {name: arrays[name].copy() for name in given}
    after = log_prob(torch.from_numpy(arrays["image"].copy()), **fresh)
    assert torch.equal(log_prob(value, **given), after) and not torch.allclose(after, before, atol=0.1)


def test_an_image_of_which_no_pixel_counts_warns_once() -> None:
    site = RobustDepth(RENDERER, CAMERA, POSE, SCALE)
    millimetres = 1000.0 * image()
    with pytest.warns(UserWarning, match="no pixel .* 'above' .* range of 0.05 to 0.6 m"):
        site.log_prob(millimetres)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        site.log_prob(millimetres)
        site.log_prob(image())
    with pytest.warns(UserWarning, match="region"):
        RobustDepth(RENDERER, CAMERA, POSE, SCALE, region=np.zeros((18, 24), dtype=bool)).log_prob(image())


@pytest.mark.filterwarnings("ignore:no pixel")
def test_an_empty_image_says_nothing() -> None:
    nothing = torch.full((18, 24), math.nan, dtype=torch.float64)
    for kind in KINDS:
        site = kind(RENDERER, CAMERA, POSE, SCALE, table(), bias=BIAS)
        assert torch.equal(site.log_prob(nothing), torch.zeros(N, dtype=torch.float64))


def test_bad_input_is_named() -> None:
    scene = SceneRenderer([PART, PART])
    for renderer, pose, said in [
        (scene, POSE, r"give \(7, 2, 7\)"),
        (RENDERER, scene_poses(POSE, POSE), r"give \(7, 7\)"),
        (scene, scene_poses(POSE, POSE, POSE), r"give \(7, 2, 7\)"),
    ]:
        with pytest.raises(InputError, match=said):
            LaplaceDepth(renderer, CAMERA, pose, SCALE)
    with pytest.raises(InputError, match="part of the scene"):
        LaplaceDepth(RENDERER, CAMERA, POSE, SCALE, table(), camera_error=ERROR)
    with pytest.raises(InputError, match="stated_camera_from_camera"):
        LaplaceDepth(RENDERER, CAMERA, POSE, SCALE, camera_error=ERROR[:3])
    with pytest.raises(InputError, match=r"camera 'above' has a bias of shape \(3,\); give \(\) or \(7,\)"):
        LaplaceDepth(RENDERER, CAMERA, POSE, SCALE, bias=BIAS[:3])
    bias, error = BIAS.clone(), ERROR.clone()
    bias[3], error[4, 2] = math.nan, math.inf
    with pytest.raises(InputError, match=r"1 of 7 particles have a bias that is not finite .*particles 3"):
        LaplaceDepth(RENDERER, CAMERA, POSE, SCALE, bias=bias).log_prob(image())
    with pytest.raises(InputError, match=r"camera error that is not finite .*particles 4"):
        LaplaceDepth(RENDERER, CAMERA, POSE, SCALE, camera_error=error).sample()
