"""Posterior predictive checks: uniform where the model is right, small where it is not."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy.stats import chi2, kstest
from torch import Tensor

from bcppl import poses
from bcppl.distributions.checks import THRESHOLD, Check
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.manifold import ContactManifold
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference.criticism.predictive import surprise
from bcppl.inference.population import Population
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.recordings import DepthImage
from bcppl.rendering.ray_casting import RayCaster
from bcppl.traces import Series, generate, simulate
from tests.distributions.touches.test_manifold import ledge, window

SCALE = 0.002


def belief(program: Any, args: tuple[Any, ...], observed: dict[str, Tensor], count: int = 20) -> Population:
    return Population(*generate(program, args, observed, count))


def looked_at(
    bench: BenchParameters | None = None, seed: int = 0, temperature: float = 2.0
) -> tuple[BenchScene, Any]:
    """A scene, and a program by which its first camera that may be hidden sees the part where it is."""
    scene = bench_scene(seed, bench)
    renderer, view = RayCaster(scene.part), 0 if scene.hidden_view is None else scene.hidden_view
    camera = replace(scene.cameras[view], world_from_camera=scene.world_from_cameras[view])

    def program(shift: Tensor) -> None:
        spread = torch.tensor([2e-4] * 3 + [2e-3] * 3, dtype=torch.float64)
        part = pyro.sample("part", NormalPose(torch.from_numpy(scene.truth), spread))
        part = torch.cat([part[:, :3] + shift, part[:, 3:]], dim=1)
        site = RobustDepth(
            renderer,
            camera,
            part,
            SCALE,
            outlier=0.1,
            temperature=temperature,
            bias=float(scene.range_bias[view]),
        )
        pyro.sample("depth", site)

    return scene, program


def of_view(scene: BenchScene) -> Tensor:
    view = 0 if scene.hidden_view is None else scene.hidden_view
    seen = scene.look().measurements[view].observation
    assert isinstance(seen, DepthImage)
    return torch.from_numpy(seen.depth)


@pytest.mark.long
def test_draws_of_the_model_are_seldom_surprising_and_a_wrong_noise_is() -> None:
    """Images drawn at other draws of the belief: p values spread over the whole of 0 to 1."""
    _, program = looked_at(temperature=1.0)
    still = torch.zeros(3, dtype=torch.float64)
    torch.manual_seed(0)
    drawn = simulate(program, (still,), 24)
    found = []
    for image in drawn["depth"]:
        image[torch.rand_like(image) < 0.05] = math.nan
        found.append(surprise(belief(program, (still,), {"depth": image}, 8))["depth"].probability)
    assert kstest(found, "uniform").pvalue > 1e-3
    assert min(found) > THRESHOLD and max(found) > 0.8
    # The same draws with every pixel twice as far from what is rendered, about, are not of this model.
    again = simulate(program, (still,), 1)["depth"][0]
    noisy = again + SCALE * torch.distributions.Laplace(0.0, 1.0).sample(again.shape)
    assert surprise(belief(program, (still,), {"depth": noisy}))["depth"].surprising


def test_an_occluder_surprises_the_true_pose_and_no_clean_view_does() -> None:
    still = torch.zeros(3, dtype=torch.float64)
    for seed in range(3):
        for hidden in (False, True):
            scene, program = looked_at(BenchParameters(occluder=hidden), seed)
            check = surprise(belief(program, (still,), {"depth": of_view(scene)}))["depth"]
            assert check.kind == "image" and check.surprising == hidden, (seed, hidden, check)
    # So does a belief that is off by two centimetres.
    scene, program = looked_at()
    off = torch.tensor([0.02, 0.0, 0.0], dtype=torch.float64)
    assert surprise(belief(program, (off,), {"depth": of_view(scene)}))["depth"].surprising


def test_an_image_that_is_missing_says_nothing() -> None:
    scene, program = looked_at()
    still = torch.zeros(3, dtype=torch.float64)
    empty = torch.full_like(of_view(scene), math.nan)
    with pytest.warns(UserWarning, match="does not inform the pose, as all are missing"):
        assert surprise(belief(program, (still,), {"depth": empty}))["depth"].probability == 1.0


def lines(steps: int) -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros((), dtype=torch.float64), 1.0))
    for k in range(steps):
        pyro.sample(f"y_{k}", dist.Normal(x, 0.5))


def exact(observed: list[float], count: int) -> Population:
    """Draws of the posterior of `lines`."""
    precision = 1.0 + len(observed) / 0.25
    mean, deviation = sum(observed) / 0.25 / precision, precision**-0.5
    seen = {f"y_{k}": torch.tensor(y, dtype=torch.float64) for k, y in enumerate(observed)}
    trace = generate(lines, (len(observed),), seen, count)[0]
    drawn = mean + deviation * torch.randn(count, dtype=torch.float64)
    return Population(trace.at({"x": drawn}))


def test_normal_values_at_draws_of_the_posterior_have_uniform_p_values() -> None:
    torch.manual_seed(1)
    latent, seen = [], []
    for _ in range(300):
        x = torch.randn(())
        observed = (x + 0.5 * torch.randn(3)).tolist()
        found = surprise(exact(observed, 1), particles=1)
        assert list(found) == ["x", "y_0", "y_1", "y_2"]
        latent.append(found["x"].probability)
        seen.append(found["y_1"].probability)
    assert kstest(latent, "uniform").pvalue > 1e-3 and kstest(seen, "uniform").pvalue > 1e-3


def test_a_conflict_is_found_where_it_is() -> None:
    found = surprise(exact([0.1, -0.2, 0.0, 3.0, 0.1, -0.1], 200))
    assert [a for a, each in found.items() if each.surprising] == ["y_3"]
    found = surprise(exact([8.1, 8.0, 8.2], 200))
    assert [a for a, each in found.items() if each.surprising] == ["x"]


def turned(spread: Tensor) -> None:
    center = pyro.sample("part", NormalPose(poses.identity(), torch.full((6,), 1e-9).double()))
    pyro.sample("seen", NormalPose(center, spread))


def test_poses_are_whitened_by_their_covariance() -> None:
    torch.manual_seed(2)
    root = torch.randn(6, 6, dtype=torch.float64) * torch.tensor([1e-3] * 3 + [1e-2] * 3).double()[:, None]
    covariance = root @ root.T
    error = torch.tensor([2e-3, -1e-3, 5e-4, 0.01, -0.02, 0.005], dtype=torch.float64)
    observed = poses.retract(poses.identity(), error)
    found = surprise(belief(turned, (covariance,), {"seen": observed}))["seen"]
    squared = float(error @ torch.linalg.solve(covariance, error))
    assert found.probability == pytest.approx(float(chi2.sf(squared, 6)), rel=1e-3)


def pressed(value: Tensor) -> None:
    part = pyro.sample("part", NormalPose(poses.identity(), torch.full((6,), 1e-9).double()))
    pyro.sample("touch", ContactManifold(ledge, part, len(value), 8e-5, 3e-5, 2e-5))


def of_touch(heights: list[float], felt: list[float]) -> Check | None:
    value = window(heights, felt)
    return surprise(belief(pressed, (value,), {"touch": value})).get("touch")


def test_contacts_are_compared_with_chi_square_and_deep_stamps_are_counted() -> None:
    rows = torch.tensor([[5e-5, -8e-5, 1e-5], [-3e-4, -3e-4, -3e-4]], dtype=torch.float64)
    for heights in rows:
        error = heights + 2e-5
        covariance = 8e-5**2 * torch.eye(3).double() + 3e-5**2
        expected = 2.0 * float(chi2.sf(float(error @ torch.linalg.solve(covariance, error)), 3))
        found = of_touch(heights.tolist(), [1, 1, 1])
        assert found is not None and found.probability == pytest.approx(min(1.0, expected), rel=1e-3)
    # One stamp of four may be an outlier, two are not; and what was not observed says nothing.
    one, two = (of_touch([1e-3] * (4 - n) + [-1e-3] * n, [0, 0, 0, 0]) for n in (1, 2))
    assert one is not None and two is not None and not one.surprising and two.surprising
    assert of_touch([1e-3, -1e-3], [math.nan, math.nan]) is None


def test_the_same_seed_gives_the_same_and_nothing_else_is_drawn_from() -> None:
    scene, program = looked_at()
    population = belief(program, (torch.zeros(3).double(),), {"depth": of_view(scene)})
    torch.manual_seed(5)
    first, after = surprise(population, seed=3), torch.rand(3)
    torch.manual_seed(5)
    assert torch.equal(torch.rand(3), after)
    assert surprise(population, seed=3) == first and surprise(population, seed=4) != first
    assert list(surprise(population, ["depth", "nowhere"])) == ["depth"]
    assert surprise(population, []) == {}


def test_a_series_is_left_out_and_no_particles_are_refused() -> None:
    def start() -> Tensor:
        return pyro.sample("x", dist.Normal(torch.zeros(()), 1.0))

    series = Series(start, lambda state: pyro.sample("x", dist.Normal(state, 1.0)))
    assert surprise(Population(*generate(series, (), {}, 5))) == {}
    with pytest.raises(InputError, match="over 0 particles"):
        surprise(exact([0.0], 4), particles=0)


def test_a_mutant_that_draws_over_missing_pixels_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the mask replicas have more pixels than the image: every image with gaps would surprise."""
    for hidden in (True, False):
        scene, program = looked_at(BenchParameters(occluder=hidden))
        image = of_view(scene)
        image[torch.rand_like(image) < 0.6] = math.nan
        population = belief(program, (torch.zeros(3).double(),), {"depth": image})
        assert surprise(population)["depth"].surprising == hidden
    monkeypatch.setattr(DepthDistribution, "_replicated", lambda site, image, many: many.sample())
    assert surprise(population)["depth"].surprising


def test_pixels_off_the_part_do_not_surprise_and_a_power_widens_the_spread() -> None:
    """A background that is off by 20 mm says nothing of the part; a power of 1 / 4 halves the excess."""
    scene, still = bench_scene(0), torch.zeros(3, dtype=torch.float64)
    renderer, camera = RayCaster(scene.part), scene.cameras[0]
    truth = torch.from_numpy(scene.truth)
    rendered = torch.from_numpy(renderer.images(camera, truth[None])[0])
    torch.manual_seed(3)
    behind = torch.where(torch.isinf(rendered), 1.0, rendered)
    seen = behind + SCALE * torch.distributions.Laplace(0.0, 1.0).sample(behind.shape)
    off = torch.where(torch.isinf(rendered), 1.02, seen)
    background = torch.ones_like(seen)

    def placed(shift: Tensor, power: float) -> None:
        spread = torch.tensor([1e-5] * 3 + [1e-4] * 3, dtype=torch.float64)
        part = pyro.sample("part", NormalPose(truth, spread))
        part = torch.cat([part[:, :3] + shift, part[:, 3:]], dim=1)
        site = RobustDepth(renderer, camera, part, SCALE, background, temperature=power)
        pyro.sample("depth", site)

    assert not surprise(belief(placed, (still, 1.0), {"depth": off}))["depth"].surprising
    moved = still.index_fill(0, torch.tensor([0]), 0.02)
    whole, quarter = (
        surprise(belief(placed, (moved, power), {"depth": seen}))["depth"].excess for power in (1.0, 4.0)
    )
    assert whole > 10.0 and quarter == pytest.approx(0.5 * whole, rel=0.05)


@pytest.mark.parametrize("plate", [3, 4])
def test_a_plate_is_checked_as_the_same_numbers_of_one_event(plate: int) -> None:
    """Also where it has as many entries as particles are checked."""
    seen = torch.linspace(-1.0, 1.0, plate, dtype=torch.float64)

    def program(event: bool) -> None:
        middle = pyro.sample("m", dist.Normal(torch.zeros((), dtype=torch.float64), 10.0))
        if event:
            pyro.sample("y", dist.Normal(middle[:, None].expand(-1, plate), 2.0).to_event(1))
            return
        with pyro.plate("several", plate, dim=-2):
            pyro.sample("y", dist.Normal(middle, 2.0))

    torch.manual_seed(0)
    chances = []
    for event in (True, False):
        trace, _ = generate(program, (event,), {"y": seen}, 50, {"m": torch.linspace(-1, 1, 50).double()})
        chances.append(surprise(Population(trace))["y"].probability)
    assert chances[0] == pytest.approx(chances[1]) and 0.01 < chances[0] < 1.0
