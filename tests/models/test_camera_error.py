"""The camera-error model: its proposals are sound, and its belief holds the truth that a surer one misses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from bcppl import poses
from bcppl.distributions.depth import RobustDepth
from bcppl.errors import InputError
from bcppl.inference.filters.tempered_smc import infer
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.kernels.kernel import takes
from bcppl.inference.population import Population
from bcppl.inference.proposals import spread_of
from bcppl.inference.targets import Target
from bcppl.models import camera_error
from bcppl.models.worlds.two_cameras import WorldParameters, simulate_recording
from bcppl.sensors.measurements import Recording
from bcppl.traces import Trace, generate
from tests.invariance import largest_z

SOUND = 4.5  # |z| of the worst of a few dozen expectations, as in the tests of other proposals
# Without images the prior of all poses is the target, and draws of it are exact.
UNSEEN = Target({"depth_0": 0.0, "depth_1": 0.0})
INSTRUMENTS = ("camera_0", "camera_1")


@pytest.fixture(scope="module", params=[None, WorldParameters(tilt=0.0)], ids=["any tilt", "flat"])
def recording(request: pytest.FixtureRequest) -> Recording:
    """All axes free, or tilt held."""
    return simulate_recording(1, request.param)


def draws(recording: Recording, count: int) -> Trace:
    """Exact draws of part, biases and what the cameras see, before any image counts."""
    scene = camera_error.prepare(recording)
    arguments = scene, [m.action for m in recording.measurements]
    observed = scene.observed(recording.measurements)
    return generate(camera_error.camera_error, arguments, observed, particles=count)[0]


def expectations(trace: Trace) -> Tensor:
    """Of the part, of each seen pose relative to it, and of the biases, with their products (N, K)."""
    part = trace["part"]
    columns = [poses.local(trace.args[0].prior.center, part)]
    for name in INSTRUMENTS:
        columns += [
            100.0 * poses.local(part, trace[f"seen_by_{name}"]),
            500.0 * trace[f"bias_{name}"][:, None],
        ]
    x = torch.cat(columns, dim=1)
    x = x[:, x.std(dim=0) > 1e-9]
    return torch.cat([x, (x[:, :, None] * x[:, None, :]).flatten(1), torch.cos(2.0 * x)], dim=1)


@pytest.mark.long
@pytest.mark.parametrize("proposal", camera_error.model.proposals)
def test_proposals_leave_the_target_invariant(recording: Recording, proposal: Callable[..., None]) -> None:
    torch.manual_seed(2)
    teachers = Population(draws(recording, 40))
    learned = [lambda p: {f"seen_by_{n}": 0.02 * spread_of(f"seen_by_{n}")(p) for n in INSTRUMENTS}]
    move = metropolis_hastings(proposal, *(learned if takes(proposal, 2) else []))(teachers)
    before = after = draws(recording, 5_000)
    for _ in range(2):
        after, accepted = move(after, UNSEEN)
    assert largest_z(expectations(before), expectations(after)) < SOUND
    assert float(accepted.mean()) > 0.2


def test_the_part_is_drawn_from_its_conditional(recording: Recording) -> None:
    trace = draws(recording, 2_000)
    given = camera_error.conditional(trace, trace.choices)
    drawn = trace.at({"part": given.sample()})
    # Where the prior is flat, joint over conditional does not depend on the part.
    inside = torch.isfinite(drawn.log_prob("part"))
    seen = [f"seen_by_{name}" for name in INSTRUMENTS]
    change = drawn.log_prob(*seen) - given.log_prob(drawn["part"])
    change = change - (trace.log_prob(*seen) - given.log_prob(trace["part"]))
    assert float(inside.double().mean()) > 0.5
    assert float(change[inside].abs().mean()) < 0.1


def test_moving_the_part_alone_renders_nothing(recording: Recording) -> None:
    trace = draws(recording, 4)
    images = ["depth_0", "depth_1"]
    before = trace.log_prob(*images)
    rendered = trace.args[0].likelihoods["view"].renderer.effort.items
    assert rendered > 0
    moved = trace.at({"part": poses.retract(trace["part"], torch.full((4, 6), 1e-3, dtype=torch.float64))})
    assert moved.known.keys() >= set(images)
    assert bool((moved.log_prob(*images) == before).all())
    assert trace.args[0].likelihoods["view"].renderer.effort.items == rendered


def test_what_makes_no_scene_is_refused_in_a_sentence(recording: Recording) -> None:
    for settings, message in [
        ({"bias": 0.0}, "bias = 0.0; give a finite number above 0"),
        ({"camera_shift": -0.002}, "camera_shift = -0.002"),
        ({"bins": 0}, "bins = 0"),
    ]:
        with pytest.raises(InputError, match=message):
            camera_error.prepare(recording, **settings)
    away = recording.guess.world_from_part + np.array([0.0, 5.0, 0, 0, 0, 0, 0])
    with pytest.raises(InputError, match=r"cannot see part .* beside its image"):
        camera_error.prepare(replace(recording, guess=replace(recording.guess, world_from_part=away)))


def test_several_views_share_one_error() -> None:
    """A second view from the same place does not inform the error: the images are of one pose."""
    trace = draws(simulate_recording(1, WorldParameters(views=2)), 3)
    assert [a for a in trace.choices if a.startswith("seen_by")] == ["seen_by_camera_0", "seen_by_camera_1"]
    first, second = trace.distributions["depth_0"], trace.distributions["depth_1"]
    assert isinstance(first, RobustDepth)
    torch.testing.assert_close(first.pose, second.pose, rtol=0.0, atol=0.0)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_beliefs_hold_the_truth_and_are_as_wide_as_the_cameras_errors(seed: int) -> None:
    recording = simulate_recording(seed)
    *_, last = infer(camera_error.model, recording, seed=seed)
    belief = last.belief
    off = poses.local(belief.mean, torch.as_tensor(recording.truth))
    assert float(off @ torch.linalg.solve(belief.covariance, off)) < float(chi2.ppf(0.999, 6))
    # Two cameras of 2 mm, 0.5 degrees at half a metre and 2 mm of bias: 2 to 4 mm on each axis.
    assert bool(((belief.spread[:3] > 0.0015) & (belief.spread[:3] < 0.006)).all())
