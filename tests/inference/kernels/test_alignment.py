"""Alignments: they find where a part is, they leave the posterior invariant, and their mutants do not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyro
import pytest
import torch
import trimesh
from torch import Tensor

from bcppl import poses
from bcppl.distributions.contact import ContactsInTime, PegPose
from bcppl.distributions.depth import LaplaceDepth, RobustDepth
from bcppl.distributions.poses import NormalPose, UniformPose
from bcppl.distributions.touch import OnsetLocation, Path
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.parts import Part
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import contact_alignment, depth_alignment, program_of
from bcppl.inference.proposals.proposal import Proposal
from bcppl.inference.targets import POSTERIOR
from bcppl.poses import Freedom
from bcppl.rendering.ray_casting import RayCaster
from bcppl.traces import Proposed, Trace, assess, propose, simulate
from tests.invariance import largest_z

DRAWS = 2000
SOUND, BROKEN = 4.5, 8.0  # |z| of the worst of a few dozen expectations: below if invariant, above if not


def matrix(rows: object) -> Tensor:
    return torch.as_tensor(rows, dtype=torch.float64)


# A corner of a box, at its frame's origin, fills the view with three faces: a coarse image's outline
# would say more than planes do.
BOX = trimesh.creation.box((0.3, 0.3, 0.3), trimesh.transformations.translation_matrix((-0.15, -0.15, -0.15)))
RENDERER = RayCaster(Part("box", np.asarray(BOX.vertices), np.asarray(BOX.faces, dtype=np.int64)))
DISTANCE = SignedDistance(RENDERER.part)
CAMERA = Camera(
    "above", 16, 12, 22.0, 22.0, 7.5, 5.5, looking_at((0.1, 0.1, 0.12), (0.0, 0.0, 0.0)), near=0.05, far=0.6
)
TABLE = np.full((12, 16), 0.4)
CENTER = poses.identity()
SPREAD = matrix([0.01, 0.01, 0.006, 0.1, 0.1, 0.2])
NOISE = 0.01
PLANAR = Freedom("xy", "z")


def seen(freedom: Freedom = poses.FREE) -> None:
    """A box near where it is thought to be, and one coarse depth image of it."""
    part = pyro.sample("part", NormalPose(CENTER, freedom.coordinates(SPREAD), freedom))
    pyro.sample("depth_0", RobustDepth(RENDERER, CAMERA, part, NOISE, background=TABLE))


def edged() -> None:
    part = pyro.sample("part", UniformPose(CENTER, (0.02, 0.02, 0.0), 0.3, rotation="z"))
    pyro.sample("depth_0", LaplaceDepth(RENDERER, CAMERA, part, NOISE))


def of_poses(pose: Tensor) -> Tensor:
    tangent = poses.local(CENTER, pose)
    tangent = torch.cat([100.0 * tangent[:, :3], 10.0 * tangent[:, 3:]], dim=1)
    return torch.cat(
        [tangent, (tangent[:, :, None] * tangent[:, None, :]).flatten(1), torch.sin(2 * tangent)], 1
    )


def worst_z(
    program: Callable[[], None], proposal: Proposal, functions: Callable[[Trace], Tensor], times: int = 2
) -> float:
    """The largest |z| of the change in expectations over exact draws of a pose with its own image."""
    torch.manual_seed(1)
    move = metropolis_hastings(proposal)(Population(simulate(program, (), 60)))
    trace = simulate(program, (), DRAWS)
    before = functions(trace)
    for _ in range(times):
        trace, accepted = move(trace, POSTERIOR)
        assert float(accepted.mean()) > 0.1, "hardly anything moved"
    return largest_z(before, functions(trace), still=1e-9)


def of_both(trace: Trace) -> Tensor:
    """Of the pose, and of how well it goes with the image: what is drawn towards the data goes too well."""
    image = trace["depth_0"].flatten(1)
    image = image.clamp(0.05, 0.3) - 0.18
    tangent = poses.local(CENTER, trace["part"])
    fit = trace.log_prob("depth_0")[:, None] / 100.0
    return torch.cat(
        [of_poses(trace["part"]), fit, fit**2, (image[:, ::17, None] * tangent[:, None]).flatten(1)], dim=1
    )


# The noise of `edged` is Laplace's.
DEPTH_CASES: dict[str, tuple[Callable[[], None], int]] = {
    "two steps": (seen, 2),
    "planar": (lambda: seen(PLANAR), 1),
    "edged": (edged, 1),
}


@pytest.mark.long
@pytest.mark.parametrize("case", DEPTH_CASES)
def test_depth_alignment_leaves_pose_and_image_invariant(case: str) -> None:
    program, steps = DEPTH_CASES[case]
    assert worst_z(program, depth_alignment("part", steps=steps), of_both, times=3 - steps) < SOUND


@pytest.mark.long
@pytest.mark.parametrize("case", ["robust", "finger"])
def test_mutant_recentred_on_the_data_without_its_way_back(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The way back taken to be as likely as the way there, as if a particle stepped out from where it was."""
    there: list[Tensor] = []

    def spied(*args: Any) -> Proposed:
        proposed = propose(*args)
        there.append(proposed.log_prob)
        return proposed

    monkeypatch.setattr("bcppl.inference.kernels.hastings.propose", spied)
    monkeypatch.setattr("bcppl.inference.kernels.hastings.assess", lambda *args: there[-1])
    program, proposal, functions = MUTANTS[case]
    assert worst_z(program, proposal, functions, times=4) > BROKEN


@pytest.mark.parametrize("case", DEPTH_CASES)
def test_a_way_there_has_the_density_that_assess_gives_it(case: str) -> None:
    torch.manual_seed(0)
    model, steps = DEPTH_CASES[case]
    trace = simulate(model, (), 40)
    program = program_of(depth_alignment("part", steps=steps), (), Population(trace))
    there = propose(program, (trace,), 40)
    torch.testing.assert_close(assess(program, (trace,), there.choices, 40), there.log_prob)
    back = assess(program, (trace.at(there.choices),), {"part": trace["part"]}, 40)
    assert bool(torch.isfinite(back).all())


def test_depth_alignment_finds_the_part() -> None:
    """Off by a spread, five moves that are all taken bring it to where the image says."""
    torch.manual_seed(0)
    trace = simulate(seen, (), 200)
    truth = trace["part"]
    trace = trace.at({"part": simulate(seen, (), 200)["part"]})
    points = 0.05 * torch.eye(3, dtype=torch.float64)

    def off(trace: Trace) -> float:
        apart = poses.transform(trace["part"], points) - poses.transform(truth, points)
        return float(apart.norm(dim=-1).mean(dim=-1).median())

    begun = off(trace)
    move = metropolis_hastings(depth_alignment("part"))(Population(trace))
    for _ in range(6):
        trace, _ = move(trace, POSTERIOR)
    assert off(trace) < 0.4 * begun


def test_depth_alignment_refuses_what_is_no_image_of_the_part() -> None:
    def beside() -> None:
        part = pyro.sample("part", NormalPose(CENTER, SPREAD))
        other = pyro.sample("other", NormalPose(CENTER, SPREAD))
        pyro.sample("depth_0", LaplaceDepth(RENDERER, CAMERA, other, NOISE))
        pyro.sample("felt", NormalPose(part, SPREAD))

    trace = simulate(beside, (), 3)
    for sites, message in (
        ("depth_*", "depends on another pose"),
        ("felt", "no depth image"),
        ("touch_*", "match no address"),
    ):
        program = program_of(depth_alignment("part", sites), (), Population(trace))
        with pytest.raises(InputError, match=message):
            propose(program, (trace,), 3)
    with pytest.raises(InputError, match="steps"):
        depth_alignment("part", steps=0)


# ---- contacts: a finger's tip, held by a spring, comes to rest on one of three faces of a corner

FACES = torch.eye(3, dtype=torch.float64).repeat(2, 1)  # outward normals in the part's frame
TIPS = matrix([[-0.04, -0.02, -0.01], [-0.03, -0.01, -0.03], [-0.04, -0.03, -0.01]])
AIMS = torch.cat([TIPS * (1 - torch.eye(3)), TIPS.flip(0) * (1 - torch.eye(3))]) - 0.004 * FACES


class Spring:
    """What `ProbeRollout` answers, of a tip that would go to AIMS[k] at stamp k and is kept outside."""

    def __init__(self, world_from_part: Tensor) -> None:
        self.inputs = (world_from_part,)
        self.diverged = torch.zeros(len(world_from_part), dtype=torch.bool)
        upward = FACES @ poses.rotation_matrix(world_from_part).mT
        depth = ((world_from_part[:, None, :3] - AIMS) * upward).sum(dim=-1)
        # The tip lies 10 mm below the peg's origin.
        self.peg = poses.identity(len(world_from_part), len(AIMS))
        self.peg[..., :3] = AIMS + depth.clamp(min=0.0)[..., None] * upward + 0.01 * FACES
        touching = (depth > 0.0)[..., None]
        self.contacts = torch.where(touching, -0.01 * FACES, torch.nan)
        self.upward = torch.where(touching, upward, torch.nan)

    def __len__(self) -> int:
        return len(self.diverged)

    def window(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        return self.contacts[:, first:last], self.peg[:, first:last]

    def contact_normals(self, first: int, last: int) -> Tensor:
        return self.upward[:, first:last]


def touched(freedom: Freedom = poses.FREE) -> None:
    part = pyro.sample("part", NormalPose(CENTER, freedom.coordinates(0.5 * SPREAD), freedom))
    track = Spring(part)
    pyro.sample("contacts_0", ContactsInTime(track, 0, 3, scale=0.002, every=1))
    pyro.sample("contacts_1", ContactsInTime(track, 3, 6, scale=0.002, every=1))
    pyro.sample("peg_1", PegPose(track, 0, 6, 0.002, 0.01, every=1))


def pushed() -> None:
    """Onsets of a finger that comes from outside, along lines through AIMS."""
    part = pyro.sample("part", NormalPose(CENTER, 0.5 * SPREAD))
    for k, (aim, face) in enumerate(zip(AIMS, FACES, strict=True)):
        path = Path(aim + face * torch.linspace(0.02, -0.02, 21, dtype=torch.float64)[:, None])
        pyro.sample(f"onset_{k}", OnsetLocation(DISTANCE, part, path, 0.0, 0.001, 0.01))


def of_touch(trace: Trace) -> Tensor:
    fits = [trace.log_prob(a) for a in trace.addresses if a != "part"]
    fit = (torch.stack(fits).sum(0) / 10.0).clamp(min=-20.0)[:, None]
    return torch.cat([of_poses(trace["part"]), fit, fit**2], dim=1)


CONTACT_CASES: dict[str, Callable[[], None]] = {
    "peg": touched,
    "peg in the plane": lambda: touched(PLANAR),
    "finger": pushed,
}


@pytest.mark.long
@pytest.mark.parametrize("case", CONTACT_CASES)
def test_contact_alignment_leaves_pose_and_touch_invariant(case: str) -> None:
    assert worst_z(CONTACT_CASES[case], contact_alignment("part"), of_touch) < SOUND


@pytest.mark.parametrize(("case", "gain"), [("peg", 0.2), ("peg in the plane", 0.2), ("finger", 0.8)])
def test_contact_alignment_brings_the_part_to_what_was_felt(
    case: str, gain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One step gains so much of how well the truth fits; stamps at which nothing touches tell it nothing."""
    monkeypatch.setattr("bcppl.inference.proposals.least_squares.WIDTHS", (1e-3, 1e-3, 1e-3))
    torch.manual_seed(0)
    program = CONTACT_CASES[case]
    trace = simulate(program, (), 300)
    off = trace.at({"part": simulate(program, (), 300)["part"]})
    step = program_of(contact_alignment("part"), (), Population(off))
    there = off.at({"part": propose(step, (off,), 300).choices["part"]})
    best, begun, reached = (float(of_touch(each)[:, -2].median()) for each in (trace, off, there))
    assert reached > begun + gain * (best - begun)


@pytest.mark.parametrize("case", CONTACT_CASES)
def test_contact_alignment_is_assessed_as_it_is_proposed(case: str) -> None:
    torch.manual_seed(0)
    trace = simulate(CONTACT_CASES[case], (), 40)
    program = program_of(contact_alignment("part"), (), Population(trace))
    there = propose(program, (trace,), 40)
    torch.testing.assert_close(assess(program, (trace,), there.choices, 40), there.log_prob)
    back = assess(program, (trace.at(there.choices),), {"part": trace["part"]}, 40)
    assert bool(torch.isfinite(back).all())


def test_contact_alignment_refuses_what_was_not_felt_of_the_part() -> None:
    trace = simulate(seen, (), 3)
    for sites, message in ((("depth_*",), "is a RobustDepth"), (("touch_*",), "match no address")):
        program = program_of(contact_alignment("part", sites), (), Population(trace))
        with pytest.raises(InputError, match=message):
            propose(program, (trace,), 3)
    with pytest.raises(InputError, match="reach"):
        contact_alignment("part", reach=0.0)


MUTANTS: dict[str, tuple[Callable[[], None], Proposal, Callable[[Trace], Tensor]]] = {
    "robust": (seen, depth_alignment("part"), of_both),
    "finger": (pushed, contact_alignment("part"), of_touch),
}
