"""The paper's program and the bench that simulates its recordings."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import torch

from bcppl.beliefs import Belief
from bcppl.cli import loading
from bcppl.errors import InputError
from bcppl.inference.design.rules import can_be_linearised
from bcppl.inference.filters import bayes_contact, guided_smc
from bcppl.inference.planning.metrology import three_two_one
from bcppl.models import grasped_peg, look_and_touch, peg_in_hole
from bcppl.models.worlds import peg_in_hole as world
from bcppl.recordings import Measurement, ProbeWindow, Recording, Touch
from bcppl.sensors.capabilities import Screens
from bcppl.sensors.likelihoods.simulated_probe import CONTACT
from bcppl.sensors.scene import Scene
from bcppl.traces import Trace, extend, generate, simulate, update
from tests import few_moves


@functools.cache
def recorded() -> Recording:
    return loading.recording("peg_probe")


@functools.cache
def scene() -> Scene:
    return peg_in_hole.prepare(recorded())


def constrained(poses: torch.Tensor, count: int = 14) -> Trace:
    """The program's trace for given poses (N, 7), given the first `count` measurements."""
    measurements = recorded().measurements[:count]
    values = scene().observed(measurements)
    empty, _ = generate(peg_in_hole.peg_in_hole, (scene(), []), {}, len(poses))
    moved = update(empty, {"hole": poses}).trace
    return extend(moved, (scene(), [m.action for m in measurements]), values)[0]


def test_inference_does_not_share_the_parameters_of_the_world() -> None:
    ours, theirs = CONTACT, world.CONTACT
    assert peg_in_hole.__file__ != world.__file__
    for name in ("time_step", "friction", "time_constant"):
        assert getattr(ours, name) != getattr(theirs, name), name
    assert theirs.time_step == 0.0005


def test_the_shipped_recording_is_the_bench_s_first() -> None:
    again = world.simulate_recording(0)
    shipped = recorded()
    np.testing.assert_allclose(again.truth, shipped.truth, atol=1e-12)
    for new, old in zip(again.measurements, shipped.measurements, strict=True):
        if isinstance(new.action, ProbeWindow):
            np.testing.assert_allclose(new.observation.wrench, old.observation.wrench, atol=1e-6)


def test_first_contact_comes_near_three_seconds_and_every_window_is_an_observation() -> None:
    values = scene().observed(recorded().measurements)
    felt = {
        a: bool(torch.isfinite(v).all(dim=-1).any()) for a, v in values.items() if a.startswith("contacts")
    }
    assert len(felt) == 12
    assert [felt[f"contacts_{k}"] for k in range(2, 7)] == [False] * 5
    assert all(felt[f"contacts_{k}"] for k in range(8, 14))


def test_the_truth_explains_the_probe_and_no_shifted_pose_does_better() -> None:
    """A row read early, a flipped sign or a swapped frame makes some wrong pose explain the probe better."""
    truth = torch.from_numpy(recorded().truth)
    shifts = torch.zeros(7, 7, dtype=torch.float64)
    for axis in range(3):
        shifts[1 + 2 * axis, axis], shifts[2 + 2 * axis, axis] = 0.003, -0.003
    trace = constrained(truth + shifts)
    sites = [a for a in trace.addresses if a.startswith(("contacts", "touch"))]
    score = trace.log_prob(*sites)
    assert (score[0] > score[1:] + 2.0).all(), score


def test_the_program_simulates_what_it_explains() -> None:
    torch.manual_seed(0)
    actions = [m.action for m in recorded().measurements[:10]]
    simulated = simulate(peg_in_hole.peg_in_hole, (scene(), actions), 2)
    values = {a: simulated[a][0] for a in simulated.addresses if a.startswith(("depth", "contacts", "touch"))}
    assert values["depth_0"].shape == scene().observed(recorded().measurements[:1])["depth_0"].shape
    assert (
        values["contacts_8"].shape == (50, 3)
        and values["touch_8"].shape == scene().observed(recorded().measurements)["touch_8"].shape
    )
    poses = simulated["hole"].clone()
    poses[1] = poses[0]
    poses[1, 2] += 0.01
    empty, _ = generate(peg_in_hole.peg_in_hole, (scene(), []), {}, 2)
    errors = {
        a: v[:1].expand_as(v) for a, v in simulated.choices.items() if a.startswith(("bias", "seen_by"))
    }
    _, weights = extend(update(empty, {"hole": poses}).trace, (scene(), actions), values, errors)
    assert weights[0] > weights[1] + 5.0


def test_windows_of_one_probe_share_one_rollout_per_particle() -> None:
    guess = torch.from_numpy(recorded().guess.world_from_part).expand(3, 7).clone()
    guess[:, 0] += torch.tensor([0.0, 0.002, -0.003])
    physics = scene().likelihoods["window"].efforts["physics"]
    begun = physics.copy()
    whole = constrained(guess)
    assert physics.since(begun).items == 3
    # Continued window by window and shuffled on the way, it is the same to the bit.
    pieces = constrained(guess, 9)[torch.tensor([2, 0, 1])]
    for count in range(10, 15):
        measurements = recorded().measurements[:count]
        values = scene().observed(measurements)
        new = {a: v for a, v in values.items() if a not in pieces}
        pieces, _ = extend(pieces, (scene(), [m.action for m in measurements]), new)
    sites = [a for a in whole.addresses if a.startswith("contacts")]
    for site in sites:
        assert torch.equal(pieces.log_prob(site), whole.log_prob(site)[[2, 0, 1]]), site


@pytest.mark.long
@pytest.mark.parametrize("infer", [few_moves.infer, bayes_contact.infer])
def test_same_seed_same_belief_to_the_bit(infer) -> None:  # type: ignore[no-untyped-def]
    short = dataclasses.replace(recorded(), measurements=recorded().measurements[:9])

    def last(seed: int) -> torch.Tensor:
        *_, step = infer(peg_in_hole.model, short, particles=8, seed=seed)
        return torch.cat([step.belief.world_from_part, step.belief.log_weights[:, None]], dim=1)

    first = last(5)
    torch.rand(3)
    assert torch.equal(first, last(5))
    assert not torch.equal(first, last(6))


@pytest.mark.long
def test_geometry_guides_and_physics_finds_the_hole() -> None:
    """On the shipped recording, to a millimetre or two; a run that is resumed goes on to the same bits."""
    *_, last = guided_smc.infer(peg_in_hole.model, recorded(), particles=20, seed=1)
    points = recorded().part.surface_points()
    assert last.belief.weighted_add(points, recorded().truth) < 0.003
    short = dataclasses.replace(recorded(), measurements=recorded().measurements[:10])
    steps = list(guided_smc.infer(peg_in_hole.model, short, particles=10, seed=2))
    *_, again = guided_smc.infer(peg_in_hole.model, short, particles=10, seed=2, start=steps[-2])
    assert torch.equal(steps[-1].belief.world_from_part, again.belief.world_from_part)
    assert torch.equal(steps[-1].belief.log_weights, again.belief.log_weights)


def test_what_is_explained_of_a_probe_is_a_setting() -> None:
    """Sites, latent parameters of the contact, and what is refused."""
    measurements, count = recorded().measurements[:9], 3
    given = {"evidence": ("contacts in time", "pose", "wrench"), "friction": (0.3, 0.4)}
    chosen = peg_in_hole.prepare(recorded(), **given)
    actions, values = [m.action for m in measurements], chosen.observed(measurements)
    torch.manual_seed(0)  # of these parts one at least is touched in the window
    trace, _ = generate(peg_in_hole.peg_in_hole, (chosen, actions), values, count)
    kinds = {address.split("_")[0] for address in trace.observations}
    assert kinds == {"depth", "contacts", "peg", "wrench"}
    assert "friction" in trace.choices and "time_constant" not in trace.choices
    assert values["wrench_8"].shape == (50, 6) and bool(torch.isfinite(trace.log_prob("wrench_8")).all())
    slippery = trace.at({"friction": torch.full((count,), 0.01, dtype=torch.float64)})
    assert not torch.equal(slippery.log_prob("wrench_8"), trace.log_prob("wrench_8"))
    for wrong in ((), ("force",), ("contacts", "contacts in time")):
        with pytest.raises(InputError, match="is explained by the evidence"):
            peg_in_hole.prepare(recorded(), evidence=wrong)
    with pytest.raises(InputError, match="friction = -1"):
        peg_in_hole.prepare(recorded(), friction=(-1.0, 0.3))


def at_rate(stride: int, name: str) -> Measurement:
    """All windows of the shipped probe as one, every so manyth of its 100 stamps a second kept."""
    windows = [m for m in recorded().measurements if isinstance(m.action, ProbeWindow)]
    probe, columns = windows[0].action.probe, ("times", "wrench", "world_from_peg")
    rows = [np.concatenate([getattr(m.observation, column) for m in windows])[::stride] for column in columns]
    return Measurement(
        ProbeWindow(dataclasses.replace(probe, name=name, stamps=rows[0]), 0, len(rows[0])), Touch(*rows)
    )


def test_probes_of_any_rate_are_explained_and_those_of_several() -> None:
    """The wrench's filter is of each probe's rate; slow probes, and those without contacts, have none."""
    slow = [at_rate(stride, f"every {stride}") for stride in (1, 2, 3, 10)]
    recording = dataclasses.replace(recorded(), measurements=slow)
    for module, settings in ((peg_in_hole, {}), (grasped_peg, {}), (peg_in_hole, {"evidence": ("gaps",)})):
        prepared = module.prepare(recording, **settings)
        sensings = [prepared.likelihoods["window"].sensing(m.action.probe) for m in slow]
        np.testing.assert_allclose([s.rate for s in sensings], [100.0, 50.0, 100.0 / 3.0, 10.0], rtol=1e-6)
        assert [s.cutoff for s in sensings] == ([None] * 4 if settings else [20.0, 20.0, None, None])
        values = prepared.observed(slow)
        touched = [bool(torch.isfinite(v).any()) for a, v in values.items() if a.startswith("contacts")]
        assert touched == ([] if settings else [True] * 4)
    trace, _ = generate(peg_in_hole.peg_in_hole, (prepared, [m.action for m in slow]), values, 2)
    assert bool(torch.isfinite(trace.log_prob(*values)).all())


def test_contact_locations_alone_have_no_geometry() -> None:
    blind = peg_in_hole.prepare(recorded(), evidence=("contacts",)).likelihoods["window"]
    assert not isinstance(blind, Screens) and isinstance(scene().likelihoods["window"], Screens)


@pytest.mark.long
@pytest.mark.parametrize("evidence", [("contacts", "pose"), ("contacts", "wrench"), ("gaps", "wrench")])
def test_geometry_guides_whatever_is_explained(evidence: tuple[str, ...]) -> None:
    """Where gaps are no evidence they only propose: their likelihood is not in the target."""
    short = dataclasses.replace(recorded(), measurements=recorded().measurements[:9])
    model = peg_in_hole.model.with_settings(evidence=evidence)
    *_, last = guided_smc.infer(model, short, particles=10, seed=2)
    trace = last.population.trace
    assert any(a.startswith("touch") for a in trace.addresses) == ("gaps" in evidence)
    assert bool(torch.isfinite(last.population.log_weights).all())


def test_probes_by_physics_are_ranked_by_reweighted_particles() -> None:
    """Contact locations have no quadratic approximation, though the gaps that guide the filter have one."""
    truth = torch.from_numpy(recorded().truth)
    certain = Belief(truth.expand(4, 7).clone(), torch.zeros(4, dtype=torch.float64))
    plan = three_two_one(certain, recorded().part, recorded().peg)
    assert not can_be_linearised(scene(), [plan])
    assert can_be_linearised(look_and_touch.prepare(recorded()), [plan])


def test_gaps_of_a_peg_that_may_be_off_in_the_hand_are_refused() -> None:
    with pytest.raises(InputError, match='name "pose" in place of "gaps"'):
        scene().likelihoods["window"].grasping(torch.zeros(2, 7))
