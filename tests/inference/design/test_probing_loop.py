"""The loop on the bench: its rounds, how it resumes inference and ends, and the arm that executes it."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.gap import PegGap
from bcppl.inference.design.loop import Round, named_apart, probing_loop
from bcppl.inference.design.rules import at_random, by_linearised_gain, in_given_order
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.filters.smc import Step
from bcppl.inference.planning.candidate_layout import plan_candidates
from bcppl.inference.planning.insertion import insertion_plan
from bcppl.models import look_and_touch
from bcppl.models.worlds.bench.arm import BenchArm
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.recordings import Recording, View, problems
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.candidates import Candidate, duration_of, name_of
from tests.made_recordings import assert_one_sentence

model = look_and_touch.model.with_settings(profile="perfect")
PARTICLES = 30


@functools.cache
def seen() -> tuple[BenchScene, Recording, Step, PegGap]:
    scene = bench_scene(5, BenchParameters(width=80, rows=60, focal=80.0))
    look = scene.look()
    *_, last = infer(model, look, particles=PARTICLES, seed=0)
    return scene, look, last, PegGap(scene.part, scene.peg)


def asked(belief: Belief, number: int) -> list[Candidate]:
    scene, _, _, gap = seen()
    return list(plan_candidates(belief, scene.part, scene.peg, {"touch": 3, "pair": 4}, gap=gap, seed=number))


@functools.cache
def followed() -> list[Round]:
    scene, look, last, _ = seen()
    rank = by_linearised_gain(model.pose, outer_samples=6, seed=0)
    return list(probing_loop(model, look, BenchArm(scene), asked, rank, start=last, probes=2))


@pytest.mark.long
def test_chosen_probes_lower_the_error_to_a_fraction_and_the_peg_goes_in() -> None:
    scene, _, last, _ = seen()
    points = scene.part.surface_points()
    adds = [
        1e3 * step.belief.weighted_add(points, scene.truth) for step in (last, *(r.step for r in followed()))
    ]
    assert len(followed()) == 2 and adds[0] > 3.0
    assert adds[2] < 0.25 * adds[0] and adds[2] < 1.0, adds
    last_round = followed()[-1]
    plan = insertion_plan(last_round.step.belief, scene.part, scene.peg)
    assert BenchArm(scene).insert(plan).inserted


def test_rounds_execute_the_best_candidate_and_the_recording_grows() -> None:
    _, look, _, _ = seen()
    taken = len(look.measurements)
    for number, each in enumerate(followed()):
        best = each.ranking.best
        assert each.number == number and name_of(each.chosen).startswith(name_of(best.candidate))
        assert best.value == max(p.value for p in each.ranking) > 1.0
        assert each.before.taken == taken < each.step.taken == len(each.recording.measurements)
        names = [m.action.probe.name for m in each.recording.measurements[taken:]]
        assert set(names) == {name_of(each.chosen)}
        taken = each.step.taken
    assert not problems(followed()[-1].recording)


@pytest.mark.long
def test_the_loops_belief_is_that_of_a_run_over_all_it_measured() -> None:
    first, second = followed()
    *_, whole = infer(model, first.recording, particles=PARTICLES, seed=0)
    assert torch.equal(whole.belief.world_from_part, first.step.belief.world_from_part)
    assert torch.equal(whole.belief.log_weights, first.step.belief.log_weights)
    assert second.before is first.step


@pytest.mark.long
def test_the_loop_ends_by_gain_by_success_probability_and_by_number() -> None:
    scene, look, last, _ = seen()

    def rounds(**settings: object) -> int:
        return len(
            list(
                probing_loop(  # type: ignore[call-overload]
                    model, look, BenchArm(scene), asked, at_random(0), start=last, **settings
                )
            )
        )

    with pytest.raises(InputError, match="expects no gains"):
        rounds(probes=3, minimum_gain=0.1)  # an order that is drawn
    with pytest.warns(
        UserWarning, match="before its first probe: an insertion succeeds with a probability of 1"
    ):
        assert rounds(probes=3, success_probability=lambda belief: 1.0) == 0
    with pytest.raises(InputError, match="at a success probability of 2"):
        rounds(sufficient=2)
    asked_of: list[Belief] = []

    def surer(belief: Belief) -> float:
        asked_of.append(belief)
        return 1.0 if len(asked_of) == 2 else 0.5

    assert rounds(probes=3, success_probability=surer, sufficient=0.9) == 1
    assert asked_of[0] is last.belief and asked_of[1] is not last.belief
    with pytest.warns(UserWarning, match="all candidates last longer than 0.5 s"):
        assert rounds(probes=3, seconds=0.5) == 0
    with pytest.warns(UserWarning, match="has an expected utility of .* nats"):
        loop = probing_loop(
            model,
            look,
            BenchArm(scene),
            asked,
            by_linearised_gain(model.pose, outer_samples=4, seed=0),
            start=last,
            minimum_gain=50.0,
        )
        assert not list(loop)


def test_measurements_must_be_of_the_chosen_candidate_and_fit_the_recording() -> None:
    scene, look, last, _ = seen()
    plan = asked(last.belief, 0)[0]

    class Twisted:
        """An arm whose windows (a list) are changed."""

        def __init__(self, change: Callable[[list[Any]], list[Any]]) -> None:
            self.change = change

        def execute(self, candidate: Any) -> list[Any]:
            return self.change(BenchArm(scene).execute(candidate))

    def millimetres(windows: list[Any]) -> list[Any]:
        scale = np.array([1e3, 1e3, 1e3, 1.0, 1.0, 1.0, 1.0])
        touches = [w.observation for w in windows]
        scaled = [dataclasses.replace(t, world_from_peg=t.world_from_peg * scale) for t in touches]
        return [dataclasses.replace(w, observation=t) for w, t in zip(windows, scaled, strict=True)]

    for message, change in (
        ("to execute 'touch 1.*' and gave a measurement of 'camera_0'", lambda w: [look.measurements[0]]),
        ("of 'touch 1.*' does not fit: .*millimetres", millimetres),
        ("of 'touch 1.*' does not fit", lambda w: w[len(w) // 2 :]),
        ("of 'touch 1.*' does not fit", lambda w: w[::-1]),
    ):
        loop = probing_loop(
            model,
            look,
            Twisted(change),
            lambda *now: [plan],
            lambda p, found, s: in_given_order(found),
            start=last,
        )
        with pytest.raises(InputError, match=message) as caught:
            next(loop)
        assert_one_sentence(str(caught.value))
    idle = probing_loop(
        model, look, BenchArm(scene), lambda *now: [plan], infer=lambda *now, **more: iter([]), start=last
    )
    with pytest.raises(InputError, match="yields no step"):
        next(idle)
    for what in (scene, insertion_plan(last.belief, scene.part, scene.peg)):
        with pytest.raises(InputError, match=f"{type(what).__name__} is no known kind of action"):
            BenchArm(scene).execute(what)  # type: ignore[arg-type]


@pytest.mark.long
def test_probes_together_last_no_longer_than_they_may_and_as_long_as_that() -> None:
    scene, look, last, _ = seen()
    plans = asked(last.belief, 0)
    longest, shortest = max(plans, key=duration_of), min(plans, key=duration_of)
    assert duration_of(longest) > duration_of(shortest)
    loop = probing_loop(
        model,
        look,
        BenchArm(scene),
        lambda *now: [longest, shortest],
        lambda population, found, known: in_given_order(found),
        start=last,
        # Rounding must not leave less than nothing.
        seconds=duration_of(longest) + duration_of(shortest) - 5e-10,
    )
    rounds = list(loop)
    assert [len(each.candidates) for each in rounds] == [2, 1]
    assert [name_of(each.chosen) for each in rounds] == [name_of(longest), name_of(shortest)]


def test_a_probe_that_is_chosen_twice_gets_a_name_of_its_own_and_the_arms_clock_runs_on() -> None:
    scene, look, _, _ = seen()
    plan = asked(seen()[2].belief, 0)[0]
    arm, recording = BenchArm(scene), look
    first = arm.execute(named_apart(plan, recording))
    recording = dataclasses.replace(recording, measurements=[*recording.measurements, *first])
    again = named_apart(plan, recording)
    assert name_of(again) == f"{name_of(plan)} (2)"
    second = arm.execute(again)
    whole = scene.probe(plan)  # the first plan is felt as the scene alone has it
    for ours, theirs in zip(first, whole.measurements[2:], strict=True):
        assert np.array_equal(ours.observation.wrench, theirs.observation.wrench)
        assert np.array_equal(ours.observation.world_from_peg, theirs.observation.world_from_peg)
    assert second[0].observation.times[0] > first[-1].observation.times[-1]
    noise = [m[0].observation.wrench[:5] for m in (first, second)]
    assert not np.allclose(noise[0], noise[1], atol=1e-3)
    view = View(dataclasses.replace(scene.cameras[0], name="camera_0"))
    moved = named_apart(view, recording)
    assert isinstance(moved, View) and moved.camera.name == "camera_0 (2)"
    assert moved.camera.instrument == "camera_0"
    image = arm.execute(moved)[0].observation.depth
    # The same camera looks from the same place once more: only its noise is new.
    before = look.measurements[0].observation.depth
    assert abs(np.nanmedian(image - before)) < 0.001 and not np.array_equal(image, before)


def test_a_view_may_be_chosen_and_is_assimilated() -> None:
    scene, look, last, _ = seen()

    def views(belief: Belief, number: int) -> list[Candidate]:
        return list(
            plan_candidates(belief, scene.part, None, {"view": 1}, like=[View(scene.cameras[0])], seed=number)
        )

    (only,) = probing_loop(
        model,
        look,
        BenchArm(scene),
        views,
        lambda population, found, known: in_given_order(found),
        start=last,
        probes=1,
    )
    assert only.step.info.label == "view 3" and math.isnan(only.ranking.best.information_gain)
    assert float(only.step.belief.spread[:3].norm()) < 1.2 * float(last.belief.spread[:3].norm())
    assert not any(isinstance(m.action, ProbeWindow) for m in only.recording.measurements)


def test_a_loop_without_candidates_or_world_is_refused_in_a_sentence() -> None:
    scene, look, last, _ = seen()

    class Silent:
        def execute(self, candidate: object) -> list[object]:
            return []

    for message, world, source in (
        ("there are no candidates", BenchArm(scene), lambda belief, number: []),
        ("gave no measurement of 'touch 1", Silent(), asked),
        ("str is no known kind of action", BenchArm(scene), lambda belief, number: ["touch"]),
        ("no peg to execute 'touch 1", BenchArm(scene), asked),
    ):
        known = dataclasses.replace(look, peg=None) if "no peg" in message else look
        with pytest.raises(InputError, match=message) as caught:
            list(
                probing_loop(
                    model,
                    known,
                    world,
                    source,
                    lambda population, found, known: in_given_order(found),
                    start=last,
                )
            )
        assert_one_sentence(str(caught.value))


@pytest.mark.parametrize("chance", [math.nan, "likely", 1.5])
def test_a_success_probability_that_is_none_is_refused(chance: object) -> None:
    scene, look, last, _ = seen()
    loop = probing_loop(
        model,
        look,
        BenchArm(scene),
        asked,
        start=last,
        success_probability=lambda belief: chance,  # type: ignore[arg-type, return-value]
    )
    with pytest.raises(InputError, match="the success probability of an insertion is") as caught:
        next(loop)
    assert_one_sentence(str(caught.value))
