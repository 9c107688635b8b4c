"""Rows of a probe: any cut, any rate, repeats, deferred windows, and mutants."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.contact.sensing.contact_detection import ContactDetector
from bcppl.contact.sensing.episodes import EpisodeExtractor, Rows
from bcppl.contact.touch import Touch
from bcppl.distributions.episodes.rows import (
    FELT,
    FORCE,
    GIVEN,
    TIME,
    WRENCH,
    new_rows,
)
from bcppl.geometry.extrusion import block, box_peg
from bcppl.geometry.parts import Guess
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.verbs import observations_of
from bcppl.models import look_and_touch
from bcppl.recordings import repeated
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors import Measurement, Recording
from bcppl.traces import Model
from tests.distributions.touches.test_manifold import around

COMPLIANCE = 5e-6
PERFECT = look_and_touch.model.with_settings(profile="perfect")
LONG, HIGH = 0.05, 0.025


@functools.cache
def probed(rate: int) -> Recording:
    """A block that is tapped on its top, pressed for 0.4 s, and pressed from a side, in 3 s; no view."""
    stamps = np.arange(0.0, 3.0, 1.0 / rate)
    knots = [
        (0.0, 0.0, 0.010),
        (0.4, 0.0, 0.010),
        (0.5, 0.0, -0.002),  # the first press is a tap
        (0.62, 0.0, 0.010),
        (1.0, 0.015, 0.004),
        (1.2, 0.015, -0.002),
        (1.6, 0.015, -0.002),
        (1.8, 0.050, 0.008),
        (2.1, 0.050, -0.015),
        (2.4, 0.036, -0.015),
        (2.7, 0.036, -0.015),
        (2.9, 0.050, -0.015),
        (3.0, 0.050, -0.015),
    ]
    time, x, z = np.array(knots).T
    command = np.zeros((len(stamps), 7))
    command[:, 0], command[:, 2], command[:, 3] = np.interp(stamps, time, x), np.interp(stamps, time, z), 1.0
    stood, force, side = command.copy(), np.zeros((len(stamps), 3)), 0.03 + 0.008
    on_top, beside = (np.abs(command[:, 0]) < 0.03) & (command[:, 2] < 0), stamps > 2.1
    force[on_top, 2] = -2500.0 * command[on_top, 2]
    pressed = beside & (command[:, 0] < side)
    force[pressed, 0] = 2500.0 * (side - command[pressed, 0])
    stood[on_top, 2], stood[pressed, 0] = -COMPLIANCE * force[on_top, 2], side
    stood[pressed, 0] -= COMPLIANCE * force[pressed, 0]
    stood[:, 2] += LONG  # the peg's frame is at its upper end
    command[:, 2] += LONG
    rng = np.random.default_rng(rate)
    stood[:, :3] += rng.normal(0.0, 3e-5, (len(stamps), 3))
    wrench = np.concatenate([force + rng.normal(0.0, 0.05, force.shape), np.zeros_like(force)], axis=1)
    probe = Probe("pressing", stamps, command, np.full(6, 2500.0), np.full(6, 100.0), stamps)
    guess = Guess(np.array([0.0, 0, 0, 1, 0, 0, 0]), np.full(3, 0.003), 0.02, 0.02)
    whole = Measurement(ProbeWindow(probe, 0, len(stamps)), Touch(stamps, wrench, stood))
    return Recording(block((0.06, 0.06, HIGH)), guess, [whole], peg=box_peg(0.016, LONG))


def cut(recording: Recording, length: int) -> Recording:
    """The same in windows of so many stamps."""
    action, touch = recording.measurements[0].action, recording.measurements[0].observation
    windows = []
    for first in range(0, len(touch.times), length):
        rows = slice(first, min(first + length, len(touch.times)))
        own = Touch(touch.times[rows], touch.wrench[rows], touch.world_from_peg[rows])
        windows.append(Measurement(ProbeWindow(action.probe, rows.start, rows.stop), own))
    return replace(recording, measurements=windows)


def values_of(recording: Recording, model: Model = PERFECT) -> tuple[Any, list[tuple[Any, Tensor]]]:
    """The likelihood, and each value with its action, as a filter comes by them."""
    scene = model.prepare(recording)
    steps = observations_of(model, scene, recording.measurements)
    values = [(each.args[1][-1], value) for each in steps for value in each.observations.values()]
    return scene.likelihoods["window"], values


def log_likelihood(recording: Recording, pose: Tensor, forget: bool = False) -> Tensor:
    sensor, values = values_of(recording)
    total = pose.new_zeros(len(pose))
    for action, value in values:
        if forget:
            value = value[(value[:, GIVEN] != 1.0).nonzero()[:, 0]]
        total = total + sensor.site(action, pose).log_prob(value)
    return total


@pytest.mark.long
@pytest.mark.parametrize("rate", [20, 50, 100, 500])
def test_the_likelihood_does_not_depend_on_how_a_probe_is_cut(rate: int) -> None:
    pose = around(20, 0, 5e-5, 1e-3)
    whole = log_likelihood(probed(rate), pose)
    for length in (1, rate // 10, rate // 2, rate):
        torch.testing.assert_close(
            log_likelihood(cut(probed(rate), length), pose), whole, rtol=1e-9, atol=1e-6
        )
    forgetful = log_likelihood(cut(probed(rate), rate // 2), pose, forget=True)
    assert float((forgetful - whole).abs().max()) > 1e-2, "a mutant that forgets the earlier windows"


def information_at(rate: int) -> Tensor:
    sensor, values = values_of(probed(rate))
    pose = poses.identity(1)
    every = sum((sensor.site(action, pose).quadratic(value).information[0] for action, value in values))
    assert isinstance(every, Tensor)
    return every


def test_stamps_at_other_rates_inform_nearly_as_much() -> None:
    usual = information_at(100)[[2, 0], [2, 0]].sqrt()
    assert bool((usual > 1 / 1e-4).all()), (
        "the top and the side are known to less than a tenth of a millimetre"
    )
    for rate in (50, 200, 500, 2000):
        ratio = information_at(rate)[[2, 0], [2, 0]].sqrt() / usual
        assert bool(((ratio > 0.5) & (ratio < 2.0)).all()), (rate, ratio)


@functools.cache
def swung(mass: float) -> Recording:
    """A tool of so many kilograms that is moved to and fro by 80 mm, 30 mm above the block, in 2 s."""
    recording, times = probed(100), np.arange(0.0, 2.0, 0.02)
    command = np.tile(poses.identity().numpy(), (len(times), 1))
    command[:, 0], command[:, 2] = 0.04 * (1.0 - np.cos(2.0 * np.pi * np.clip(times - 0.3, 0.0, 1.5))), 0.08
    stiffness, damping = np.array([2500.0] * 3 + [150.0] * 3), np.array([120.0] * 3 + [2.5] * 3)
    probe = Probe("swung", times, command, stiffness, damping, np.arange(0.0, 1.98, 0.01))
    physics = PegPhysics(recording.part, recording.peg, ContactParameters(tool_mass=mass))
    rollout = physics.start(poses.identity(1), probe).advance(len(probe.stamps))
    touch = Touch(probe.stamps, rollout.wrench[0], rollout.world_from_peg[0])
    return replace(recording, measurements=[Measurement(ProbeWindow(probe, 0, len(probe.stamps)), touch)])


@pytest.mark.parametrize("mass", [0.2, 2.0, 5.0])
def test_a_tool_of_stated_mass_is_not_felt_where_it_accelerates(mass: float) -> None:
    counts = {}
    for stated in (None, mass):
        _, values = values_of(swung(mass), look_and_touch.model.with_settings(tool_mass=stated))
        rows = torch.cat([new_rows(value) for _, value in values])
        counts[stated] = int((rows[:, FELT] == 1.0).sum())
    assert counts == {None: counts[None], mass: 0}
    assert (counts[None] > 10) == (mass > 1.0)


@pytest.mark.parametrize("profile", ["perfect", "ur5e"])
def test_a_tap_of_forty_milliseconds_is_used_at_every_rate(profile: str) -> None:
    """Also where the wrench may be late: the peg's own stop is not taken for what stopped it."""
    for rate in (50, 100, 500, 2000):
        _, values = values_of(probed(rate), look_and_touch.model.with_settings(profile=profile))
        rows = torch.cat([new_rows(value) for _, value in values])
        tap = rows[(rows[:, 10] > 0.45) & (rows[:, 10] < 0.55)]
        assert float((tap[:, 7] == 1.0).sum()) >= 1, rate
        assert len(rows) < 120, "rows are as many as their time is worth"


@pytest.mark.parametrize("delays", [(), (0.01, 0.02)])
def test_a_cell_without_stamps_has_no_rows(delays: tuple[float, ...]) -> None:
    rows = EpisodeExtractor(ContactDetector(), 0.01, delays).rows(
        np.empty(0), np.empty((0, 7)), np.empty((0, 6)), True
    )
    assert len(rows.felt) == 0 and rows.earlier.shape == (0, len(delays), 7)


class _Hasty(EpisodeExtractor):
    """Mutant: a stamp is decided at once, before what surrounds it is known."""

    @property
    def _lag(self) -> float:
        return 0.0


def test_rows_do_not_depend_on_later_stamps_and_those_of_a_mutant_do() -> None:
    recording = probed(100)
    touch, stamps = recording.measurements[0].observation, recording.measurements[0].action.probe.stamps
    changed = touch.wrench.copy()
    changed[250:, :3] += 30.0

    def rows(kind: type[EpisodeExtractor], wrench: Array, last: int) -> Rows:
        """Those of the first 2.5 s, where the probe is known up to stamp `last`."""
        extractor = kind(ContactDetector(), 0.01)
        extractor.rows(stamps[:200], touch.world_from_peg[:200], wrench[:200, :3], False)
        every = extractor.rows(stamps[:last], touch.world_from_peg[:last], wrench[:last, :3], False)
        early = every.time < 2.475
        return Rows(*(column[early] for column in every))

    right = rows(EpisodeExtractor, touch.wrench, 300)
    assert len(right.time) > 5 and bool((right.felt == 1.0).any())
    for last in (250, 260, 300):
        for each, other in zip(rows(EpisodeExtractor, changed, last), right, strict=True):
            np.testing.assert_array_equal(each[:-1], other[: len(each) - 1])
    hasty = [rows(_Hasty, touch.wrench, last) for last in (247, 300)]
    assert len(hasty[0].time) != len(hasty[1].time) or not np.array_equal(hasty[0].speed, hasty[1].speed)


# ---------------------------------------------------------------- deferred and repeated measurements


@pytest.mark.long
def test_fine_windows_give_the_belief_of_coarse_ones_to_the_bit_and_steps_for_all() -> None:
    coarse, fine = (
        list(infer(look_and_touch.model, cut(probed(50), length), particles=6, seed=1)) for length in (25, 1)
    )
    assert len(fine) == 151 and len(coarse) == 7
    assert torch.equal(fine[-1].belief.world_from_part, coarse[-1].belief.world_from_part)
    assert fine[-1].info.log_evidence == coarse[-1].info.log_evidence
    assert fine[30].population is fine[25].population, "nothing is known before a cell ends"
    resumed = infer(look_and_touch.model, cut(probed(50), 1), particles=6, seed=1, start=fine[40])
    *_, last = resumed
    assert torch.equal(last.belief.world_from_part, fine[-1].belief.world_from_part)


@pytest.mark.long
def test_a_window_given_twice_counts_once_and_is_named() -> None:
    once = cut(probed(100), 50)
    twice = replace(once, measurements=[*once.measurements[:3], *once.measurements[2:]])
    assert repeated(twice) == {3: 2}
    with pytest.warns(RuntimeWarning, match="measurement 3 repeats measurement 2"):
        *_, last = infer(look_and_touch.model, twice, particles=6, seed=2)
    *_, other = infer(look_and_touch.model, once, particles=6, seed=2)
    assert last.taken == 6 and torch.equal(last.belief.world_from_part, other.belief.world_from_part)
    # Windows that overlap are no repeats; stamps that were measured before are left out.
    action, touch = probed(100).measurements[0].action, probed(100).measurements[0].observation

    def window(first: int, last: int) -> Measurement:
        own = Touch(touch.times[first:last], touch.wrench[first:last], touch.world_from_peg[first:last])
        return Measurement(ProbeWindow(action.probe, first, last), own)

    overlapping = replace(once, measurements=[window(0, 120), window(80, 220), window(150, 300)])
    pose = around(10, 0, 5e-5, 1e-3)
    torch.testing.assert_close(
        log_likelihood(overlapping, pose), log_likelihood(once, pose), rtol=1e-9, atol=1e-6
    )


def test_a_couple_presses_a_peg_no_harder() -> None:
    """How deep a peg that leans in a hole is in the walls goes by the force on it, not by the torque."""
    recording = probed(100)
    (whole,) = recording.measurements
    levered = whole.observation.wrench.copy()
    levered[50:, 3] += 0.6
    touch = replace(whole.observation, wrench=levered)
    loads = []
    for each in (recording, replace(recording, measurements=[Measurement(whole.action, touch)])):
        rows = new_rows(values_of(each)[1][-1][1])
        loads.append(rows[rows[:, FELT] == 1.0])
    plain, other = loads
    torch.testing.assert_close(plain[:, TIME], other[:, TIME])
    torch.testing.assert_close(plain[:, FORCE], other[:, FORCE])
    torch.testing.assert_close(other[:, FORCE], other[:, WRENCH][:, :3].norm(dim=1), rtol=0.02, atol=0.02)
    assert float((other[:, WRENCH] - plain[:, WRENCH])[:, 3].median()) == pytest.approx(0.6, abs=0.01)
