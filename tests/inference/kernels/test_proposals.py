"""Shipped proposals leave their target invariant, from exact draws; and mutants of theirs that do not."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.distributions.vectors import NormalMixture
from bcppl.errors import InputError
from bcppl.inference.kernels import metropolis_hastings, moved_by
from bcppl.inference.population import Population
from bcppl.inference.proposals import (
    Continuous,
    Fittable,
    Proposal,
    density,
    differences,
    differential_evolution,
    drift,
    independent,
    prior,
    program_of,
    rotations,
    symmetry,
)
from bcppl.inference.proposals.spread import weighted_places
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Trace, assess, propose, simulate
from tests.inference.kernels.exact_targets import (
    CENTER,
    bounded,
    correlated_draws,
    draws_of,
    edged,
    on_a_table,
    planar,
    two_modes,
    wide,
)
from tests.invariance import largest_z, matrix

DRAWS = 7_000
SOUND, BROKEN = 4.5, 8.0  # |z| of the worst of a few dozen expectations: below if invariant, above if not


def of_vectors(x: Tensor) -> Tensor:
    """Expectations (N, K) that are compared before and after."""
    x = x.reshape(len(x), -1).double()
    products = (x[:, :, None] * x[:, None, :]).flatten(1)
    return torch.cat([x, products, torch.sin(2 * x), torch.cos(3 * x)], dim=1)


def of_poses(pose: Tensor) -> Tensor:
    tangent = poses.local(CENTER, pose)
    angle = tangent[:, 3:].norm(dim=-1, keepdim=True)
    return torch.cat([of_vectors(tangent), torch.cos(angle), angle], dim=1)


def worst_z(
    exact: Callable[[int], Trace],
    proposal: Proposal,
    functions: dict[str, Callable[[Tensor], Tensor]],
    times: int = 2,
) -> float:
    """The largest |z| of the change in expectations over exact draws, after some moves.

    Each draw is compared with itself; what is fitted is fitted to draws of its own.
    """
    torch.manual_seed(1)
    move = metropolis_hastings(proposal)(Population(exact(30)))
    trace = exact(DRAWS)

    def all_of(trace: Trace) -> Tensor:
        return torch.cat([function(trace[address]) for address, function in functions.items()], dim=1)

    before = all_of(trace)
    for _ in range(times):
        trace, _ = move(trace, POSTERIOR)
    return largest_z(before, all_of(trace))


# ---- what is compared

POSE = {"pose": of_poses}
CASES: dict[str, tuple[Callable[[int], Trace], dict[str, Callable[[Tensor], Tensor]]]] = {
    "correlated": (correlated_draws, {"x": of_vectors}),
    "wide": (draws_of(wide), POSE),
    "planar": (draws_of(planar), POSE),
    "on a table": (draws_of(on_a_table), POSE),
    "edged": (draws_of(edged), POSE),
    "two modes": (draws_of(two_modes), POSE),
    **{
        name: (draws_of(bounded), {name: of_vectors}) for name in ("top", "below", "shares", "single", "each")
    },
}
LEARNING: dict[str, Callable[[str], Proposal]] = {
    "drift": lambda address: drift(address, (0.3, 1.5)),
    "normals": lambda address: independent(address, 2),
    "kernel density": lambda address: independent(address, None),
    "differences": lambda address: differential_evolution(address, jumps=0.3),
}


LEARNT = [(name, case) for name in LEARNING for case in CASES if case != "on a table"]
FEW = ("correlated", "two modes")  # a normal at each particle takes its time


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "case"), [(name, case) for name, case in LEARNT if name != "kernel density" or case in FEW]
)
def test_what_learns_from_particles_leaves_the_target_invariant(name: str, case: str) -> None:
    exact, functions = CASES[case]
    assert worst_z(exact, LEARNING[name](next(iter(functions))), functions) < SOUND


TURN = rotations(3, axis=(0.0, 1.0, 1.0), point=(0.05, 0.0, -0.02))
SYMMETRIES: dict[str, tuple[str, Any]] = {
    "one motion of three": ("wide", TURN[:1]),
    "four in the plane": ("on a table", rotations(4, point=(0.03, 0.01, 0.0))),
    "any turn": ("on a table", Continuous(point=(0.03, 0.01, 0.0))),
    "a screw": ("wide", Continuous((1.0, 0.0, 2.0), (0.0, 0.1, 0.0), turn=1.0, slide=0.1)),
    "near symmetry": ("two modes", poses.retract(poses.identity(1), matrix([[0.02, 0.04, 0, 0, 0, 1.6]]))),
}


@pytest.mark.parametrize("name", SYMMETRIES)
def test_symmetry_leaves_the_target_invariant(name: str) -> None:
    case, transforms = SYMMETRIES[name]
    exact, functions = CASES[case]
    assert worst_z(exact, symmetry("pose", transforms, spread=(0.02, 0.1)), functions) < SOUND


def choosing() -> None:
    """A discrete choice, a number that depends on it, and what is seen of it."""
    which = pyro.sample("which", dist.Categorical(matrix([0.2, 0.3, 0.5])))
    x = pyro.sample("x", dist.Normal(which.double(), 0.5))
    with pyro.plate("two", 2, dim=-2):
        z = pyro.sample("z", dist.Normal(x.expand(2, -1), 1.0))
    pyro.sample("y", dist.Normal(x + z.sum(0), 0.8))


@pytest.mark.parametrize("addresses", [("which",), ("z", "which"), ("x", "z", "which")])
def test_prior_leaves_the_target_invariant(addresses: tuple[str, ...]) -> None:
    functions: dict[str, Callable[[Tensor], Tensor]] = {
        "which": lambda k: torch.nn.functional.one_hot(k.long(), 3).double(),
        "x": of_vectors,
        "z": of_vectors,
    }
    assert worst_z(draws_of(choosing), prior(*addresses), functions) < SOUND


def test_prior_is_always_accepted_where_nothing_else_hangs_on_it() -> None:
    move = metropolis_hastings(prior("below", "top", "each"))(Population(simulate(bounded, (), 2)))
    _, accepted = move(simulate(bounded, (), 50), POSTERIOR)
    assert bool((accepted == 1.0).all())


def test_mutant_without_the_jacobian_of_a_bounded_value(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "bcppl.inference.proposals.coordinates.Unflattened.log_abs_det_jacobian",
        lambda self, x, y: torch.zeros(len(x), dtype=torch.float64),
    )
    for name in ("top", "shares", "each"):
        exact, functions = CASES[name]
        assert worst_z(exact, drift(name, (0.3, 1.5)), functions) > BROKEN


def test_mutant_without_the_haar_measure_in_the_mixture(monkeypatch: pytest.MonkeyPatch) -> None:
    class Flat(NormalPose):
        def log_prob(self, value: Tensor) -> Tensor:
            angle = poses.local(self.center, value)[..., 3:].norm(dim=-1)
            return super().log_prob(value) + self.freedom.log_base_density(angle)

    monkeypatch.setattr("bcppl.distributions.poses.normal.NormalPose", Flat)
    exact, functions = CASES["wide"]
    assert worst_z(exact, independent("pose", 1, inflation=1.2, wide=(0.2, 3.0)), functions) > BROKEN


@pytest.mark.parametrize("case", ["correlated", "wide"])
def test_mutant_that_forgets_the_way_back(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "bcppl.inference.kernels.hastings.assess",
        lambda program, args, choices, count: torch.zeros(count, dtype=torch.float64),
    )
    exact, functions = CASES[case]
    assert worst_z(exact, independent(next(iter(functions))), functions) > BROKEN


def test_mutant_that_steps_up_a_difference_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(differences, "DIFFERENCES", 1)
    exact, functions = CASES["correlated"]
    assert worst_z(exact, differential_evolution("x"), functions) < SOUND

    def upwards(self: Any, sample_shape: Any = torch.Size()) -> Tensor:
        ends = self.centers[:, 0]
        return ends + 0.01 * torch.randn_like(ends)

    monkeypatch.setattr(NormalMixture, "sample", upwards)
    assert worst_z(exact, differential_evolution("x"), functions) > BROKEN


@pytest.mark.long
def test_mutant_that_is_fitted_to_the_particles_it_moves() -> None:
    """Populations of four: halves that learn from each other keep the variance, all four from all do not."""

    def gaussian() -> None:
        pyro.sample("x", dist.Normal(torch.zeros(2, dtype=torch.float64), 1.0).to_event(1))

    kernel = metropolis_hastings(independent("x", 1, inflation=1.0, wide=(0.05, 3.0)))

    def change(own: bool, replicates: int = 150) -> float:
        torch.manual_seed(3)
        changes = []
        for _ in range(replicates):
            before = after = Population(simulate(gaussian, (), 4))
            for _ in range(3):
                if own:
                    after = Population(kernel(after)(after.trace, POSTERIOR)[0])
                else:
                    after = moved_by(after, kernel, POSTERIOR).population
            changes.append((after.trace["x"].square() - before.trace["x"].square()).mean())
        each = torch.stack(changes)
        return float(each.mean() / (each.std() / math.sqrt(replicates)))

    assert abs(change(own=False)) < SOUND
    assert abs(change(own=True)) > BROKEN


ROUND_TRIPS: dict[str, tuple[Proposal, str]] = {
    **{name: (make("pose"), "two modes") for name, make in LEARNING.items()},
    **{f"{name} in the plane": (make("pose"), "planar") for name, make in LEARNING.items()},
    **{f"{name} of shares": (make("shares"), "shares") for name, make in LEARNING.items()},
    **{name: (symmetry("pose", transforms), case) for name, (case, transforms) in SYMMETRIES.items()},
    "prior": (prior("below", "top", "each"), "top"),
}


@pytest.mark.parametrize("name", ROUND_TRIPS)
def test_a_way_there_has_the_density_that_assess_gives_it(name: str) -> None:
    proposal, case = ROUND_TRIPS[name]
    torch.manual_seed(0)
    exact = CASES[case][0]
    program = program_of(proposal, (), Population(exact(40)))
    trace = exact(30)
    there = propose(program, (trace,), 30)
    torch.testing.assert_close(assess(program, (trace,), there.choices, 30), there.log_prob)
    moved = trace.at({a: v for a, v in there.choices.items() if a in trace.choices})
    back = assess(
        program, (moved,), {**there.choices, **{a: trace[a] for a in moved.choices if a in there.choices}}, 30
    )
    assert bool(torch.isfinite(back).all())


def test_a_mixture_is_fitted_to_both_modes() -> None:
    torch.manual_seed(0)
    population = Population(simulate(two_modes, (), 200))
    program = program_of(independent("pose", 2, wide=(0.01, 3.0)), (), population)
    proposed = propose(program, (population.trace,), 200).choices["pose"]
    true = two_modes_density(proposed)
    assert float(true.exp().mean()) > 0.3 * float(two_modes_density(population.trace["pose"]).exp().mean())
    turned = poses.local(CENTER, proposed)[:, 5] > 0.8
    assert 0.2 < float(turned.double().mean()) < 0.4
    assert len(density._apart(weighted_places(population, "pose"), count=5)) == 5


def two_modes_density(pose: Tensor) -> Tensor:
    return simulate(two_modes, (), len(pose)).at({"pose": pose}).log_prob()


def test_whole_differences_lead_from_mode_to_mode() -> None:
    torch.manual_seed(0)
    population = Population(simulate(two_modes, (), 60))
    trace = simulate(two_modes, (), 2000)

    def turned(trace: Trace) -> Tensor:
        return poses.local(CENTER, trace["pose"])[:, 5] > 0.8

    def changed(jumps: float) -> float:
        move = metropolis_hastings(differential_evolution("pose", jumps=jumps))(population)
        return float((turned(move(trace, POSTERIOR)[0]) != turned(trace)).double().mean())

    assert changed(1.0) > 0.01 > changed(0.0)


@pytest.mark.parametrize(
    "make", [lambda a: drift(a), lambda a: independent(a), lambda a: differential_evolution(a)]
)
def test_discrete_and_unknown_addresses_are_refused(make: Callable[[str], Fittable]) -> None:
    population = Population(simulate(choosing, (), 8))
    with pytest.raises(InputError, match=r"'which' is discrete.*prior\('which'\)"):
        make("which").fit(population)
    with pytest.raises(InputError, match=r"'elsewhere'.*latent are which, x, z"):
        make("elsewhere").fit(population)


def test_a_support_without_coordinates_is_refused() -> None:
    def directions() -> None:
        pyro.sample("at", dist.ProjectedNormal(matrix([1.0, 0.0, 0.0])))

    with pytest.raises(InputError, match=r"'at'.*no unbounded coordinates"):
        drift("at").fit(Population(simulate(directions, (), 4)))


def test_symmetries_that_cannot_be_are_refused() -> None:
    trace = simulate(planar, (), 4)
    with pytest.raises(InputError, match="along an axis that is held"):
        propose(symmetry("pose", rotations(2, axis=(1.0, 0.0, 0.0))), (trace,), 4)
    for wrong in (lambda: rotations(1), lambda: symmetry("pose", torch.zeros(0, 7)), lambda: prior()):
        with pytest.raises(InputError):
            wrong()


def test_copies_of_one_particle_teach_what_they_can() -> None:
    trace = simulate(two_modes, (), 1)[[0] * 8]
    for name, make in LEARNING.items():
        done = moved_by(Population(trace), metropolis_hastings(make("pose")), POSTERIOR)
        assert bool(torch.isfinite(done.population.trace.log_prob()).all()), name
