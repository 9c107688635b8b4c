"""What ranking candidates rests on: entropies of reweighed particles, and simulating each candidate once."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
import trimesh
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief, entropy_of_modes
from bcppl.distributions.contact import ContactsInTime, PegPose
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import NormalPose
from bcppl.distributions.wrench import Wrench
from bcppl.errors import InferenceError, InputError
from bcppl.inference.population import Population
from bcppl.inference.probing import (
    Batched,
    EntropyOf,
    Ranking,
    expected_information_gain,
    mode_entropy,
    neighbour_entropy,
    value_entropy,
    weight_entropy,
)
from bcppl.inference.probing.observations import simulated
from bcppl.inference.probing.weighing import weighed
from bcppl.parts import Part
from bcppl.poses import FREE, Freedom
from bcppl.simulators.camera import Camera
from bcppl.simulators.renderer import DepthRenderer
from bcppl.traces import Series, Trace, carried, extend, generate, simulate
from tests.invariance import equal_weights, matrix, number

CENTER = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
SPREAD = [0.004, 0.002, 0.001, 0.02, 0.01, 0.03]
PLANAR = Freedom("xy", "z")


def placed(freedom: Freedom, axes: list[int], noise: float = 0.0005) -> None:
    """A part at a pose, whose coordinates along some of the world's axes are read."""
    spread = freedom.coordinates(matrix(SPREAD))
    part = pyro.sample("part", NormalPose(CENTER, spread, freedom))
    for k, axis in enumerate(axes):
        pyro.sample(f"y_{k}", dist.Normal(part[..., axis], noise))


def particles(count: int, freedom: Freedom = FREE, seed: int = 0) -> Population:
    torch.manual_seed(seed)
    return equal_weights(simulate(placed, (freedom, []), count))


def at(world_from_part: Tensor, log_weights: Tensor | None = None, freedom: Freedom = FREE) -> Population:
    """Particles at given poses."""
    count = len(world_from_part)
    trace, _ = generate(placed, (freedom, []), {}, count, choices={"part": world_from_part})
    return Population(trace, torch.zeros(count, dtype=torch.float64) if log_weights is None else log_weights)


def doubled(population: Population) -> Population:
    return population[torch.arange(len(population)).repeat(2)]


def some_weights(rows: int, count: int, sharpness: float = 1.0) -> Tensor:
    torch.manual_seed(7)
    return torch.softmax(sharpness * torch.randn(rows, count, dtype=torch.float64), dim=1)


@pytest.mark.parametrize("freedom", [FREE, PLANAR, Freedom("xyz", "none")])
def test_under_its_own_weights_a_belief_has_the_entropies_that_it_says(freedom: Freedom) -> None:
    population = particles(1500, freedom)
    # Weights of a Gaussian in one direction: far from even, and smooth.
    tilted = population.log_weights - 0.5 * ((population["part"][:, 0] - 0.1) / 0.002) ** 2
    belief = Belief(population["part"], tilted, freedom)
    even = torch.full((1, 1500), 1.0 / 1500, dtype=torch.float64)
    modes, near = mode_entropy("part")(population), neighbour_entropy("part")(population)
    weights = torch.softmax(tilted, 0)[None]
    assert float(modes(even)) == pytest.approx(population.belief("part").gaussian_entropy, abs=0.01)
    assert float(modes(weights)) == pytest.approx(belief.gaussian_entropy, abs=0.02)
    assert float(near(even)) == pytest.approx(population.belief("part").nearest_neighbour_entropy(), abs=1e-9)
    assert float(near(weights)) == pytest.approx(belief.nearest_neighbour_entropy(), abs=0.15)


@pytest.mark.parametrize(
    "measure", [mode_entropy("part"), neighbour_entropy("part"), mode_entropy("part", 0.001, 0.01)]
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
    for measure in (mode_entropy("part"), neighbour_entropy("part")):
        once, twice = (
            expected_information_gain(
                each, [0, 1], lambda axis: (PLANAR, [axis]), measure, hypotheses=400, seed=1
            )
            for each in (population, doubled(population))
        )
        assert once.entropy == pytest.approx(twice.entropy, abs=1e-9)
        for k in range(2):
            error = math.hypot(once.of(k).standard_error, twice.of(k).standard_error)
            assert abs(once.of(k).information_gain - twice.of(k).information_gain) < 3.0 * error
        assert once.best.number == twice.best.number == 0


def test_what_is_left_of_a_belief_is_never_less_than_a_particle_stands_for() -> None:
    population = particles(200)
    alone = torch.eye(200, dtype=torch.float64)
    even = torch.full((1, 200), 1.0 / 200, dtype=torch.float64)
    fall = mode_entropy("part")(population)(even) - mode_entropy("part")(population)(alone)
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


def test_modes_are_those_that_are_left() -> None:
    population = two_places()
    even = torch.full((1, 200), 1.0 / 200, dtype=torch.float64)
    first = torch.cat([torch.full((1, 100), 0.01), torch.zeros(1, 100)], dim=1).double()
    entropy = mode_entropy("part")(population)
    belief = population.belief("part")
    assert float(entropy(even)) == pytest.approx(entropy_of_modes(belief.modes()), abs=0.03)
    assert float(entropy(even) - entropy(first)) == pytest.approx(math.log(2), abs=0.2)
    assert float(entropy(even)) < belief.gaussian_entropy - 1.0
    # A bridge makes them one mode, until a measurement takes it away.
    bridged = two_places(between=True)
    whole = torch.full((1, 220), 1.0 / 220, dtype=torch.float64)
    apart = torch.cat([even, torch.full((1, 20), 1e-7, dtype=torch.float64)], dim=1)
    entropy = mode_entropy("part")(bridged)
    assert float(entropy(whole)) == pytest.approx(bridged.belief("part").gaussian_entropy, abs=0.05)
    assert float(entropy(apart)) == pytest.approx(entropy_of_modes(belief.modes()), abs=0.25)


def test_a_sparse_belief_is_one_mode() -> None:
    # In six axes 75 particles are each on their own at a millimetre: that is no reason for 75 modes.
    population = particles(75)
    even = torch.full((1, 75), 1.0 / 75, dtype=torch.float64)
    assert len(population.belief("part").modes(0.001, 0.01)) > 50
    assert float(mode_entropy("part", 0.001, 0.01)(population)(even)) == pytest.approx(
        population.belief("part").gaussian_entropy, abs=0.3
    )


def test_places_that_differ_by_a_symmetry_are_one() -> None:
    half_turn = poses.as_pose([0.0, 0, 0, 0, 0, 0, 1])
    population = particles(200)
    turned = poses.compose(population["part"], half_turn)
    mixed = at(torch.where((torch.arange(200) % 2 == 0)[:, None], population["part"], turned))
    even = torch.full((1, 200), 1.0 / 200, dtype=torch.float64)
    expected = float(mode_entropy("part")(population)(even))
    assert float(mode_entropy("part", symmetries=half_turn[None])(mixed)(even)) == pytest.approx(
        expected, abs=1e-6
    )
    assert float(mode_entropy("part")(mixed)(even)) > expected + 0.5


# ---- simulated once


class Counted(LazyDistribution):
    """A reading of x by a simulator that counts how many particles it was run for."""

    broadcasts = True

    def __init__(self, track: Any, noise: float) -> None:
        self.track, self.noise = track, noise
        super().__init__(len(track), (), track.inputs)

    def log_prob(self, value: Tensor) -> Tensor:
        return dist.Normal(self.track.run(), self.noise).log_prob(value)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return dist.Normal(self.track.run(), self.noise).sample()


class Track:
    """Simulated when it is asked for."""

    runs: ClassVar[list[int]] = []

    def __init__(self, x: Tensor, gain: Tensor, known: Tensor | None = None) -> None:
        self.inputs, self.known = (x, gain), known

    def __len__(self) -> int:
        return len(self.inputs[0])

    def run(self) -> Tensor:
        if self.known is None:
            Track.runs.append(len(self))
            self.known = self.inputs[1] * self.inputs[0]
        return self.known

    def __getitem__(self, index: Tensor) -> Track:
        x, gain = (each[index] for each in self.inputs)
        return Track(x, gain, None if self.known is None else self.known[index])

    def where(self, mask: Tensor, other: Track) -> Track:
        raise NotImplementedError


def pushed(gains: list[Tensor]) -> None:
    """Each push is felt twice; a gain is one number for all, or one for each particle."""
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    for k, gain in enumerate(gains):
        inputs = (x, gain.expand(x.shape))
        track = carried(f"push {k}", inputs, lambda inputs=inputs: Track(*inputs))
        first = pyro.sample(f"felt_{k}", Counted(track, 0.3))
        pyro.sample(f"again_{k}", Counted(track, 0.5))
        with pyro.plate(f"echoes_{k}", 2):
            pyro.sample(f"echo_{k}", dist.Normal(first * matrix([[1.0], [2.0]]), 0.4))


def done() -> tuple[Population, list[Tensor]]:
    torch.manual_seed(0)
    gain = number(0.5)
    seen = {"felt_0": number(0.3), "again_0": number(0.2), "echo_0": matrix([0.3, 0.5])}
    trace, log_weights = generate(pushed, ([gain],), seen, 40)
    return Population(trace, log_weights), [gain]


CANDIDATES = [number(0.1), number(1.0), number(3.0)]


def test_each_candidate_is_simulated_once_for_all_particles_whatever_the_hypotheses() -> None:
    population, before = done()
    for hypotheses in (None, 25, 100):
        Track.runs = []
        expected_information_gain(
            population, CANDIDATES, lambda gain: ([*before, gain],), hypotheses=hypotheses, depth=2, seed=0
        )
        assert Track.runs == [40, 40, 40]


def test_a_batch_of_candidates_and_particles_is_simulated_at_once_and_tells_the_same() -> None:
    population, before = done()

    def one(gain: Tensor) -> tuple[Any, ...]:
        return ([*before, gain],)

    def rank(arguments: Any) -> Ranking:
        Track.runs = []
        return expected_information_gain(population, CANDIDATES, arguments, hypotheses=30, seed=0)

    apart = rank(one)
    batched = rank(Batched(one, lambda gains: ([*before, torch.stack(gains)],)))
    assert Track.runs == [120]
    parts = rank(Batched(one, lambda gains: ([*before, torch.stack(gains)],), at_once=2))
    assert Track.runs == [80, 40]
    for other in (batched, parts):
        for k in range(3):
            assert torch.equal(other.of(k).gains, apart.of(k).gains), "the noise is the same too"
    with pytest.raises(InputError, match=r"candidate 0 adds the addresses .* make both arguments visit"):
        rank(Batched(one, lambda gains: ([*before, torch.stack(gains), number(1.0)],)))


def test_what_is_weighed_is_what_inference_would_weigh() -> None:
    # Among the new sites one hangs on what another observes, and one lies in a plate.
    population, before = done()
    one = next(simulated(population.trace, [number(2.0)], lambda g: ([*before, g],), (), 0))
    values = one.drawn(torch.arange(40), 1)
    found = weighed(one.trace, one.observed, values)
    for h in (0, 7, 39):
        _, expected = extend(
            population.trace, ([*before, number(2.0)],), {a: v[h] for a, v in values.items()}
        )
        torch.testing.assert_close(found[h], expected)


def test_an_image_is_rendered_no_more_often_than_four_times() -> None:
    ring = trimesh.creation.annulus(r_min=0.01, r_max=0.03, height=0.03, sections=32)
    renderer = DepthRenderer(Part("ring", np.asarray(ring.vertices), np.asarray(ring.faces, dtype=np.int64)))
    eye = np.array([0, 0, -0.15, 1.0, 0, 0, 0])
    camera = Camera("front", 24, 18, 40.0, 42.0, 10.2, 9.1, eye, near=0.05, far=0.6)

    def seen(views: int, region: Tensor | None = None) -> None:
        part = pyro.sample("part", NormalPose(poses.identity(), matrix([0.003] * 3 + [0.2] * 3)))
        for k in range(views):
            noise = RobustDepth(renderer, camera, part, 0.003, outlier=0.1, region=region)
            pyro.sample(f"depth_{k}", noise)

    torch.manual_seed(0)
    mask = torch.rand(18, 24) < 0.6
    population = equal_weights(simulate(seen, (0, mask), 20))
    one = next(simulated(population.trace, [1], lambda views: (views, mask), (), 0))
    before = renderer.effort.items
    values = one.drawn(torch.arange(20), 1)
    values = {"depth_0": torch.where(torch.rand(20, 18, 24) < 0.1, torch.nan, values["depth_0"])}
    found = weighed(one.trace, one.observed, values)
    assert renderer.effort.items - before == 3 * 20
    for h in range(20):
        _, expected = extend(population.trace, (1, mask), {"depth_0": values["depth_0"][h]})
        torch.testing.assert_close(found[h], expected, atol=1e-9, rtol=0)


class Known:
    """A track that is known already."""

    def __init__(self, count: int, stamps: int) -> None:
        torch.manual_seed(0)
        self.contacts = torch.randn(count, stamps, 3, dtype=torch.float64)
        self.contacts[torch.rand(count, stamps) < 0.3] = torch.nan
        self.pose = poses.retract(poses.identity(), 0.01 * torch.randn(count, stamps, 6, dtype=torch.float64))
        self.felt = torch.randn(count, stamps, 6, dtype=torch.float64)
        self.diverged = torch.arange(count) == 2
        self.inputs = (self.contacts,)

    def __len__(self) -> int:
        return len(self.contacts)

    def window(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        return self.contacts[:, first:last], self.pose[:, first:last]

    def wrench(self, first: int, last: int) -> Tensor:
        return self.felt[:, first:last]


def test_sites_that_broadcast_weigh_several_observations_as_one_by_one() -> None:
    track = Known(6, 12)
    sites = [
        ContactsInTime(track, 2, 12, 0.01, every=3),
        PegPose(track, 2, 12, 0.001, 0.01, every=2),
        Wrench(track, 2, 12, 0.3, 0.02, every=2),
    ]
    for site in sites:
        values = site.sample()[[0, 1, 3, 5]]
        assert site.broadcasts
        expected = torch.stack([site.log_prob(value) for value in values])
        torch.testing.assert_close(site.log_prob(values[:, None]), expected)


class Unforeseen(LazyDistribution):
    """A likelihood of what was measured that cannot say what will be."""

    def __init__(self, x: Tensor) -> None:
        super().__init__(len(x), (2,), (x,))

    def log_prob(self, value: Tensor) -> Tensor:
        assert value.shape == (2,)
        return -0.5 * ((value - self.inputs[0][:, None]) / 0.2).square().sum(-1)


def unforeseen(touches: int) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    for k in range(touches):
        pyro.sample(f"y_{k}", Unforeseen(x))


def test_a_forecast_stands_in_for_sites_that_cannot_be_sampled() -> None:
    torch.manual_seed(0)
    population = equal_weights(simulate(unforeseen, (0,), 800))

    def forecast(touch: int, trace: Trace) -> dict[str, Tensor]:
        return {"y_0": trace["x"][:, None] + 0.2 * torch.randn(len(trace), 2, dtype=torch.float64)}

    ranking = expected_information_gain(
        population, [1], lambda touch: (touch,), mode_entropy("x"), forecast=forecast, hypotheses=150, seed=0
    )
    exact = 0.5 * math.log1p(2.0 * float(population["x"].var()) / 0.04)
    assert ranking.best.information_gain == pytest.approx(exact, abs=3.0 * ranking.best.standard_error + 0.02)
    with pytest.raises(InputError, match="gives no 30 values at 'y_0'; give tensors by address"):
        expected_information_gain(
            population,
            [1],
            lambda touch: (touch,),
            forecast=lambda touch, trace: {"y_0": number(0.0).expand(3)},
            hypotheses=30,
        )


def test_new_latent_values_are_not_observed() -> None:
    def biased(spreads: list[float]) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        for k, spread in enumerate(spreads):
            bias = pyro.sample(f"bias_{k}", dist.Normal(number(0.0), spread))
            pyro.sample(f"y_{k}", dist.Normal(x + bias, 0.3))

    torch.manual_seed(0)
    population = equal_weights(simulate(biased, ([],), 4000))
    ranking = expected_information_gain(
        population,
        [0.01, 2.0],
        lambda spread: ([spread],),
        mode_entropy("x"),
        latent=["bias_*"],
        hypotheses=150,
        seed=0,
    )
    for k, spread in enumerate((0.01, 2.0)):
        exact = 0.5 * math.log1p(float(population["x"].var()) / (0.09 + spread**2))
        prospect = ranking.of(k)
        assert prospect.information_gain == pytest.approx(exact, abs=3.0 * prospect.standard_error + 0.03)


def test_a_series_is_run_on_by_a_step() -> None:
    def init() -> Tensor:
        return pyro.sample("x", dist.Normal(number(0.0), 1.0))

    def step(x: Tensor, noise: float) -> Tensor:
        pyro.sample("y", dist.Normal(x, noise))
        return x

    torch.manual_seed(0)
    start, _ = generate(Series(init, step), (), {}, 300)
    ranking = expected_information_gain(
        equal_weights(start), [5.0, 0.3], lambda noise: (noise,), mode_entropy("x"), hypotheses=40, seed=0
    )
    assert ranking.best.candidate == 0.3


def test_hypotheses_whose_simulation_failed_are_left_out_and_counted() -> None:
    class Fragile(Unforeseen):
        def log_prob(self, value: Tensor) -> Tensor:
            return torch.where(self.inputs[0] > 1.0, -torch.inf, super().log_prob(value))

        def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
            drawn = self.inputs[0][:, None] + 0.2 * torch.randn(len(self.inputs[0]), 2, dtype=torch.float64)
            return torch.where((self.inputs[0] > self.limit)[:, None], torch.nan, drawn)

        limit = 1.0

    def fragile(touches: int) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        for k in range(touches):
            pyro.sample(f"y_{k}", Fragile(x))

    torch.manual_seed(0)
    population = equal_weights(simulate(fragile, (0,), 60))
    failed = int((population["x"] > 1.0).sum())
    with pytest.warns(UserWarning, match=f"{failed} of 60 hypotheses are left out of what candidate 0"):
        ranking = expected_information_gain(population, [1], lambda touch: (touch,), seed=0)
    assert int(torch.isnan(ranking.best.gains).sum()) == failed and ranking.best.information_gain > 0.5
    Fragile.limit = -10.0
    with pytest.raises(InferenceError, match="simulated at 'y_0' has no log-probability at any"):
        expected_information_gain(population, [1], lambda touch: (touch,), seed=0)


# ---- refused


def fitted(measure: Any, population: Population) -> EntropyOf:
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
        (lambda: rank(point, measure=mode_entropy("part")), "collapsed to a point"),
        (lambda: rank(point, measure=neighbour_entropy("part")), "collapsed to a point"),
        (lambda: rank(single), "collapsed to a point"),
        (lambda: rank(single, measure=mode_entropy("part")), "collapsed to a point"),
        (lambda: rank(at(line, freedom=PLANAR), measure=mode_entropy("part")), "do not span its 3 free axes"),
        (lambda: rank(population, measure=neighbour_entropy("part", 60)), "too few for an entropy by 60"),
        (lambda: rank(population, measure=mode_entropy("hole")), "no latent address"),
        (lambda: rank(population, [0, None]), "candidate 1 adds no site"),
        (lambda: rank(population, depth=3), "looked ahead by 3 steps"),
        (lambda: rank(population, hypotheses=1), "1 hypotheses"),
        (lambda: rank(population, cost={1: 2.0}), "candidate 0 has no cost"),
        (lambda: rank(population, cost=lambda c: {"time": 2.0}), "'time', which has no rate"),
        (lambda: rank(population, cost=lambda c: 2.0, rate={"time": 2.0}), "costs a single number"),
        (lambda: rank(population, cost=lambda c: 2.0, rate=-1.0), "at least 0"),
        (lambda: rank(population, cost=lambda c: math.nan), "candidate 0 costs nan"),
    ]
    for call, said in cases:
        with pytest.raises(InputError) as caught:
            call()
        text = str(caught.value)
        assert said in text and text.endswith(".") and "\n" not in text, text
    discrete = equal_weights(simulate(lambda: pyro.sample("k", dist.Categorical(torch.ones(3))), (), 20))
    with pytest.raises(InputError, match="whole numbers, which have no density; use value_entropy"):
        fitted(mode_entropy("k"), discrete)
    same = generate(discrete.trace.program, (), {}, 20, choices={"k": torch.zeros(20, dtype=torch.int64)})[0]
    with pytest.raises(InputError, match="collapsed to a point"):
        fitted(value_entropy("k"), equal_weights(same))
