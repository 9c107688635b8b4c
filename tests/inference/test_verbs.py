"""Filters that are loops over verbs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from bcppl.inference import (
    Pair,
    initialize,
    merge,
    observations_of,
    rejuvenate,
    replicate,
    resample,
    resize,
    smc,
    smcp3,
    tempered,
    update,
)
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import adaptive, always, never
from bcppl.models import load_recording
from bcppl.models.point_probe import model
from bcppl.recordings import Measurement, Recording
from bcppl.traces import Series


def pushes(count: int = 4) -> Recording:
    whole = load_recording("point_probe_10_pushes")
    return replace(whole, measurements=whole.measurements[:count])


def test_a_loop_over_verbs_is_the_shipped_loop_to_the_bit() -> None:
    recording, kernel = pushes(), metropolis_hastings(drift("part"))
    scene = model.prepare(recording)
    torch.manual_seed(4)
    population, mine = initialize(model, scene, particles=40), []
    for observed in observations_of(model, scene, recording.measurements):
        population = update(population, observed)
        if population.effective_sample_size < 20.0:
            population = rejuvenate(resample(population), kernel, sweeps=2)
        mine.append(population)
    step = tempered(kernel, sweeps=2, share=0.0, resample=adaptive(threshold=0.5))
    theirs = list(smc(model, recording, step=step, particles=40, seed=4))[1:]
    assert any(each.info.step.resampled for each in theirs)
    for one, other in zip(mine, theirs, strict=True):
        assert torch.equal(one["part"], other.population["part"])
        assert torch.equal(one.log_weights, other.population.log_weights)
        assert one.log_evidence == other.info.log_evidence


def test_an_update_by_a_pair_is_the_step_of_smcp3() -> None:
    recording, pair = pushes(2), Pair(drift("part"), drift("part"))
    scene = model.prepare(recording)
    for scheme, then in ((never, lambda population: population), (always(), resample)):
        torch.manual_seed(1)
        population = initialize(model, scene, particles=30)
        for observed in observations_of(model, scene, recording.measurements):
            population = then(update(population, observed, pair))
        *_, last = smc(model, recording, step=smcp3(pair, resample=scheme), particles=30, seed=1)
        assert torch.equal(population["part"], last.population["part"])
        assert population.log_evidence == last.info.log_evidence


def test_observations_continue_where_a_population_stands() -> None:
    recording = pushes()
    scene = model.prepare(recording)
    whole = list(observations_of(model, scene, recording.measurements))
    rest = list(observations_of(model, scene, recording.measurements, start=3))
    assert [len(each.args[1]) for each in whole] == [1, 2, 3, 4] and len(rest) == 1
    assert rest[0].observations.keys() == whole[3].observations.keys()
    assert not set(whole[3].observations) & set(whole[2].observations)


def test_resizing_keeps_the_evidence_and_what_merging_keeps() -> None:
    recording = pushes(1)
    scene = model.prepare(recording)
    torch.manual_seed(0)
    population = initialize(model, scene, particles=50)
    for observed in observations_of(model, scene, recording.measurements):
        population = update(population, observed)
    for other in (resize(population, 200), replicate(population, 3), merge(replicate(population, 3))):
        assert math.isclose(other.log_evidence, population.log_evidence, abs_tol=1e-12)
    assert len(resize(population, 200)) == 200 and len(merge(replicate(population, 3))) == 50


def test_a_series_is_given_the_newest_measurement_alone_and_continues_so() -> None:
    recording, given = pushes(3), []

    def observe(scene: object, measurements: Sequence[Measurement]) -> dict[str, torch.Tensor]:
        given.append(len(measurements))
        return {"y": torch.zeros(())} if len(given) > 1 else {}

    walking = replace(model, program=Series(lambda *_: None, lambda *_: None), observe=observe)
    whole = list(observations_of(walking, None, recording.measurements, start=1))
    assert given == [1, 1] and [sorted(each.observations) for each in whole] == [[], ["y"]]
    assert [each.args[1] for each in whole] == [[m.action] for m in recording.measurements[1:]]
