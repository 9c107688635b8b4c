"""A plate with equal holes: the camera does not inform which is seen, touching beside it does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pyro
import pytest
import torch
from pyro.distributions import Categorical

from bcppl import poses
from bcppl.cli import loading
from bcppl.contact.physics import PegPhysics
from bcppl.errors import InputError
from bcppl.geometry.extrusion import box_peg
from bcppl.inference import Population, structures
from bcppl.inference.structures import Strata
from bcppl.inference.summaries import probabilities
from bcppl.models import which_hole
from bcppl.models.worlds import which_hole as world
from bcppl.recordings import ProbeWindow
from bcppl.traces import Structure, extend, generate, structural, update


@pytest.mark.parametrize("seed", [0, 2])
def test_vision_leaves_it_open_and_each_touch_settles_one_half(seed: int) -> None:
    recording, true = world.simulate_recording(seed), world.which(seed)
    scene = which_hole.prepare(recording)
    empty, _ = generate(which_hole.which_hole, (scene, []), {}, 4)
    truth = torch.from_numpy(recording.truth).expand(4, 7).clone()
    trace = update(empty, {"which": torch.arange(4), "hole": truth}).trace
    values = scene.observed(recording.measurements)
    trace, _ = extend(trace, (scene, [m.action for m in recording.measurements]), values)
    assert float(trace.log_prob("depth_0").std()) < 0.01
    right = trace.log_prob(*[f"{kind}_{k}" for kind in ("contacts", "peg") for k in (1, 2)])
    behind = trace.log_prob(*[f"{kind}_{k}" for kind in ("contacts", "peg") for k in (3, 4)])
    for which in range(4):
        assert (right[true] - right[which] > 10.0) == (which % 2 != true % 2)
        assert (behind[true] - behind[which] > 10.0) == (which // 2 != true // 2)


def test_the_plate_s_pieces_are_its_mesh() -> None:
    """A pin is let into every hole and by nothing else: what is touched is what is seen."""
    plate, pin = world.plate(), box_peg(0.002, 0.03)
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(60, 2, generator=generator, dtype=torch.float64) * 0.09 - 0.03
    inside = (places[:, None] - torch.tensor(which_hole.HOLES)).abs().amax(dim=-1).amin(dim=-1)
    places, inside = places[(inside - 0.009).abs() > 0.0015], inside[(inside - 0.009).abs() > 0.0015] < 0.009
    over = poses.identity(len(places))
    over[:, :2], over[:, 2] = -places, -0.036
    recording = world.simulate_recording(0)
    action = recording.measurements[1].action
    assert isinstance(action, ProbeWindow)
    probe = action.probe
    command = probe.command[:2].copy()
    command[:, :3], command[:, 3:] = [[0, 0, 0.0], [0, 0, -0.012]], [1, 0, 0, 0]
    down = type(probe)(
        "down", probe.command_times[[0, 60]], command, probe.stiffness, probe.damping, probe.stamps[:60]
    )
    force = PegPhysics(plate, pin).start(over, down).advance(60).wrench[:, -1, 2]
    assert inside.sum() > 5 and ((force < 1.0) == inside.numpy()).all()


def test_it_is_offered_by_name_and_refuses_what_cannot_be_chosen_from() -> None:
    assert loading.model("which_hole") is which_hole.model
    with pytest.raises(InputError, match="two or more"):
        which_hole.prepare(world.simulate_recording(0), holes=[(0.0, 0.0)])
    recording = world.simulate_recording(0)
    for holes, message in [
        ([(0, 0), (34, 0)], r"hole 1 is at \[34.0, 0.0\], beside part .* give metres"),
        ([(0, 0), (float("nan"), 0)], "hole 1 is at .nan"),
        ([(0, 0), (0.034,)], "two or more"),
        ([(0, 0), (0.034, 0), (0.034, 0)], "none twice"),
    ]:
        with pytest.raises(InputError, match=message):
            which_hole.prepare(recording, holes=holes)


def test_strata_over_the_holes_agree_with_the_padded_program() -> None:
    """The same poses under each hole: the same densities, and the same posterior over holes."""
    recording, true = world.simulate_recording(0), world.which(0)
    scene = which_hole.prepare(recording)
    measurements = recording.measurements[:3]  # an image, and touches that settle one half
    args = (scene, [m.action for m in measurements])
    seen = scene.observed(measurements)

    def by_strata(scene: which_hole.PlateScene, actions: Sequence[Any]) -> None:
        which = structural("which", Categorical(torch.ones(len(scene.hole_from_part))))
        hole = pyro.sample("hole", scene.prior)
        part = poses.compose(hole, scene.hole_from_part[which])
        for number, action in enumerate(actions):
            scene.sensor(action).observe(number, action, part)

    torch.manual_seed(0)
    near = torch.from_numpy(recording.truth).expand(6, 7).clone()
    near[:, :3] += 2e-4 * torch.randn(6, 3, dtype=torch.float64)
    choices = {"which": torch.arange(4).repeat_interleave(6), "hole": near.repeat(4, 1)}
    padded, log_weights = generate(which_hole.which_hole, args, seen, 24, choices)
    population = Population(padded, log_weights)
    parts = []
    for which in range(4):
        structure = Structure({"which": which})
        trace, weights = generate(by_strata, args, {**seen, **structure.observations}, 6, {"hole": near})
        assert trace.structure == structure and "which" not in trace.choices
        torch.testing.assert_close(weights, log_weights[6 * which : 6 * which + 6])
        parts.append((structure, Population(trace, weights)))
    strata = Strata.of(parts, 0.0)
    share = structures.probabilities(strata, "which").probabilities
    torch.testing.assert_close(share, probabilities(population, "which").probabilities)
    assert float(share[true % 2 :: 2].sum()) > 0.99
    torch.testing.assert_close(strata.belief("hole").mean, population.belief("hole").mean)
