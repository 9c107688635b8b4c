"""Runs that are resumed, branched or repeated on one scene give the same bits, and write nothing into it."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.geometry.parts import Guess
from bcppl.inference.filters import bayes_contact, guided_smc, tempered_smc
from bcppl.inference.filters.default import default_inference
from bcppl.inference.filters.smc import Step
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.saved import load_step, save_step
from bcppl.models import (
    camera_error,
    grasped_peg,
    look_and_touch,
    part_in_view,
    peg_in_hole,
    point_probe,
    which_hole,
)
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.recordings import Recording, load
from bcppl.sensors.scene import Scene
from bcppl.traces import Model, generate, update
from tests.models.scene_contents import contents

PARTICLES = 6
# Windows are left out of the recordings for the sake of time.
pytestmark = pytest.mark.filterwarnings("ignore:.*leaves out stamps")

FIRST, SECOND = 0, 1  # views of the bench
START = 2  # the window by which a probe's wrench is tared
TOP, LATER, ON = 8, 10, 11  # windows in which the peg feels the top, again farther on, and stays on it


@functools.cache
def probed() -> Recording:
    """A scene of the bench with small images, probed by a plan laid out at the truth."""
    scene = bench_scene(7, BenchParameters(width=64, rows=48, focal=64.0), part="square 8 mm")
    truth = torch.from_numpy(scene.truth)
    certain = Belief(truth.expand(4, 7).clone(), torch.zeros(4, dtype=torch.float64))
    whole = scene.probe(three_two_one(certain, scene.part, scene.peg))
    near = poses.retract(truth, torch.tensor([1e-3, -2e-3, 1e-3, 0.01, -0.01, 0.02]).double()).numpy()
    return replace(whole, guess=Guess(near, np.full(3, 0.005), 0.03, 0.06))


def bench(*which: int) -> Recording:
    return replace(probed(), measurements=[probed().measurements[k] for k in which])


def precisely_known(*which: int) -> Recording:
    """The same, the part known to half a millimetre: touches alone discriminate between particles."""
    recording = bench(*which)
    return replace(recording, guess=Guess(recording.truth, np.full(3, 0.0006), 0.01, 0.02))


def shipped(name: str, *which: int) -> Recording:
    with as_file(files("bcppl.models") / f"recordings/{name}.h5") as file:
        whole = load(file)
    return replace(whole, measurements=[whole.measurements[k] for k in which])


def assert_same(first: Sequence[Step], second: Sequence[Step]) -> None:
    """Equal to the bit, step by step."""
    assert [one.taken for one in first] == [other.taken for other in second]
    differing = [
        f"{name} after {one.info.label}"
        for one, other in zip(first, second, strict=True)
        for name, value in state_of(one).items()
        if not torch.equal(value, state_of(other)[name])
    ]
    assert not differing


def state_of(step: Step) -> dict[str, torch.Tensor]:
    return {
        "poses": step.belief.world_from_part,
        "log weights": step.belief.log_weights,
        "log evidence": torch.tensor(step.population.log_evidence, dtype=torch.float64),
        "random state": step.random_state,
        **step.population.trace.choices,
    }


# ---------------------------------------------------------------- resumed from a step

FEW_MOVES = functools.partial(tempered_smc.infer, sweeps=2)
HOLES = ((0.0, 0.0), (0.01, 0.005))  # on the block of the shipped recording
TWO_HOLES = replace(which_hole.model, prepare=functools.partial(which_hole.prepare, holes=HOLES))


def own(model: Model) -> Callable[..., Any]:
    """A model's own inference program, with few moves."""
    return functools.partial(default_inference(model)[1], sweeps=1)


# The inference program, the model, the recording, and the steps to resume from.
RUNS: dict[str, tuple[Callable[..., Any], Model, Callable[[], Recording], tuple[int, ...]]] = {
    "guided, views and a touch": (
        guided_smc.infer,
        look_and_touch.model,
        lambda: bench(FIRST, SECOND, START, TOP),
        (1,),
    ),
    "guided, touches around a view": (
        guided_smc.infer,
        look_and_touch.model,
        lambda: bench(START, TOP, FIRST, LATER),
        (3,),
    ),
    "tempered, touches": (FEW_MOVES, look_and_touch.model, lambda: precisely_known(START, LATER, ON), (2,)),
    "tempered, a view and windows": (
        FEW_MOVES,
        peg_in_hole.model,
        lambda: shipped("peg_probe", 0, 2, 3),
        (1, 2),
    ),
    "tempered, pushes": (
        FEW_MOVES,
        point_probe.model,
        lambda: shipped("point_probe_10_pushes", 0, 1, 2),
        (1, 2),
    ),
    "drifting, a view and windows": (
        bayes_contact.infer,
        peg_in_hole.model,
        lambda: shipped("peg_probe", 0, 2, 3),
        (1, 2),
    ),
    "drifting, pushes": (
        bayes_contact.infer,
        point_probe.model,
        lambda: shipped("point_probe_10_pushes", 0, 1, 2),
        (1, 2),
    ),
    "camera errors": (own(camera_error.model), camera_error.model, lambda: bench(FIRST), ()),
    "clutter": (own(part_in_view.model), part_in_view.model, lambda: bench(FIRST), ()),
    "grasp": (own(grasped_peg.model), grasped_peg.model, lambda: shipped("peg_probe", 0, 2), ()),
    "two holes": (own(TWO_HOLES), TWO_HOLES, lambda: shipped("peg_probe", 0, 2), ()),
}
RESUMED = [name for name, (*_, starts) in RUNS.items() if starts]


class Listed(NamedTuple):
    """A run on a scene, and what the scene held before and after it."""

    run: list[Step]
    before: dict[str, Any]
    after: dict[str, Any]


@functools.cache
def listed_run(name: str) -> Listed:
    infer, model, recording, _ = RUNS[name]
    scene = model.prepare(recording())
    before = contents(scene)
    run = list(infer(model, recording(), particles=PARTICLES, seed=3, scene=scene))
    return Listed(run, before, contents(scene))


def whole_run(name: str) -> list[Step]:
    return listed_run(name).run


def written(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """The paths at which a scene holds something else than before."""
    return [path for path in before | after if before.get(path) != after.get(path)]


@pytest.mark.long
@pytest.mark.parametrize("name", RUNS)
def test_nothing_is_written_into_a_scene(name: str) -> None:
    _, before, after = listed_run(name)
    assert len(before) > 40 and written(before, after) == []


def by_entry(scene: Any) -> None:
    scene.likelihoods["view"].looks["another"] = None


def by_replaced_entry(scene: Any) -> None:
    looks = scene.likelihoods["view"].looks
    looks["camera_0"] = looks["camera_0"]._replace(region=(0, 0, 1, 1))


def by_attribute(scene: Any) -> None:
    scene.likelihoods["view"].fits = {0: torch.zeros(6)}


def by_tensor(scene: Any) -> None:
    scene.prior.center[0] += 1e-12


def by_array(scene: Any) -> None:
    scene.likelihoods["window"].gap.part.vertices[0, 0] *= 1.0 + 1e-15


@pytest.mark.long
@pytest.mark.parametrize("write", [by_entry, by_replaced_entry, by_attribute, by_tensor, by_array])
def test_a_model_that_writes_into_its_scene_is_seen(write: Callable[[Any], None]) -> None:
    def program(scene: Any, actions: Sequence[Any]) -> None:
        look_and_touch.look_and_touch(scene, actions)
        write(scene)

    recording = copy.deepcopy(bench(FIRST, START, TOP))
    scene = look_and_touch.prepare(recording)
    before, actions = contents(scene), [m.action for m in recording.measurements]
    generate(look_and_touch.look_and_touch, (scene, actions), {}, 2)
    assert written(before, contents(scene)) == []
    generate(program, (scene, actions), {}, 2)
    assert written(before, contents(scene)) != []


@pytest.mark.long
@pytest.mark.parametrize("name", RESUMED)
def test_a_resumed_run_is_the_uninterrupted_one(name: str) -> None:
    """It is resumed from nothing but a step."""
    infer, model, recording, starts = RUNS[name]
    run = whole_run(name)
    for taken in starts:
        assert_same(run[taken + 1 :], list(infer(model, recording(), seed=3, start=run[taken])))


@pytest.mark.parametrize("name", ["guided, touches around a view", "tempered, touches"])
def test_a_run_is_resumed_on_a_new_scene(name: str) -> None:
    infer, model, recording, (taken,) = RUNS[name]
    run, scene = whole_run(name), model.prepare(recording())
    assert_same(run[taken + 1 :], list(infer(model, recording(), seed=3, start=run[taken], scene=scene)))


@pytest.mark.parametrize("model", [look_and_touch.model, point_probe.model])
def test_nothing_is_evaluated_again_on_a_new_scene(model: Model) -> None:
    """Its simulators are of equal parts; what the old ones have cached and cost does not count."""
    recording = bench(FIRST) if model is look_and_touch.model else shipped("point_probe_10_pushes", 0)
    one, other = (model.prepare(replace(recording, part=replace(recording.part))) for _ in range(2))
    actions = [m.action for m in recording.measurements]
    trace, _ = generate(model.program, (one, actions), one.observed(recording.measurements), PARTICLES)
    updated = update(trace, args=(other, actions))
    assert updated.trace.known.keys() == trace.known.keys() and not updated.log_ratio.any()
    assert not any(effort.calls for effort in other.efforts.values())


# ---------------------------------------------------------------- one scene for several runs


def guided(recording: Recording, scene: Any, start: Step | None = None) -> list[Step]:
    model = look_and_touch.model
    return list(guided_smc.infer(model, recording, particles=PARTICLES, seed=1, scene=scene, start=start))


def fresh() -> Scene:
    """A scene that knows the cameras and the probe of all measurements."""
    return look_and_touch.prepare(probed())


@functools.cache
def alone(*which: int) -> list[Step]:
    return guided(bench(*which), fresh())


@pytest.mark.long
@pytest.mark.parametrize(("one", "other"), [(TOP, LATER), (SECOND, TOP), (TOP, SECOND)])
def test_two_branches_from_one_step_do_not_influence_each_other(one: int, other: int) -> None:
    """After a view: two windows, a view and a window, and a window and a view."""
    *_, start = guided(bench(FIRST, START), fresh())
    scene = start.population.trace.args[0]
    guided(bench(FIRST, START, one), scene, start)
    assert_same(alone(FIRST, START, other)[3:], guided(bench(FIRST, START, other), scene, start))


def test_another_image_with_the_same_number_is_fitted() -> None:
    scene = fresh()
    guided(bench(FIRST), scene)
    assert_same(alone(SECOND), guided(bench(SECOND), scene))


@pytest.mark.long
def test_a_run_in_another_order_on_the_same_scene_has_no_influence() -> None:
    scene = fresh()
    guided(bench(START, TOP, FIRST), scene)
    assert_same(alone(FIRST, START, TOP), guided(bench(FIRST, START, TOP), scene))


@pytest.mark.long
def test_a_run_by_another_inference_program_on_the_same_scene_has_no_influence() -> None:
    """Guided runs fit images, tempered ones do not."""
    scene, recording = fresh(), bench(FIRST, START, TOP)
    other = tempered_smc.infer(look_and_touch.model, recording, particles=PARTICLES, sweeps=1, scene=scene)
    assert [step.taken for step in other] == [0, 1, 2, 3]
    assert_same(alone(FIRST, START, TOP), guided(recording, scene))


@pytest.mark.long
def test_a_guided_run_is_resumed_from_a_tempered_one_with_the_same_approximation() -> None:
    """It depends on the measurements alone, not on the particles."""
    model, scene = look_and_touch.model, fresh()
    *_, start = tempered_smc.infer(model, bench(FIRST), particles=PARTICLES, sweeps=1, scene=scene)
    assert start.population.approximation is None
    one, other = (
        run[-1].population.approximation
        for run in (guided(bench(FIRST, START, TOP), scene, start), alone(FIRST, START, TOP))
    )
    for mine, theirs in zip(one.mixture, other.mixture, strict=True):
        assert torch.equal(mine, theirs)


def test_a_second_run_on_the_same_scene_is_the_first() -> None:
    first = alone(FIRST, START, TOP)
    assert_same(first, guided(bench(FIRST, START, TOP), first[0].population.trace.args[0]))


def test_a_run_over_a_measurement_that_is_held_twice_goes_on_from_its_file(tmp_path: Path) -> None:
    recording = shipped("point_probe_10_pushes", 0, 1, 2)
    first, *others = recording.measurements
    twice = replace(recording, measurements=[first, replace(first), *others])
    with pytest.warns(RuntimeWarning, match="repeats measurement 0"):
        steps = list(bayes_contact.infer(point_probe.model, twice, particles=20))
    save_step(steps[2], tmp_path / "step.h5", twice)
    step = load_step(tmp_path / "step.h5", point_probe.model, twice)
    with pytest.warns(RuntimeWarning, match="repeats measurement 0"):
        *_, last = bayes_contact.infer(point_probe.model, twice, start=step)
    assert last.info.log_evidence == steps[-1].info.log_evidence
