"""Entropies of reweighted particles, and bad input of rankings."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief, entropy_of_modes
from bcppl.errors import InputError
from bcppl.inference.design import (
    EntropyOfWeights,
    Ranking,
    discrete_entropy,
    expected_information_gain,
    mixture_entropy,
    neighbour_entropy,
    weight_entropy,
)
from bcppl.inference.population import Population
from bcppl.poses import FREE, Freedom
from bcppl.traces import generate, simulate
from tests.inference.design.probing_programs import CENTER, PLANAR, at, doubled, particles
from tests.invariance import matrix


def some_weights(rows: int, count: int, sharpness: float = 1.0) -> Tensor:
    torch.manual_seed(7)
    return torch.softmax(sharpness * torch.randn(rows, count, dtype=torch.float64), dim=1)


@pytest.mark.parametrize("freedom", [FREE, PLANAR, Freedom("xyz", "none")])
def test_under_its_own_weights_a_belief_has_its_own_entropies(freedom: Freedom) -> None:
    population = particles(1500, freedom)
    # Weights of a Gaussian in one direction: far from even, and smooth.
    tilted = population.log_weights - 0.5 * ((population["part"][:, 0] - 0.1) / 0.002) ** 2
    belief = Belief(population["part"], tilted, freedom)
    even = torch.full((1, 1500), 1.0 / 1500, dtype=torch.float64)
    modes, near = mixture_entropy("part")(population), neighbour_entropy("part")(population)
    weights = torch.softmax(tilted, 0)[None]
    assert float(modes(even)) == pytest.approx(population.belief("part").gaussian_entropy, abs=0.01)
    assert float(modes(weights)) == pytest.approx(belief.gaussian_entropy, abs=0.02)
    assert float(near(even)) == pytest.approx(population.belief("part").nearest_neighbour_entropy(), abs=1e-9)
    assert float(near(weights)) == pytest.approx(belief.nearest_neighbour_entropy(), abs=0.15)


@pytest.mark.parametrize(
    "measure", [mixture_entropy("part"), neighbour_entropy("part"), mixture_entropy("part", 0.001, 0.01)]
)
def test_copies_count_once(measure: Any) -> None:
    population, weights = particles(300), some_weights(5, 300)
    turned = doubled(population)
    flipped = population["part"] * matrix([1, 1, 1, -1, -1, -1, -1])
    signs = at(torch.cat([population["part"], flipped]))
    twice = torch.cat([0.3 * weights, 0.7 * weights], dim=1)
    expected = measure(population)(weights)
    for copies in (turned, signs):
        torch.testing.assert_close(measure(copies)(twice), expected, atol=1e-9, rtol=0)
    assert not torch.allclose(weight_entropy()(turned)(twice), weight_entropy()(population)(weights))


def test_a_ranking_does_not_change_when_every_particle_is_doubled() -> None:
    population = particles(100, PLANAR)
    for measure in (mixture_entropy("part"), neighbour_entropy("part")):
        once, twice = (
            expected_information_gain(
                each, [0, 1], lambda axis: (PLANAR, [axis]), measure, outer_samples=400, seed=1
            )
            for each in (population, doubled(population))
        )
        assert once.entropy == pytest.approx(twice.entropy, abs=1e-9)
        for k in range(2):
            error = math.hypot(once.of(k).standard_error, twice.of(k).standard_error)
            assert abs(once.of(k).information_gain - twice.of(k).information_gain) < 3.0 * error
        assert once.best.number == twice.best.number == 0


def test_entropies_are_bounded_below_by_that_of_a_single_particle() -> None:
    population = particles(200)
    alone = torch.eye(200, dtype=torch.float64)
    even = torch.full((1, 200), 1.0 / 200, dtype=torch.float64)
    fall = mixture_entropy("part")(population)(even) - mixture_entropy("part")(population)(alone)
    # The base measure's density at a particle differs a little from its mean.
    torch.testing.assert_close(
        fall, torch.full((200,), math.log(200), dtype=torch.float64), atol=0.05, rtol=0
    )
    fall = neighbour_entropy("part")(population)(even) - neighbour_entropy("part")(population)(alone)
    assert bool(torch.isfinite(fall).all()) and bool((fall > 0.0).double().mean() > 0.95)


def two_places(between: bool = False) -> Population:
    """Two places 30 mm apart along x, and a bridge of particles from one to the other if asked for."""
    torch.manual_seed(3)
    tangent = torch.randn(200, 6, dtype=torch.float64) * matrix([0.001] * 3 + [0.01] * 3)
    tangent[100:, 0] += 0.03
    if between:
        bridge = torch.randn(20, 6, dtype=torch.float64) * matrix([0.001] * 3 + [0.01] * 3)
        bridge[:, 0] = torch.linspace(0.0, 0.03, 20, dtype=torch.float64)
        tangent = torch.cat([tangent, bridge])
    return at(poses.retract(CENTER, tangent))


def test_modes_are_separated_under_each_set_of_weights() -> None:
    population = two_places()
    even = torch.full((1, 200), 1.0 / 200, dtype=torch.float64)
    first = torch.cat([torch.full((1, 100), 0.01), torch.zeros(1, 100)], dim=1).double()
    entropy = mixture_entropy("part")(population)
    belief = population.belief("part")
    assert float(entropy(even)) == pytest.approx(entropy_of_modes(belief.modes()), abs=0.03)
    assert float(entropy(even) - entropy(first)) == pytest.approx(math.log(2), abs=0.2)
    assert float(entropy(even)) < belief.gaussian_entropy - 1.0
    # A bridge makes them one mode, until a measurement rules it out.
    bridged = two_places(between=True)
    whole = torch.full((1, 220), 1.0 / 220, dtype=torch.float64)
    apart = torch.cat([even, torch.full((1, 20), 1e-7, dtype=torch.float64)], dim=1)
    entropy = mixture_entropy("part")(bridged)
    assert float(entropy(whole)) == pytest.approx(bridged.belief("part").gaussian_entropy, abs=0.05)
    assert float(entropy(apart)) == pytest.approx(entropy_of_modes(belief.modes()), abs=0.25)


def test_a_sparse_belief_is_one_mode() -> None:
    # In six axes 75 particles are each on their own at a millimetre: that is no reason for 75 modes.
    population = particles(75)
    even = torch.full((1, 75), 1.0 / 75, dtype=torch.float64)
    assert len(population.belief("part").modes(0.001, 0.01)) > 50
    assert float(mixture_entropy("part", 0.001, 0.01)(population)(even)) == pytest.approx(
        population.belief("part").gaussian_entropy, abs=0.3
    )


def test_places_that_differ_by_a_symmetry_are_one() -> None:
    half_turn = poses.as_pose([0.0, 0, 0, 0, 0, 0, 1])
    population = particles(200)
    turned = poses.compose(population["part"], half_turn)
    mixed = at(torch.where((torch.arange(200) % 2 == 0)[:, None], population["part"], turned))
    even = torch.full((1, 200), 1.0 / 200, dtype=torch.float64)
    expected = float(mixture_entropy("part")(population)(even))
    assert float(mixture_entropy("part", symmetries=half_turn[None])(mixed)(even)) == pytest.approx(
        expected, abs=1e-6
    )
    assert float(mixture_entropy("part")(mixed)(even)) > expected + 0.5


# ---- refused


def fitted(measure: Any, population: Population) -> EntropyOfWeights:
    return measure(population)


def test_bad_input_is_one_sentence() -> None:
    population = particles(50, PLANAR)

    def rank(given: Population, candidates: Any = (0,), measure: Any = None, **options: Any) -> Ranking:
        return expected_information_gain(
            given, candidates, lambda axis: (PLANAR, [] if axis is None else [axis]), measure, **options
        )

    point = at(CENTER.expand(50, 7).clone(), freedom=PLANAR)
    without = at(population["part"], torch.full((50,), -torch.inf, dtype=torch.float64), PLANAR)
    single = at(population["part"], torch.where(torch.arange(50) == 3, 0.0, -torch.inf).double(), PLANAR)
    line = poses.retract(
        CENTER, torch.linspace(0, 0.001, 50)[:, None].double() * matrix([1.0, 0, 0, 0, 0, 0])
    )
    cases: list[tuple[Any, str]] = [
        (lambda: rank(population, []), "no candidates"),
        (lambda: rank(without), "every particle's is zero"),
        (lambda: rank(point), "collapsed to a point"),
        (lambda: rank(point, measure=mixture_entropy("part")), "collapsed to a point"),
        (lambda: rank(point, measure=neighbour_entropy("part")), "collapsed to a point"),
        (lambda: rank(single), "collapsed to a point"),
        (lambda: rank(single, measure=mixture_entropy("part")), "collapsed to a point"),
        (
            lambda: rank(at(line, freedom=PLANAR), measure=mixture_entropy("part")),
            "do not span its 3 free axes",
        ),
        (lambda: rank(population, measure=neighbour_entropy("part", 60)), "too few for an entropy by 60"),
        (lambda: rank(population, measure=mixture_entropy("hole")), "no latent address"),
        (lambda: rank(population, [0, None]), "candidate 1 adds no site"),
        (lambda: rank(population, horizon=3), "a horizon of 3 steps"),
        (lambda: rank(population, outer_samples=1), "1 outer samples"),
        (lambda: rank(population, cost=lambda c: {"time": 2.0}), "'time', which has no rate"),
        (lambda: rank(population, cost={}), "candidate 0 is missing in the mapping of costs"),
        (lambda: rank(population, cost=lambda c: 2.0, rate={"time": 2.0}), "costs a single number"),
        (lambda: rank(population, cost=lambda c: 2.0, rate=-1.0), "at least 0"),
        (lambda: rank(population, cost=lambda c: math.nan), "candidate 0 costs nan"),
    ]
    for call, message in cases:
        with pytest.raises(InputError) as caught:
            call()
        text = str(caught.value)
        assert message in text and text.endswith(".") and "\n" not in text, text
    discrete = Population(simulate(lambda: pyro.sample("k", dist.Categorical(torch.ones(3))), (), 20))
    with pytest.raises(InputError, match="whole numbers, which have no density; use discrete_entropy"):
        fitted(mixture_entropy("k"), discrete)
    same = generate(discrete.trace.program, (), {}, 20, choices={"k": torch.zeros(20, dtype=torch.int64)})[0]
    with pytest.raises(InputError, match="collapsed to a point"):
        fitted(discrete_entropy("k"), Population(same))
