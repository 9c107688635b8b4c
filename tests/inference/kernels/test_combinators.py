"""Combinations of kernels, and sweeps of a population: invariance, bookkeeping, and when to stop."""

from __future__ import annotations

import math
from collections.abc import Callable

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.distributions.poses import NormalPose, UniformPose
from bcppl.errors import InputError
from bcppl.inference.kernels import (
    Kernel,
    Move,
    cycle,
    displacement,
    metropolis_hastings,
    mixture,
    moved_by,
    repeat,
    sequence,
    until,
)
from bcppl.inference.kernels.kernel import scattered
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.poses import Freedom, identity, retract
from bcppl.traces import Trace, simulate
from tests.invariance import largest_z

DRAWS = 20_000
SOUND, BROKEN = 4.5, 8.0  # |z| of the worst expectation: below if invariant, above if not


def lopsided() -> None:
    """A law on the half line: what favours one side shows at once."""
    pyro.sample("x", dist.Gamma(torch.tensor(2.0, dtype=torch.float64), 1.0))


def short(trace: Trace) -> None:
    pyro.sample("x", dist.LogNormal(trace["x"].log(), 0.3))


def fresh(trace: Trace) -> None:
    pyro.sample("x", dist.Exponential(torch.full((len(trace),), 0.4, dtype=torch.float64)))


def worst_z(kernel: Kernel, times: int = 2) -> float:
    """The largest |z| of the change in some expectations from exact draws."""
    torch.manual_seed(1)
    trace = simulate(lopsided, (), DRAWS)

    def functions(trace: Trace) -> Tensor:
        x = trace["x"]
        return torch.stack([x, x**2, x.log(), (x > 2.0).double()], dim=1)

    before = functions(trace)
    move = kernel(Population(trace[:500]))
    for _ in range(times):
        trace, _ = move(trace, POSTERIOR)
    return largest_z(before, functions(trace))


SHORT, FRESH = metropolis_hastings(short), metropolis_hastings(fresh)

COMBINED: dict[str, Kernel] = {
    "sequence": sequence(SHORT, FRESH),
    "cycle": cycle(SHORT, FRESH, SHORT),
    "mixture": mixture([SHORT, FRESH], weights=[1.0, 3.0]),
    "repeat": repeat(SHORT, 3),
    "nested": mixture([cycle(SHORT, repeat(FRESH, 2)), sequence(FRESH)]),
}


@pytest.mark.parametrize("name", COMBINED)
def test_combinations_are_invariant(name: str) -> None:
    assert worst_z(COMBINED[name]) < SOUND


def test_mutant_mixture_that_chooses_by_where_a_particle_is() -> None:
    def choosy(population: Population) -> Move:
        moves = [SHORT(population), FRESH(population)]

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            for k, each in enumerate(moves):
                index = ((trace["x"] > 2.0) == bool(k)).nonzero().flatten()
                moved, _ = each(trace[index], target)
                trace = scattered(trace, index, moved)
            return trace, torch.zeros(len(trace), dtype=torch.float64)

        return move

    assert worst_z(choosy) > BROKEN


# ---- bookkeeping


def adding(step: float, share: float, seen: list[Tensor]) -> Kernel:
    """No valid kernel: adds a number to x, returns a given share as accepted, and records its populations."""

    def fitted(population: Population) -> Move:
        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            seen.append(trace["x"])
            return trace.at({"x": trace["x"] + step}), torch.full((len(trace),), share, dtype=torch.float64)

        return move

    return fitted


def moves_of(kernel: Kernel, count: int = 4000) -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    trace = simulate(lopsided, (), count)
    moved, accepted = kernel(Population(trace))(trace, POSTERIOR)
    return moved["x"] - trace["x"], accepted


def mapping(function: Callable[[Tensor], Tensor]) -> Kernel:
    """No valid kernel: maps x."""
    return lambda population: (
        lambda trace, target: (
            trace.at({"x": function(trace["x"])}),
            torch.ones(len(trace), dtype=torch.float64),
        )
    )


def test_sequence_keeps_its_order_and_cycle_draws_one_for_each_particle() -> None:
    torch.manual_seed(0)
    trace = simulate(lopsided, (), 4000)
    steps = [mapping(lambda x: x + 1.0), mapping(lambda x: 3.0 * x), mapping(lambda x: x.square())]

    def offsets(combine: Callable[..., Kernel]) -> list[float]:
        still = trace.at({"x": torch.zeros_like(trace["x"])})
        moved, _ = combine(*steps)(Population(still))(still, POSTERIOR)
        return moved["x"].tolist()

    assert set(offsets(sequence)) == {9.0}
    drawn = offsets(cycle)
    # Three of the six orders end at 1, two at 3, one at 9.
    assert [drawn.count(each) / 4000 for each in (1.0, 3.0, 9.0)] == pytest.approx(
        [1 / 2, 1 / 3, 1 / 6], abs=0.04
    )


@pytest.mark.parametrize("combine", [lambda k: repeat(k, 3), lambda k: sequence(k, FRESH, k)])
def test_a_kernel_that_comes_again_is_fitted_once(combine: Callable[[Kernel], Kernel]) -> None:
    fits: list[Population] = []

    def counted(population: Population) -> Move:
        fits.append(population)
        return SHORT(population)

    combine(counted)(Population(simulate(lopsided, (), 10)))
    assert len(fits) == 1


def test_acceptance_is_the_mean_over_what_was_tried() -> None:
    one, two = adding(1.0, 1.0, []), adding(2.0, 0.25, [])
    for kernel in (sequence(one, two), cycle(one, two)):
        difference, accepted = moves_of(kernel)
        torch.testing.assert_close(difference, torch.full_like(difference, 3.0))
        assert bool((accepted == 0.625).all())
    difference, accepted = moves_of(repeat(two, 3))
    torch.testing.assert_close(difference, torch.full_like(difference, 6.0))
    assert bool((accepted == 0.25).all())


def test_mixture_draws_for_each_particle_and_puts_it_back_in_its_place() -> None:
    seen: list[Tensor] = []
    difference, accepted = moves_of(
        mixture([adding(1.0, 1.0, seen), adding(2.0, 0.25, seen)], weights=[1.0, 3.0])
    )
    share = float((difference.round() == 1.0).double().mean())
    assert share == pytest.approx(0.25, abs=0.03)
    assert torch.equal(accepted, torch.where(difference.round() == 1.0, 1.0, 0.25).double())
    assert sum(len(x) for x in seen) == 4000, "a kernel moves only the particles that drew it"
    never, _ = moves_of(mixture([adding(1.0, 1.0, []), adding(2.0, 1.0, [])], weights=[0.0, 5.0]))
    assert bool((never.round() == 2.0).all())


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: repeat(SHORT, 0), "repeated 0 times"),
        (lambda: repeat(SHORT, -2), "repeated -2 times"),
        (lambda: mixture([SHORT, FRESH], weights=[1.0]), "for 2 kernels"),
        (lambda: mixture([SHORT, FRESH], weights=[1.0, -1.0]), "0 or more"),
        (lambda: mixture([SHORT], weights=[0.0]), "not all of them 0"),
        (lambda: mixture([]), "no kernel"),
        (lambda: sequence(), "no kernel"),
        (lambda: cycle(), "no kernel"),
        (lambda: until(), "given no criterion"),
        (lambda: until(distinct=0), "0 distinct"),
        (lambda: until(displacement=2.5), "2.5 variances"),
        (lambda: until(distinct=3, most=0), "0 sweeps"),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        make()


# ---- sweeps


def copies(count: int, ancestors: int) -> Population:
    trace = simulate(lopsided, (), ancestors)
    return Population(trace[torch.arange(count) % ancestors])


def counted(kernel: Kernel) -> tuple[Kernel, list[int]]:
    calls: list[int] = []

    def fitted(population: Population) -> Move:
        calls.append(len(population))
        return kernel(population)

    return fitted, calls


def test_sweeps_until_particles_differ() -> None:
    torch.manual_seed(3)
    population = copies(40, 4)
    assert population.distinct == 4
    kernel, calls = counted(SHORT)
    done = moved_by(population, kernel, POSTERIOR, until(distinct=30)).population
    assert done.distinct >= 30
    assert 2 <= len(calls) <= 20
    calls.clear()
    assert moved_by(done, kernel, POSTERIOR, until(distinct=30)).population is done
    assert not calls, "far enough already"


def test_sweeps_until_particles_differ_in_what_is_named() -> None:
    def program() -> None:
        pyro.sample("x", dist.Normal(torch.tensor(0.0).double(), 1.0))
        pyro.sample("y", dist.Normal(torch.tensor(0.0).double(), 1.0))

    torch.manual_seed(6)
    trace = simulate(program, (), 40)
    population = Population(trace.at({"x": trace["x"][:1].expand(40)}))
    assert population.distinct == 40
    assert [population.distinct_in(names) for names in (("x",), ("y",), ("x", "y"))] == [1, 40, 40]
    for of, least in (((), 1), (("x",), 35)):
        kernel = metropolis_hastings(drift("y"))
        rest = moved_by(population, kernel, POSTERIOR, until(distinct=35, of=of, most=3)).population
        assert (rest is population) == (not of), "only what is named is waited for"
        done = moved_by(
            population, sequence([kernel, SHORT]), POSTERIOR, until(distinct=35, of=of)
        ).population
        assert done.distinct_in(("x",)) >= least


def test_sweeps_until_the_start_is_left_behind_and_no_longer_than_allowed() -> None:
    torch.manual_seed(4)
    population = copies(200, 200)
    kernel, calls = counted(SHORT)
    done = moved_by(population, kernel, POSTERIOR, until(displacement=0.5)).population
    assert float(displacement(population, done)) >= 0.5
    x, y = population.trace["x"], done.trace["x"]
    share = (y - x).square().mean() / y.var(correction=0)
    assert float(displacement(population, done)) == pytest.approx(float(share))
    assert not len(displacement(population, done, ("elsewhere",))), "what is not named does not count"
    calls.clear()
    tiny = metropolis_hastings(drift("x", (1e-5, 1e-4)))
    moved_by(population, counted(tiny)[0], POSTERIOR, until(displacement=0.5, most=2))
    kernel, calls = counted(tiny)
    moved_by(population, kernel, POSTERIOR, until(displacement=0.5, most=2))
    assert len(calls) == 4, "two sweeps of two halves"


def test_displacement_is_asked_for_on_every_free_axis() -> None:
    def program() -> None:
        pyro.sample("pose", NormalPose(identity(), torch.tensor([0.1, 0.2, 0.5]), Freedom("xy", "z")))
        pyro.sample("which", dist.Bernoulli(torch.tensor(0.5)))

    torch.manual_seed(5)
    trace = simulate(program, (), 500)
    shifted = trace["pose"].clone()
    shifted[:, 1] += 0.2 * torch.randn(500, dtype=torch.float64)
    share = displacement(Population(trace), Population(trace.at({"pose": shifted})))
    assert share.shape == (3,)
    assert float(share[0]) == 0.0
    assert float(share[2]) == pytest.approx(0.0, abs=1e-12)
    assert 0.3 < float(share[1]) < 0.7


def test_displacement_of_a_free_yaw_is_not_that_across_the_cut() -> None:
    def program() -> None:
        pyro.sample("pose", UniformPose(identity(), 0.0, math.pi, "z"))

    torch.manual_seed(5)
    trace = simulate(program, (), 2000)
    turn = torch.zeros(2000, 6, dtype=torch.float64)
    turn[:, 5] = 0.15 * torch.randn(2000, dtype=torch.float64)
    moved = trace.at({"pose": retract(trace["pose"], turn)})
    (share,) = displacement(Population(trace), Population(moved))
    assert float(share) == pytest.approx(0.15**2 / (math.pi**2 / 3), rel=0.15)


def particle_by_particle(population: Population, kernel: Kernel) -> Population:
    """The mutant: each particle stops once it has come far enough itself."""
    trace = population.trace
    going = torch.arange(len(trace))
    move = kernel(population)
    for _ in range(30):
        moved, _ = move(trace[going], POSTERIOR)
        trace = scattered(trace, going, moved)
        going = ((trace["x"] - population.trace["x"]).abs() < 1.0).nonzero().flatten()
        if len(going) == 0:
            break
    return Population(trace)


@pytest.mark.long
def test_stopping_together_leaves_no_bias_that_shows_and_each_alone_does() -> None:
    """75 exact draws, moved until they have come half a variance: over 40 runs the mean stays."""
    torch.manual_seed(6)
    together, alone = [], []
    for _ in range(40):
        population = Population(simulate(lopsided, (), 75))
        done = moved_by(population, SHORT, POSTERIOR, until(displacement=0.5)).population
        together.append(done.trace["x"].mean() - 2.0)
        alone.append(particle_by_particle(population, SHORT).trace["x"].mean() - 2.0)

    def z(errors: list[Tensor]) -> float:
        error = torch.stack(errors)
        return float(error.mean() / error.std() * math.sqrt(len(error)))

    assert abs(z(together)) < SOUND
    assert abs(z(alone)) > BROKEN


def test_no_sweeps_leave_a_population_as_it_is_and_fewer_are_refused() -> None:
    population = copies(8, 8)
    done = moved_by(population, SHORT, POSTERIOR, 0)
    assert done.population is population
    assert math.isnan(done.acceptance)
    with pytest.raises(InputError, match="-1 times"):
        moved_by(population, SHORT, POSTERIOR, -1)


def test_a_half_without_weight_teaches_all_the_same() -> None:
    torch.manual_seed(7)

    def program() -> None:
        pyro.sample("x", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))

    trace = simulate(program, (), 20)
    log_weights = torch.full((20,), -torch.inf, dtype=torch.float64)
    log_weights[3] = 0.0
    done = moved_by(Population(trace, log_weights), metropolis_hastings(drift("x")), POSTERIOR, 5)
    assert done.acceptance > 0.0
    assert torch.equal(done.population.log_weights, log_weights)
