"""Depth likelihoods against a loop over pixels, their own samples, and what must not matter."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl.arrays import Array
from bcppl.distributions.depth import LaplaceDepth, RobustDepth
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.ray_casting import RayCaster

SCALE, OUTLIER = 0.003, 0.1
RING = trimesh.creation.annulus(r_min=0.01, r_max=0.03, height=0.03, sections=32)
RENDERER = RayCaster(Part("ring", np.asarray(RING.vertices), np.asarray(RING.faces, dtype=np.int64)))
EYE = np.array([0, 0, -0.15, 1.0, 0, 0, 0])
CAMERA = Camera("front", 24, 18, 40.0, 42.0, 10.2, 9.1, EYE, near=0.05, far=0.6)


def poses_near(count: int, seed: int = 0, spread: float = 0.008) -> Tensor:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 0.3).as_quat()[:, [3, 0, 1, 2]]
    return torch.from_numpy(np.concatenate([rng.normal(size=(count, 3)) * spread, turn], axis=1))


def background(camera: Camera = CAMERA) -> Array:
    """A table at 0.2 m, unknown in the left columns, with a post before the part in two columns."""
    depth = np.full((camera.height, camera.width), 0.2)
    depth[:, : camera.width // 4] = np.nan
    depth[0, -1] = 0.0
    depth[:, camera.width // 2 : camera.width // 2 + 2] = 0.1
    return depth


def observation(seed: int = 1) -> Tensor:
    """A noisy image with all that a sensor leaves out."""
    torch.manual_seed(seed)
    image = LaplaceDepth(RENDERER, CAMERA, poses_near(1, 5), SCALE, background()).sample()[0]
    image[2, 3:6], image[9, 10], image[4, 4], image[10, 12], image[9, 9] = 0.0, math.nan, math.inf, 0.7, 0.04
    image[0, 0] = -0.1
    return image


def distribution(robust: bool, pose: Tensor, **kwargs: object) -> LaplaceDepth | RobustDepth:
    options = {"background": background()} | kwargs
    return (
        RobustDepth(RENDERER, CAMERA, pose, SCALE, outlier=OUTLIER, **options)
        if robust
        else LaplaceDepth(RENDERER, CAMERA, pose, SCALE, **options)
    )


def loop_over_pixels(
    robust: bool, image: Array, rendered: Array, behind: Array, region: Array | None = None
) -> float:
    """The definition, one pixel at a time."""
    total = 0.0
    span = CAMERA.far - CAMERA.near
    for v in range(CAMERA.height):
        for u in range(CAMERA.width):
            o, r, b = float(image[v, u]), float(rendered[v, u]), float(behind[v, u])
            if not (math.isfinite(o) and CAMERA.near <= o <= CAMERA.far) or (
                region is not None and not region[v, u]
            ):
                continue
            if math.isfinite(b) and b > 0:
                r = min(r, b)
            if math.isinf(r):
                total += math.log(1 / span)
                continue
            laplace = math.exp(-abs(o - r) / SCALE) / (2 * SCALE)
            if robust:
                total += math.log((1 - OUTLIER) * laplace + OUTLIER / span)
            else:
                total += -abs(o - r) / SCALE - math.log(2 * SCALE)
    return total


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("known", [False, True])
def test_log_prob_is_the_sum_over_pixels(robust: bool, known: bool) -> None:
    pose, image = poses_near(9), observation()
    region = np.random.default_rng(3).random((CAMERA.height, CAMERA.width)) < 0.8
    rendered = RENDERER.images(CAMERA, pose)
    behind = background() if known else np.full((CAMERA.height, CAMERA.width), np.nan)
    for area in (None, region):
        expected = [loop_over_pixels(robust, image.numpy(), r, behind, area) for r in rendered]
        found = distribution(robust, pose, background=behind if known else None, region=area).log_prob(image)
        assert found.dtype == torch.float64 and found.shape == (9,)
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)
    assert np.ptp(expected) > 10.0  # the poses do differ


@pytest.mark.parametrize("robust", [False, True])
def test_one_image_for_each_particle(robust: bool) -> None:
    """Its valid pixels are its own: each particle's result equals that of its image alone."""
    pose = poses_near(4)
    images = torch.stack([observation(seed) for seed in range(4)])
    images[1, 5:9] = math.nan
    together = distribution(robust, pose, effective_pixels=40.0).log_prob(images)
    alone = [
        distribution(robust, pose, effective_pixels=40.0).log_prob(image)[k] for k, image in enumerate(images)
    ]
    np.testing.assert_allclose(together.numpy(), torch.stack(alone).numpy(), rtol=1e-12)


@pytest.mark.filterwarnings("ignore:no pixel")
@pytest.mark.parametrize("robust", [False, True])
def test_missing_pixels_never_matter(robust: bool) -> None:
    """Whatever a missing pixel holds, the result is the same to the bit; were it counted, it would not be."""
    pose, image = poses_near(6), observation()
    missing = ~(torch.isfinite(image) & (image >= CAMERA.near) & (image <= CAMERA.far))
    reference = distribution(robust, pose).log_prob(image)
    for value in (0.0, math.nan, math.inf, -math.inf, -1.0, 0.049, 0.601, 1e30):
        assert torch.equal(distribution(robust, pose).log_prob(torch.where(missing, value, image)), reference)
    present = distribution(robust, pose).log_prob(torch.where(missing, 0.15, image))
    assert ((present - reference).abs() > 1e-3).all()
    assert torch.equal(distribution(robust, pose).log_prob(torch.zeros_like(image)), torch.zeros(6).double())


@pytest.mark.parametrize("robust", [False, True])
def test_no_particle_chooses_which_pixels_count(robust: bool) -> None:
    """In view, cut by the border, out of view, behind the camera, around it: all have as many terms."""
    pose = torch.cat([poses_near(6), poses_near(6)])
    pose[6:, :3] = torch.tensor(
        [[0.06, 0, 0], [9, 0, 0], [0, 0, -0.3], [0, 0, -0.15], [0, 0, -0.12], [0, 0, 3]]
    )
    pose[6:, 3:] = torch.tensor([1.0, 0, 0, 0])
    assert RENDERER.images(CAMERA, pose)[10].min() < CAMERA.near
    image, large = observation(), 1e12
    valid = torch.isfinite(image) & (image >= CAMERA.near) & (image <= CAMERA.far)
    everywhere = np.full((CAMERA.height, CAMERA.width), 0.2)
    if robust:  # an outlier's probability next to 1 leaves the uniform: -log(far - near) for each term
        site = RobustDepth(RENDERER, CAMERA, pose, SCALE, everywhere, outlier=1 - 1e-14)
        one = -math.log(CAMERA.far - CAMERA.near)
    else:  # so wide that the residuals vanish: -log 2b for each term
        site = LaplaceDepth(RENDERER, CAMERA, pose, large, everywhere)
        one = -math.log(2 * large)
    terms = site.log_prob(image).numpy() / one
    np.testing.assert_allclose(terms, np.full(12, float(valid.sum())), rtol=1e-9)


def test_power_depends_on_the_observation_only() -> None:
    pose, image = poses_near(7), observation()
    region = np.zeros((CAMERA.height, CAMERA.width), dtype=bool)
    region[4:14, 5:20] = True
    valid = (torch.isfinite(image) & (image >= CAMERA.near) & (image <= CAMERA.far)).numpy()
    for area, count in ((None, valid.sum()), (region, (valid & region).sum())):
        whole = distribution(True, pose, region=area).log_prob(image)
        part = distribution(True, pose, region=area, effective_pixels=25.0).log_prob(image)
        np.testing.assert_allclose((part / whole).numpy(), 25.0 / count, rtol=1e-12)
        assert torch.equal(distribution(True, pose, region=area, effective_pixels=1e4).log_prob(image), whole)


@pytest.mark.parametrize("robust", [False, True])
def test_order_of_particles_does_not_matter(robust: bool) -> None:
    pose, image = poses_near(12), observation()
    order = torch.randperm(12)
    whole = distribution(robust, pose).log_prob(image)
    assert torch.equal(distribution(robust, pose[order]).log_prob(image), whole[order])
    assert torch.equal(distribution(robust, pose[3:4]).log_prob(image), whole[3:4])


def test_an_observation_that_was_written_to_is_read_again() -> None:
    site, image = distribution(True, poses_near(3)), observation()
    before = site.log_prob(image)
    assert torch.equal(site.log_prob(image), before)
    image[5:9] = 0.3
    assert torch.equal(site.log_prob(image), distribution(True, poses_near(3)).log_prob(image))
    assert not torch.equal(site.log_prob(image), before)


@pytest.mark.parametrize("changed", ["scale", "effective_pixels", "background", "region", "outlier", "far"])
def test_an_observation_is_read_again_where_the_distribution_differs(changed: str) -> None:
    image, pose, shape = observation(), poses_near(3), (CAMERA.height, CAMERA.width)
    first = {"scale": 0.002, "effective_pixels": 90.0, "background": None, "region": None, "outlier": 0.1}
    region = np.zeros(shape, dtype=bool)
    region[::2] = True
    other = {
        "scale": 0.004,
        "effective_pixels": 30.0,
        "background": np.full(shape, 0.7),
        "region": region,
        "outlier": 0.3,
    }
    camera = replace(CAMERA, far=CAMERA.far + 1.0) if changed == "far" else CAMERA
    settings = {k: other[k] if k == changed else v for k, v in first.items()}
    RobustDepth(RENDERER, CAMERA, pose, **first).log_prob(image)
    again = RobustDepth(RENDERER, camera, pose, **settings).log_prob(image)
    assert torch.equal(again, RobustDepth(RENDERER, camera, pose, **settings).log_prob(image.clone()))
    assert not torch.equal(again, RobustDepth(RENDERER, CAMERA, pose, **first).log_prob(image))


def test_truth_beats_poses_nearby() -> None:
    torch.manual_seed(0)
    pose = poses_near(40, spread=0.01)
    image = distribution(True, pose[:1]).sample()[0]
    assert int(distribution(True, pose).log_prob(image).argmax()) == 0


def test_samples_scatter_as_their_density_says() -> None:
    """Laplace: mean |residual| = b about the nearer of part and background. Unknown: uniform."""
    torch.manual_seed(2)
    pose = poses_near(1).expand(300, 7)
    rendered = np.minimum(
        RENDERER.images(CAMERA, pose[:1])[0], np.where(background() > 0, background(), np.inf)
    )
    unknown = np.isinf(rendered)
    assert 30 < unknown.sum() < 200
    draws = distribution(False, pose).sample().numpy()
    residual = (draws - rendered)[:, ~unknown]
    error = 5 * SCALE / math.sqrt(residual.size)
    assert abs(np.abs(residual).mean() - SCALE) < error and abs(residual.mean()) < 2 * error
    for robust in (False, True):
        empty = distribution(robust, pose).sample().numpy()[:, unknown]
        width = CAMERA.far - CAMERA.near
        assert empty.min() >= CAMERA.near and empty.max() <= CAMERA.far
        assert abs(empty.mean() - 0.5 * (CAMERA.far + CAMERA.near)) < 5 * width / math.sqrt(12 * empty.size)
        assert abs(empty.std() - width / math.sqrt(12)) < 0.01 * width
    far_off = np.abs(distribution(True, pose).sample().numpy() - rendered)[:, ~unknown] > 12 * SCALE
    expected = OUTLIER * (
        1 - 24 * SCALE / (CAMERA.far - CAMERA.near)
    )  # what falls near the surface looks right
    assert abs(far_off.mean() - expected) < 5 * math.sqrt(OUTLIER / far_off.size)


def test_density_integrates_to_one_under_its_own_samples() -> None:
    """E over o ~ p(. | q) of p(o | q') / p(o | q) is 1 for every q': samples and densities agree."""
    torch.manual_seed(3)
    # The range is so wide that one draw in a million goes missing.
    camera = Camera("tiny", 6, 6, 9.0, 9.0, 2.3, 2.6, EYE, near=0.01, far=0.4)
    draws, wide = 20000, 0.01
    behind = np.full((6, 6), 0.17)
    behind[:, :2] = np.nan
    here = poses_near(1, 0, 0.0).expand(draws, 7)
    other = here.clone()
    other[:, 0] += 0.002
    other[:, 2] += 0.001
    site = RobustDepth(RENDERER, camera, here, wide, behind, outlier=0.5)
    images = site.sample()
    assert float(((images >= camera.near) & (images <= camera.far)).double().mean()) > 1 - 1e-5
    moved = RobustDepth(RENDERER, camera, other, wide, behind, outlier=0.5)
    ratio = (moved.log_prob(images) - site.log_prob(images)).exp()
    error = float(ratio.std()) / math.sqrt(draws)
    assert float(ratio.std()) > 0.3 and error < 0.01  # the poses differ, and the average is sharp
    assert abs(float(ratio.mean()) - 1.0) < 4 * error


def test_lazy_under_a_plate() -> None:
    """Tracing renders nothing, and the plate's `expand` returns the same object."""

    def program() -> None:
        with pyro.plate("particles", 5):
            pyro.sample("depth", distribution(True, poses_near(5)), obs=observation_once)

    observation_once = observation()
    before = RENDERER.effort.copy()
    trace = pyro.poutine.trace(program).get_trace()
    assert RENDERER.effort.since(before).calls == 0
    site = trace.nodes["depth"]
    assert site["fn"].log_prob(site["value"]).shape == (5,)
    assert RENDERER.effort.since(before).items == 5


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("far", [math.inf, math.nan, 0.01])
def test_a_range_that_does_not_end_beyond_its_beginning_is_refused(robust: bool, far: float) -> None:
    camera = replace(CAMERA, near=0.05, far=far)
    kind = RobustDepth if robust else LaplaceDepth
    with pytest.raises(InputError, match=r"'front' has a range from 0.05 m to .* above 0.05"):
        kind(RENDERER, camera, poses_near(2), SCALE)


def test_bad_input_is_named() -> None:
    pose = poses_near(4)
    pose[2, 1] = math.nan
    for call in (lambda d: d.log_prob(observation()), lambda d: d.sample()):
        with pytest.raises(InputError, match=r"1 of 4 particles .*particles 2"):
            call(distribution(True, pose))
    good = poses_near(4)
    with pytest.raises(InputError, match="shape"):
        distribution(True, good).log_prob(torch.zeros(CAMERA.width, CAMERA.height))
    for name in ("background", "region"):
        with pytest.raises(InputError, match=rf"'front' has a {name} of shape \(2, 2\); give \(18, 24\)"):
            distribution(True, good, **{name: np.zeros((2, 2))})
