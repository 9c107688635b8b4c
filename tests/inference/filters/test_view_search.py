"""A view that no particle explains: it starts a search, which leads to the part; others start none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation

from bcppl import poses
from bcppl.inference.filters import guided_smc, view_search
from bcppl.inference.population import Population
from bcppl.models.look_and_touch import model
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.rendering.ray_casting import RayCaster
from bcppl.sensors.measurements import Recording
from bcppl.traces import generate

WIDE = BenchParameters(translation=0.06, tilt=math.radians(40.0), yaw=math.radians(120.0))


def alone(scene: BenchScene) -> Recording:
    """The views of a scene with nothing but the part: all pixels beside it are missing."""
    look = scene.look()
    views = []
    for number, view in enumerate(look.measurements):
        camera = replace(scene.cameras[number], world_from_camera=scene.world_from_cameras[number])
        shown = np.isfinite(RayCaster(scene.part).images(camera, torch.as_tensor(scene.truth)[None])[0])
        depth = np.where(binary_dilation(shown, iterations=2), view.observation.depth, np.nan)
        views.append(replace(view, observation=replace(view.observation, depth=depth)))
    return replace(look, measurements=views)


def believed(scene: BenchScene, recording: Recording, off: float) -> Population:
    """Twelve particles within tenths of a millimetre of where the first view shows the part, or beside it."""
    torch.manual_seed(0)
    prepared, views = model.prepare(recording), recording.measurements[:1]
    actions = [view.action for view in views]
    trace, _ = generate(model.program, (prepared, actions), model.observe(prepared, views), 12)
    stated, true = scene.cameras[0].world_from_camera, scene.world_from_cameras[0]
    error = poses.compose(torch.as_tensor(stated), poses.inverse(torch.as_tensor(true)))
    tangent = 1e-4 * torch.randn(12, 6, dtype=torch.float64)
    tangent[:, 1] += off
    around = poses.retract(poses.compose(error, torch.as_tensor(scene.truth)), tangent)
    name = actions[0].camera.instrument
    bias = torch.full((12,), float(scene.range_bias[0]), dtype=torch.float64)
    there = {"part": around, f"seen_by_{name}": around, f"bias_{name}": bias}
    return Population(trace.at(there))


@pytest.mark.long
@pytest.mark.parametrize("off", [0.0, 0.05])
def test_a_view_is_refuted_where_the_part_is_not(off: float) -> None:
    scene = bench_scene(50000)
    for recording in (alone(scene), scene.look()):
        population = believed(scene, recording, off)
        state = torch.get_rng_state()
        assert view_search.is_refuted(population, ["depth_0"]) == (off > 0.0)
        assert torch.equal(state, torch.get_rng_state())


@pytest.mark.long
def test_a_search_finds_a_part_that_the_fit_of_an_image_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The guess is so wide that the fit of each image ends beside the part, whatever the seed."""
    scene = bench_scene(50000, WIDE)
    recording, points = alone(scene), scene.part.surface_points()

    def off(seed: int) -> float:
        (*_, last) = guided_smc.infer(model, recording, seed=seed)
        return 1e3 * last.belief.weighted_add(points, scene.truth)

    assert max(off(seed) for seed in range(2)) < 15.0
    monkeypatch.setattr(guided_smc, "is_refuted", lambda *_: False)
    assert off(0) > 60.0
