"""A run over a recording that is saved after a measurement is resumed in another process, to the bit."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl.contact.probe_rollout import ProbeRollout
from bcppl.distributions.contact import ContactsInTime
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference import importance_sampling, saved, smc, tempered
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.recordings import save
from bcppl.traces import Model, Series, extend, simulate
from bcppl.traces.carried import carried
from tests.calibration.touch import CENTER, PHYSICS, PRIOR, PROBE, SENSING
from tests.inference.resume_saved import numbers_of
from tests.inference.test_resumed_runs import RESUMED, RUNS, assert_same, whole_run

pytestmark = pytest.mark.filterwarnings("ignore:.*leaves out stamps")


def assert_resumed_elsewhere(names: list[str], folder: Path) -> None:
    for number, name in enumerate(names):
        recording, (taken, *_) = RUNS[name][2](), RUNS[name][3]
        save(recording, folder / f"{number}.recording.h5")
        saved.save_step(whole_run(name)[taken], folder / f"{number}.h5", recording)
    environment = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    command = [sys.executable, "-W", "ignore", "-m", "tests.inference.resume_saved", str(folder), *names]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[2], env=environment)
    for number, name in enumerate(names):
        here, there = numbers_of(whole_run(name)[RUNS[name][3][0] + 1 :]), torch.load(folder / f"{number}.pt")
        assert len(here) == len(there) > 0
        for one, other in zip(here, there, strict=True):
            known, elsewhere = one.pop("known"), other.pop("known")
            assert known.keys() == elsewhere.keys()
            assert [a for a in known if not torch.equal(known[a], elsewhere[a])] == [], name
            assert [a for a in one if not torch.equal(one[a], other[a])] == [], name


@pytest.mark.long
def test_in_another_process(tmp_path: Path) -> None:
    assert_resumed_elsewhere(["tempered, pushes", "drifting, a view and windows"], tmp_path)


@pytest.mark.long
def test_every_run_in_another_process(tmp_path: Path) -> None:
    assert_resumed_elsewhere(RESUMED, tmp_path)


def test_a_step_is_of_its_recording_and_its_model(tmp_path: Path) -> None:
    name = "tempered, pushes"
    _, model, recordings, _ = RUNS[name]
    recording, path = recordings(), tmp_path / "step.h5"
    saved.save_step(whole_run(name)[2], path, recording)
    other = replace(recording, measurements=recording.measurements[::-1])
    with pytest.raises(InputError, match="assimilated 2 measurements of another recording"):
        saved.load_step(path, model, other)
    # The third measurement is still to come: it may be another.
    longer = replace(recording, measurements=[*recording.measurements[:2], recording.measurements[0]])
    again = saved.load_step(path, model, longer)
    assert repr(again.info) == repr(whole_run(name)[2].info) and again.taken == 2
    other_noise = replace(model, prepare=partial(model.prepare, spread=0.01))
    with pytest.raises(InputError, match="gives site 'onset_0' log-probability"):
        saved.load_step(path, other_noise, recording)
    saved.save(whole_run(name)[2].population, path)
    with pytest.raises(InputError, match="holds a population and no step"):
        saved.load_step(path, model, recording)


def pressed(stamps: Sequence[int]) -> None:
    """Windows of a peg that presses a block, between stamps."""
    pose = pyro.sample("pose", PRIOR)
    track = carried("press", partial(ProbeRollout.start, PHYSICS, SENSING, pose, PROBE))
    for number, (first, last) in enumerate(pairwise(stamps)):
        pyro.sample(f"seen_{number}", ContactsInTime(track, first, last, 0.001, every=3))


@pytest.mark.long
def test_a_fit_that_a_search_led_to_is_kept(tmp_path: Path) -> None:
    """Made again from the image alone, it would be the one that was refuted."""
    name = "guided, views and a touch"
    _, model, recordings, _ = RUNS[name]
    step, path = whole_run(name)[2], tmp_path / "step.h5"
    approximation = step.population.approximation
    fits = {
        view: replace(each, fit=each.fit._replace(means=each.fit.means + 0.01))
        for view, each in approximation.fits.items()
    }
    searched = replace(step, population=step.population.with_approximation(replace(approximation, fits=fits)))
    saved.save_step(searched, path, recordings())
    again = saved.load_step(path, model, recordings()).population.approximation
    assert again.fits.keys() == fits.keys() and len(fits) == 2
    for view, each in fits.items():
        assert again.fits[view].action is not None
        assert all(torch.equal(a, b) for a, b in zip(again.fits[view].fit, each.fit, strict=True))


def test_what_was_simulated_so_far_is_kept(tmp_path: Path) -> None:
    """Not even a particle that diverged, and was run again at half the time step, is simulated again."""
    torch.manual_seed(0)
    seen = simulate(pressed, ((4, 16, 24),), 1).choices
    population = importance_sampling(pressed, ((4, 16),), {"seen_0": seen["seen_0"][0]}, 5)
    rollout = population.trace.carried["press"].state.rollout
    rollout._particles.level[2] = 1  # as after a divergence
    saved.save(population, tmp_path / "p.h5")
    again = saved.load(tmp_path / "p.h5", pressed)
    assert again.trace.carried["press"].state.count == 16
    gained, amounts = [], []
    for each in (population, again, population[[0, 1, 2, 3, 4]]):
        trace = each.trace
        if each not in (population, again):
            trace = replace(trace, carried={})  # simulated again
        before = PHYSICS.effort.amount
        gained.append(extend(trace, ((4, 16, 24),), {"seen_1": seen["seen_1"][0]})[1])
        amounts.append(PHYSICS.effort.amount - before)
    assert torch.equal(gained[0], gained[1]) and not torch.equal(gained[0], gained[2])
    assert amounts[0] == pytest.approx(amounts[1]) and amounts[1] < amounts[2]


@pytest.mark.parametrize("name", ["rollout.rows", "rollout.state.state", "sensed.state.filter"])
def test_a_simulators_state_of_another_shape_is_refused(name: str) -> None:
    begun = ProbeRollout.start(PHYSICS, SENSING, CENTER.expand(3, 7), PROBE).advance(6)
    kept = begun.stored()
    fresh = ProbeRollout.start(PHYSICS, SENSING, CENTER.expand(3, 7), PROBE)
    assert fresh.restored(kept).advance(24).stored().keys() == begun.advance(24).stored().keys()
    for wrong in (kept[name][:2], kept[name].astype(np.float32), kept[name][..., :1]):
        with pytest.raises(InputError, match=r"no array .* of its type and shape"):
            fresh.restored({**kept, name: wrong})
    with pytest.raises(InputError, match="levels are out of range"):
        fresh.restored({**kept, "rollout.level": np.full(3, 7)})
    with pytest.raises(InputError, match="of different lengths"):
        fresh.restored({**kept, "sensed.contacts": kept["sensed.contacts"][:, :4]})


@pytest.mark.parametrize("history", [True, False])
def test_a_run_of_a_pose_that_moves_is_resumed(history: bool, tmp_path: Path) -> None:
    """Its steps have arguments of their own, which are those of the recording."""
    spread = 0.01 * torch.ones(6, dtype=torch.float64)

    def place(scene: Any, actions: list[Any]) -> torch.Tensor:
        return pyro.sample("part", NormalPose(CENTER, spread))

    def carry(pose: torch.Tensor, scene: Any, actions: list[Any]) -> torch.Tensor:
        (push,) = actions
        pose = pyro.sample("part", NormalPose(pose, float(push.times[-1]) * 0.001 * spread))
        pyro.sample("seen", dist.Normal(pose[:, :3], 0.005).to_event(1))
        return pose

    recording = RUNS["tempered, pushes"][2]()
    model = Model(
        Series(place, carry, history=history),
        prepare=lambda recording: object(),
        observe=lambda scene, taken: {"seen": CENTER[:3] + 0.001},
        pose="part",
    )
    step = tempered(metropolis_hastings(drift("part")), sweeps=2)
    run = list(smc(model, recording, step=step, particles=20))
    saved.save_step(run[1], tmp_path / "step.h5", recording)
    start = saved.load_step(tmp_path / "step.h5", model, recording)
    assert_same(run[2:], list(smc(model, recording, step=step, start=start)))
    if history:
        assert torch.equal(start.population.trace["part", 0], run[1].population.trace["part", 0])
