"""Halves of a population, split by ancestry: what moves a particle was learned from none of its copies."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from importlib import import_module

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.inference import Population, markov_chains, replicate, resample, resize
from bcppl.inference.filters.smcp3 import Pair, move_and_weight
from bcppl.inference.filters.waste_free import waste_free_moves
from bcppl.inference.kernels import (
    Kernel,
    Move,
    composed,
    halved,
    halves,
    metropolis_hastings,
    moved_by,
    sequence,
)
from bcppl.inference.proposals import Fittable, drift, independent, prior
from bcppl.inference.resampling import systematic
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Trace, simulate

AXES = 20


def gaussian() -> None:
    pyro.sample("x", dist.Normal(torch.zeros(AXES, dtype=torch.float64), 1.0).to_event(1))


def with_copies(draws: int, copies: int) -> Population:
    """Exact draws, each of them several times."""
    return Population(simulate(gaussian, (), draws)[torch.arange(draws * copies) % draws])


def families_apart(population: Population) -> bool:
    """Whether no value is on both sides."""
    first, second = ({tuple(row) for row in population["x"][part].tolist()} for part in halves(population))
    return not first & second


def test_copies_are_of_one_half() -> None:
    for seed in range(20):
        torch.manual_seed(seed)
        population = halved(with_copies(9, 5))
        assert families_apart(population)
        assert 0.25 * 45 <= int(population.sides.sum()) <= 0.75 * 45


def test_descendants_are_on_their_ancestors_side() -> None:
    torch.manual_seed(0)
    start = halved(with_copies(40, 1).reweighed(0.5 * torch.randn(40, dtype=torch.float64)))
    side = dict(zip(start["x"][:, 0].tolist(), start.sides.tolist(), strict=True))
    for later in (resample(start), resize(start, 90), replicate(start, 3), start[torch.tensor([3, 3, 7])]):
        assert later.sides.tolist() == [side[x] for x in later["x"][:, 0].tolist()]
    move = metropolis_hastings(drift("x"))
    again = moved_by(resample(start), move, POSTERIOR, 5).population
    assert torch.equal(again.sides, start.sides[again.founders])
    whole = waste_free_moves(move, 10)(start, POSTERIOR).population
    assert torch.equal(whole.sides, start.sides[whole.founders])


def shifted(population: Population) -> Population:
    """Moved apart: values no longer show which particles are copies."""
    x = population["x"]
    return population.with_trace(population.trace.at({"x": x + 0.1 * torch.randn_like(x)}))


def sides_of(labels: Tensor, sides: Tensor) -> list[set[int]]:
    return [set(labels[side].tolist()) for side in (sides, ~sides)]


def test_a_population_that_leans_to_one_side_is_split_by_families() -> None:
    torch.manual_seed(1)
    start = halved(with_copies(60, 1))
    many, few = halves(start)
    ancestors = torch.cat([many.repeat(3), few[:2]])
    again = shifted(start).selected(ancestors)
    assert torch.equal(again.families[:, :1], start.families[ancestors])
    assert not set.intersection(*sides_of(again.families[:, 0], again.sides))
    assert 0.25 <= float(again.sides.double().mean()) <= 0.75


def test_few_families_are_split_by_copies_and_only_as_they_are_resampled() -> None:
    """Through many resamplings a half descends from several ancestors, and copies of one are never apart."""
    torch.manual_seed(3)
    population, split_again = halved(with_copies(75, 1)), 0
    for _ in range(30):
        before = population
        weighed = population.reweighed(torch.randn(75, dtype=torch.float64))
        ancestors = systematic(weighed.log_weights, 75)
        population = weighed.selected(ancestors)
        split_again += not torch.equal(population.sides, before.sides[ancestors])
        assert not set.intersection(*sides_of(ancestors, population.sides))
        assert min(len(families) for families in sides_of(population.families[:, 0], population.sides)) >= 4
        moved = halved(shifted(population))
        assert torch.equal(moved.sides, population.sides)
        population = moved
    assert 3 <= split_again <= 27


def test_a_family_that_grows_is_split_by_its_oldest_members_that_are_enough() -> None:
    """Those that were moved apart for longest are shared out; cousins stay on one side, as sisters do."""
    torch.manual_seed(4)
    start = halved(with_copies(200, 1))
    children = shifted(start).selected(torch.cat([torch.zeros(12, dtype=torch.int64), torch.arange(12, 200)]))
    pairs = torch.cat([torch.arange(12).repeat_interleave(2), torch.arange(24, 200)])
    grandchildren = shifted(children).selected(pairs)
    assert torch.equal(grandchildren.sides, children.sides[pairs])
    fours = torch.cat([torch.arange(24).repeat_interleave(4), torch.arange(96, 200)])
    most = shifted(grandchildren).selected(fours)
    assert not torch.equal(most.sides, grandchildren.sides[fours])
    assert not set.intersection(*sides_of(pairs[fours], most.sides))
    assert torch.equal(most.families, torch.stack([pairs[fours], fours], dim=1))


def test_a_single_family_is_split_by_values_and_equal_particles_are_not() -> None:
    torch.manual_seed(2)
    one = halved(with_copies(30, 1))[torch.full((30,), 4)]
    assert len(halves(halved(one))) == 1
    assert len(moved_by(one, metropolis_hastings(drift("x")), POSTERIOR, 2).population) == 30
    spread = one.with_trace(one.trace.at({"x": torch.randn(30, AXES, dtype=torch.float64)}))
    assert 0.25 * 30 <= int(halved(spread).sides.sum()) <= 0.75 * 30


def at_random(population: Population) -> Population:
    """The mutant: halves that ignore ancestry."""
    sides = torch.randperm(len(population)) < len(population) // 2
    return replace(population, sides=sides, families=torch.arange(len(population))[:, None])


def by_sweeps(population: Population, kernel: Kernel) -> Tensor:
    return moved_by(population, kernel, POSTERIOR, 3).population["x"]


def by_chains(population: Population, kernel: Kernel) -> Tensor:
    return markov_chains(kernel, population, 3, progress=False).trace["x"]


@pytest.mark.long
@pytest.mark.parametrize("mutated", [False, True])
@pytest.mark.parametrize("by", [by_sweeps, by_chains])
def test_moves_leave_exact_draws_with_copies_as_they_are(
    monkeypatch: pytest.MonkeyPatch, by: Callable[[Population, Kernel], Tensor], mutated: bool
) -> None:
    """A normal in 20 axes, learned from four copies of each of 60 draws: from their own, it draws them in."""
    if mutated:
        for home in ("bcppl.inference.kernels.rejuvenation", "bcppl.inference.kernels.halving"):
            monkeypatch.setattr(import_module(home), "halved", at_random)
    torch.manual_seed(3)
    changes = []
    for _ in range(30):
        population = with_copies(60, 4)
        after = by(population, metropolis_hastings(independent("x", 1)))
        changes.append((after.square() - population["x"].square()).mean())
    change = torch.stack(changes)
    z = float(change.mean() / (change.std() / math.sqrt(len(change))))
    assert z < -5.0 if mutated else abs(z) < 3.5


class Spied:
    """A random walk that records the values that it is fitted to, and those that it moves."""

    def __init__(self) -> None:
        self.learned: list[set[float]] = []
        self.moved: list[set[float]] = []
        self.proposal = Fittable(self.fit)

    def fit(self, population: Population) -> Callable[[Trace], None]:
        learned = set(population["x"][:, 0].tolist())

        def walk(trace: Trace) -> None:
            self.learned.append(learned)
            self.moved.append(set(trace["x"][:, 0].tolist()))
            pyro.sample("x", dist.Normal(trace["x"], 1e-9).to_event(1))

        return walk


def by_pair(population: Population, proposal: Fittable) -> None:
    move_and_weight(population, Pair(proposal, proposal))


def by_waste_free(population: Population, proposal: Fittable) -> None:
    waste_free_moves(metropolis_hastings(proposal), 10)(population, POSTERIOR)


def by_kernel(population: Population, proposal: Fittable) -> None:
    moved_by(population, metropolis_hastings(proposal), POSTERIOR, 1)


@pytest.mark.parametrize("by", [by_pair, by_waste_free, by_kernel])
def test_nothing_is_learned_from_copies(by: Callable[[Population, Fittable], None]) -> None:
    for seed in range(10):
        torch.manual_seed(seed)
        spied = Spied()
        by(with_copies(12, 5), spied.proposal)
        assert spied.moved
        for learned, values in zip(spied.learned, spied.moved, strict=True):
            assert not learned & values


def coins() -> None:
    pyro.sample("coin", dist.Categorical(torch.tensor([0.3, 0.7], dtype=torch.float64)))


@pytest.mark.long
def test_equal_discrete_values_are_no_copies() -> None:
    """A proposal fitted to the other half leaves the coin's probability as it is; halves by value do not."""

    def fit(population: Population) -> Callable[[Trace], None]:
        heads = (population["coin"].double().mean() + 0.5) / 2.0
        return lambda trace: pyro.sample("coin", dist.Categorical(torch.stack([1.0 - heads, heads])))

    torch.manual_seed(0)
    changes = []
    for _ in range(200):
        population = halved(Population(simulate(coins, (), 40)))
        assert abs(int(population.sides.sum()) - 20) <= 1
        moved_coins = moved_by(population, metropolis_hastings(Fittable(fit)), POSTERIOR, 1).population[
            "coin"
        ]
        changes.append((moved_coins - population["coin"]).double().mean())
    change = torch.stack(changes)
    assert abs(float(change.mean() / (change.std() / math.sqrt(len(change))))) < 3.5


def test_what_learns_nothing_moves_all_at_once_also_beside_what_learns() -> None:
    """In a sequence learners move halves, others all; particles keep their places, the law its shape."""
    calls: list[int] = []

    def fresh(trace: Trace) -> None:
        calls.append(len(trace))
        pyro.sample("x", dist.Normal(torch.zeros(len(trace)).double(), 2.0))

    def fitted_to(population: Population) -> Callable[[Trace], None]:
        scale = float(population["x"].std(correction=0))

        def walk(trace: Trace) -> None:
            calls.append(len(trace))
            pyro.sample("x", dist.Normal(trace["x"], 0.5 + scale))

        return walk

    def program() -> None:
        pyro.sample("tag", dist.Normal(torch.tensor(0.0).double(), 1.0))
        pyro.sample("x", dist.Normal(torch.tensor(0.0).double(), 1.0))

    drawn: list[int] = []

    def of(population: Population) -> Kernel:
        drawn.append(len(population))
        independent, walk = metropolis_hastings(fresh), metropolis_hastings(Fittable(fitted_to))
        return sequence(sequence(independent, walk), independent)

    torch.manual_seed(0)
    start = Population(simulate(program, (), 4000))
    done = moved_by(start, composed(of), POSTERIOR, 2)
    there_and_back = [4000, 4000]
    both_halves = [int(done.population.sides.sum())] * 2 + [int((~done.population.sides).sum())] * 2
    assert drawn == [4000, 4000]
    assert calls == [*there_and_back, *both_halves, *there_and_back] * 2
    assert torch.equal(done.population["tag"], start["tag"])
    x = done.population["x"]
    assert abs(float(x.mean())) < 4.5 / math.sqrt(4000)
    assert abs(float(x.var()) - 1.0) < 4.5 * math.sqrt(2.0 / 4000)
    assert 0.3 < done.acceptance < 0.8


def test_what_wraps_a_kernel_is_called_whatever_it_has_copied() -> None:
    """Marks are of the kernel that has them: `functools.wraps` copies attributes, and a class has its own."""
    inner, calls = sequence(metropolis_hastings(drift("x")), metropolis_hastings(prior("x"))), list[int]()

    @wraps(inner)
    def wrapped(population: Population) -> Move:
        calls.append(len(population))
        return inner(population)

    class Own:
        parts, of, learns = 3, "x", False

        def __call__(self, population: Population) -> Move:
            return wrapped(population)

    start = Population(simulate(gaussian, (), 40))
    for kernel in (wrapped, Own()):
        calls.clear()
        moved_by(start, kernel, POSTERIOR)
        assert sorted(calls) == [20, 20], "by halves, as of a kernel of which nothing is known"
