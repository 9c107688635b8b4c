"""The information of views: a plane's closed form, the camera's own errors, and the ranking."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.extrusion import block
from bcppl.inference.design.rules import by_linearised_gain
from bcppl.inference.population import Population
from bcppl.models.look_and_touch import model
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.rendering.information import STEPS, pixel_information
from bcppl.rendering.ray_casting import RayCaster
from bcppl.sensors import View
from bcppl.sensors.candidates import with_candidates
from bcppl.sensors.likelihoods.erring_camera import ErringCamera
from bcppl.traces import generate


def from_above(height: float, name: str = "camera") -> Camera:
    pose = looking_at(np.array([0.0, 0.0, height]), np.zeros(3), (0.0, 1.0, 0.0))
    return Camera(name, 80, 60, 100.0, 100.0, 39.5, 29.5, pose, near=0.05, far=2.0)


def test_of_a_plane_that_fills_the_image_it_is_the_closed_form() -> None:
    """Each pixel reads the depth of a plane: it informs height and tilt, and nothing else."""
    renderer, camera = RayCaster(block((1.0, 1.0, 0.02))), from_above(0.3)
    information = pixel_information(renderer, camera, poses.identity(2))
    top = 0.3 - float(renderer.part.vertices[:, 2].max())
    rays = np.stack(np.meshgrid((np.arange(80) - 39.5) / 100, (np.arange(60) - 29.5) / 100), -1).reshape(
        -1, 2
    )
    places = torch.from_numpy(top * rays)
    assert float(information[0, 2, 2]) == pytest.approx(80 * 60, rel=1e-3)
    assert float(information[0, 2, 6]) == pytest.approx(-80 * 60, rel=1e-3)  # nearer is higher
    size = float(places.square().sum())
    assert float(information[0, 3, 3] + information[0, 4, 4]) == pytest.approx(size, rel=0.01)
    assert float(information[0, [0, 1, 5]][:, [0, 1, 5]].abs().max()) < 1e-3 * size
    torch.testing.assert_close(information[0], information[1])


def test_what_pixels_tell_of_one_particle_does_not_depend_on_the_others() -> None:
    """A part far off its origin swings out of the first particle's region where another turns it."""
    away = torch.tensor([0.08, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    renderer, camera = RayCaster(block((0.03, 0.03, 0.02)).moved(away.numpy())), from_above(0.3)
    turned = poses.retract(poses.identity(1), torch.tensor([[0, 0, 0, 0, 0, 0.8]], dtype=torch.float64))
    together = pixel_information(renderer, camera, torch.cat([poses.identity(1), turned]))
    assert float(together[1, 2, 2]) > 50.0
    torch.testing.assert_close(together[1:], pixel_information(renderer, camera, turned))


def test_surfaces_out_of_the_sensors_range_are_uninformative() -> None:
    renderer = RayCaster(block((0.3, 0.3, 0.02)))
    seen = pixel_information(renderer, from_above(0.3), poses.identity(1))
    assert float(seen[0, 2, 2]) > 1000.0
    for near, far in ((0.05, 0.2), (0.4, 2.0)):
        blind = replace(from_above(0.3), near=near, far=far)
        assert not pixel_information(renderer, blind, poses.identity(1)).any()


def test_pixels_that_a_step_takes_off_the_part_inform_nothing() -> None:
    # The outermost pixels see it 0.2 mm from its edge.
    renderer, camera = RayCaster(block((0.0934, 0.08, 0.005))), from_above(0.3)
    steps = torch.diag(torch.tensor(STEPS, dtype=torch.float64))
    moved = torch.cat([poses.retract(poses.identity(6), sign * steps) for sign in (1.0, -1.0)])
    there = np.isfinite(renderer.images(camera, torch.cat([poses.identity(1), moved])))
    kept = int(there.all(axis=0).sum())
    assert kept < there[0].sum() - 20
    information = pixel_information(renderer, camera, poses.identity(1))[0]
    assert float(information[6, 6]) == kept
    assert float(information[2, 2]) == pytest.approx(kept, rel=1e-3)


def test_a_part_at_the_border_of_an_image_informs_little_and_beside_it_nothing() -> None:
    renderer, camera = RayCaster(block((0.04, 0.04, 0.02))), from_above(0.3)
    height = []
    for x in np.linspace(0.09, 0.2, 45):  # m: less of it is in the image than a bin is wide, then none
        part = poses.identity(1)
        part[0, 0] = x
        height.append(float(pixel_information(renderer, camera, part, bins=4)[0, 2, 2]))
    assert height[0] > 1.0 and height[-1] == 0.0
    behind = poses.identity(1)
    behind[0, 2] = 1.0
    assert not pixel_information(renderer, camera, behind, bins=4).any()


def test_the_cameras_error_bounds_its_information_and_a_second_image_adds_less() -> None:
    recording = bench_scene(2, part="square 8 mm").look()
    scene = model.prepare(recording)
    views = [m.action for m in recording.measurements]
    torch.manual_seed(0)
    trace, _ = generate(model.program, (scene, []), {}, 12)
    sensor, part = scene.likelihoods["view"], trace["part"]
    assert isinstance(sensor, ErringCamera)
    first = sensor.information([], views[0], part)
    assert bool((torch.linalg.eigvalsh(first) > -1e-6).all())
    bound = torch.linalg.inv(_error(sensor, views[0].camera, part))
    assert bool((torch.linalg.eigvalsh(bound - first) > -1e-3 * float(bound.abs().max())).all())
    again, other = (sensor.information(views[:1], v, part) for v in views)
    size = [
        float(torch.linalg.slogdet(torch.eye(6) * 1e4 + each)[1].mean()) for each in (first, again, other)
    ]
    assert size[1] < size[2] and size[1] < size[0]


def test_an_image_informs_as_much_as_its_likelihood_is_raised_to_a_power() -> None:
    """By a camera that hardly errs, information is in proportion to that power."""
    recording = bench_scene(2, part="square 8 mm").look()
    view = recording.measurements[0].action
    exact = {"camera_shift": 1e-9, "camera_turn": 1e-9, "bias": 1e-9, "bins": 3}
    part = poses.as_pose(recording.guess.world_from_part)[None]

    def informs(**power: float | None) -> torch.Tensor:
        sensor = model.prepare(recording, **exact, **power).likelihoods["view"]
        return sensor.information([], view, part)

    whole = informs(effective_pixels=None, temperature=None)
    compared = model.prepare(recording, **exact).likelihoods["view"].camera(view)
    for pixels in (20.0, 200.0):
        share = pixels / (compared.width * compared.height)
        torch.testing.assert_close(
            informs(effective_pixels=pixels, temperature=None), share * whole, rtol=1e-4, atol=1.0
        )
    torch.testing.assert_close(
        informs(effective_pixels=None, temperature=4.0), 0.25 * whole, rtol=1e-4, atol=1.0
    )


def _error(sensor: ErringCamera, camera: Camera, part: torch.Tensor) -> torch.Tensor:
    return sensor.error.covariance([camera], part)


def test_views_and_touches_stand_in_one_ranking() -> None:
    world = bench_scene(2, part="square 8 mm")
    recording = world.look()
    scene = model.prepare(recording)
    torch.manual_seed(1)
    trace, _ = generate(model.program, (scene, []), {}, 40)
    spread = torch.tensor([2e-3] * 3 + [0.02] * 3, dtype=torch.float64)
    near = poses.retract(torch.from_numpy(world.truth), spread * torch.randn(40, 6, dtype=torch.float64))
    population = Population(trace.at({"part": near}))
    away = replace(recording.measurements[0].action.camera, name="away", device="")
    blind = replace(away, world_from_camera=looking_at(np.array([0.5, 0.5, 1.9]), np.array([0.5, 0.0, 0.1])))
    plan = _down(world)
    scene = model.prepare(with_candidates(recording, [View(blind)]))
    candidates = [plan, recording.measurements[0].action, View(blind)]
    ranking = by_linearised_gain("part", peg=None, seed=0)(population, candidates, scene)
    gain = [ranking.of(k).information_gain for k in range(3)]
    assert gain[0] > 2.0 and gain[1] > 1.0
    assert 0.0 <= gain[2] < gain[1]
    assert all(math.isfinite(each) for each in gain)
    # As seen from the held peg; what a view tells does not depend on whether a touch is in the list.
    relative = by_linearised_gain("part", seed=0)
    among = [relative(population, candidates, scene).of(k).information_gain for k in (1, 2)]
    alone = [relative(population, candidates[1:], scene).of(k).information_gain for k in (0, 1)]
    assert alone == among and 0.0 <= among[1] < among[0] < gain[1]


def _down(world: object) -> object:
    from bcppl.robot.plan import Plan

    tip = -float(world.peg.vertices[:, 2].min())  # type: ignore[attr-defined]
    top = float(world.part.vertices[:, 2].max())  # type: ignore[attr-defined]
    at = poses.as_pose(world.truth).expand(2, 7).clone()  # type: ignore[attr-defined]
    places = torch.tensor([[0.02, 0.02, top + tip + 0.012], [0.02, 0.02, top + tip - 0.012]]).double()
    at[:, :3] = poses.transform(at[0], places)
    return Plan("down", np.array([0.0, 1.0]), at.numpy(), ("guarded",), 4.0, np.ones(6), np.ones(6))
