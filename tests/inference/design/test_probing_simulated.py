"""Rankings of candidates with simulated observations: once, in batches, with the likelihoods of inference."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
import trimesh
from torch import Tensor

from bcppl import poses
from bcppl.distributions.contact import ContactsInTime, PegPose, Wrench
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InferenceError, InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.inference.design import (
    BatchedArguments,
    Ranking,
    expected_information_gain,
    mixture_entropy,
)
from bcppl.inference.design.likelihoods import log_likelihoods
from bcppl.inference.design.observations import simulate_candidates
from bcppl.inference.population import Population
from bcppl.rendering.ray_casting import RayCaster
from bcppl.traces import Series, Trace, carried, extend, generate, simulate
from tests.invariance import matrix, number


class Counted(LazyDistribution):
    """A reading of x by a simulator that counts how many particles it was run for."""

    broadcasts = True

    def __init__(self, track: Any, noise: float) -> None:
        self.track, self.noise = track, noise
        super().__init__(len(track), ())

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
        track = carried(f"push {k}", partial(Track, x, gain.expand(x.shape)))
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


def test_each_candidate_is_simulated_once_for_all_particles_whatever_the_outer_samples() -> None:
    population, before = done()
    for count in (25, 60):
        Track.runs = []
        expected_information_gain(
            population,
            CANDIDATES,
            lambda gain: ([*before, gain],),
            outer_samples=count,
            horizon=2,
            seed=0,
        )
        assert Track.runs == [40, 40, 40]


def test_a_batch_of_candidates_and_particles_is_simulated_at_once_with_the_same_gains() -> None:
    population, before = done()

    def one(gain: Tensor) -> tuple[Any, ...]:
        return ([*before, gain],)

    def rank(arguments: Any) -> Ranking:
        Track.runs = []
        return expected_information_gain(population, CANDIDATES, arguments, outer_samples=30, seed=0)

    apart = rank(one)
    batched = rank(BatchedArguments(one, lambda gains: ([*before, torch.stack(gains)],)))
    assert Track.runs == [120]
    parts = rank(BatchedArguments(one, lambda gains: ([*before, torch.stack(gains)],), at_once=2))
    assert Track.runs == [80, 40]
    for other in (batched, parts):
        for k in range(3):
            assert torch.equal(other.of(k).gains, apart.of(k).gains), "the noise is the same too"
    with pytest.raises(InputError, match=r"candidate 0 adds the addresses .* make both arguments visit"):
        rank(BatchedArguments(one, lambda gains: ([*before, torch.stack(gains), number(1.0)],)))


def test_likelihoods_are_those_of_inference() -> None:
    # Among the new sites one depends on another's observation, and one lies in a plate.
    population, before = done()
    one = next(simulate_candidates(population.trace, [number(2.0)], lambda g: ([*before, g],), (), 0))
    values = one.draw(torch.arange(40), 1)
    found = log_likelihoods(one.trace, one.observed, values)
    for h in (0, 7, 39):
        _, expected = extend(
            population.trace, ([*before, number(2.0)],), {a: v[h] for a, v in values.items()}
        )
        torch.testing.assert_close(found[h], expected)


def test_an_image_is_rendered_no_more_often_than_four_times() -> None:
    ring = trimesh.creation.annulus(r_min=0.01, r_max=0.03, height=0.03, sections=32)
    renderer = RayCaster(Part("ring", np.asarray(ring.vertices), np.asarray(ring.faces, dtype=np.int64)))
    eye = np.array([0, 0, -0.15, 1.0, 0, 0, 0])
    camera = Camera("front", 24, 18, 40.0, 42.0, 10.2, 9.1, eye, near=0.05, far=0.6)

    def seen(views: int, region: Tensor | None = None) -> None:
        part = pyro.sample("part", NormalPose(poses.identity(), matrix([0.003] * 3 + [0.2] * 3)))
        for k in range(views):
            noise = RobustDepth(renderer, camera, part, 0.003, outlier=0.1, region=region)
            pyro.sample(f"depth_{k}", noise)

    torch.manual_seed(0)
    mask = torch.rand(18, 24) < 0.6
    population = Population(simulate(seen, (0, mask), 20))
    one = next(simulate_candidates(population.trace, [1], lambda views: (views, mask), (), 0))
    before = renderer.effort.items
    values = one.draw(torch.arange(20), 1)
    values = {"depth_0": torch.where(torch.rand(20, 18, 24) < 0.1, torch.nan, values["depth_0"])}
    found = log_likelihoods(one.trace, one.observed, values)
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


def test_sites_that_broadcast_evaluate_several_observations_as_one_by_one() -> None:
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


class Off(LazyDistribution):
    """A reading that is off by what was read before."""

    def __init__(self, x: Tensor, before: Tensor) -> None:
        self.inputs = x, before
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        x, before = self.inputs
        return dist.Normal(x - before, 0.2).log_prob(value)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        x, before = self.inputs
        return dist.Normal(x - before, 0.2).sample()


def test_a_site_that_depends_on_another_is_evaluated_so_at_each_particles_own_draw() -> None:
    def twice() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        first = pyro.sample("first", dist.Normal(x, 0.5))
        pyro.sample("second", Off(x, first))

    torch.manual_seed(2)
    trace = simulate(twice, (), 6)
    drawn = {address: trace[address] for address in ("first", "second")}
    found = log_likelihoods(trace, ("first", "second"), drawn)
    first, second = drawn["first"][:, None], drawn["second"][:, None]
    exact = dist.Normal(trace["x"], 0.5).log_prob(first)
    exact = exact + dist.Normal(trace["x"] - first, 0.2).log_prob(second)
    torch.testing.assert_close(found, exact)


class Unforeseen(LazyDistribution):
    """A likelihood without a sampler."""

    def __init__(self, x: Tensor) -> None:
        self.x = x
        super().__init__(len(x), (2,))

    def log_prob(self, value: Tensor) -> Tensor:
        assert value.shape == (2,)
        return -0.5 * ((value - self.x[:, None]) / 0.2).square().sum(-1)


def unforeseen(touches: int) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    for k in range(touches):
        pyro.sample(f"y_{k}", Unforeseen(x))


def test_a_predictive_sampler_serves_sites_that_cannot_be_sampled() -> None:
    torch.manual_seed(0)
    population = Population(simulate(unforeseen, (0,), 800))

    def predict(touch: int, trace: Trace) -> dict[str, Tensor]:
        return {"y_0": trace["x"][:, None] + 0.2 * torch.randn(len(trace), 2, dtype=torch.float64)}

    ranking = expected_information_gain(
        population,
        [1],
        lambda touch: (touch,),
        mixture_entropy("x"),
        predictive=predict,
        outer_samples=150,
        seed=0,
    )
    exact = 0.5 * math.log1p(2.0 * float(population["x"].var()) / 0.04)
    assert ranking.best.information_gain == pytest.approx(exact, abs=3.0 * ranking.best.standard_error + 0.02)
    with pytest.raises(InputError, match="the value of site 'y_0' has shape"):
        expected_information_gain(
            population,
            [1],
            lambda touch: (touch,),
            predictive=lambda touch, trace: {"y_0": number(0.0).expand(3)},
            outer_samples=30,
        )


def test_new_latent_values_are_not_observed() -> None:
    def biased(spreads: list[float]) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        for k, spread in enumerate(spreads):
            bias = pyro.sample(f"bias_{k}", dist.Normal(number(0.0), spread))
            pyro.sample(f"y_{k}", dist.Normal(x + bias, 0.3))

    torch.manual_seed(0)
    population = Population(simulate(biased, ([],), 4000))
    ranking = expected_information_gain(
        population,
        [0.01, 2.0],
        lambda spread: ([spread],),
        mixture_entropy("x"),
        latent=["bias_*"],
        outer_samples=150,
        seed=0,
    )
    for k, spread in enumerate((0.01, 2.0)):
        exact = 0.5 * math.log1p(float(population["x"].var()) / (0.09 + spread**2))
        utility = ranking.of(k)
        assert utility.information_gain == pytest.approx(exact, abs=3.0 * utility.standard_error + 0.03)


def test_a_series_is_run_on_by_a_step() -> None:
    def init() -> Tensor:
        return pyro.sample("x", dist.Normal(number(0.0), 1.0))

    def step(x: Tensor, noise: float) -> Tensor:
        pyro.sample("y", dist.Normal(x, noise))
        return x

    torch.manual_seed(0)
    start, _ = generate(Series(init, step), (), {}, 300)
    ranking = expected_information_gain(
        Population(start),
        [5.0, 0.3],
        lambda noise: (noise,),
        mixture_entropy("x"),
        outer_samples=40,
        seed=0,
    )
    assert ranking.best.candidate == 0.3


def test_outer_samples_whose_simulation_failed_are_left_out_and_counted() -> None:
    class Fragile(Unforeseen):
        def log_prob(self, value: Tensor) -> Tensor:
            return torch.where(self.x > 1.0, -torch.inf, super().log_prob(value))

        def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
            drawn = self.x[:, None] + 0.2 * torch.randn(len(self.x), 2, dtype=torch.float64)
            return torch.where((self.x > self.limit)[:, None], torch.nan, drawn)

        limit = 1.0

    def fragile(touches: int) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        for k in range(touches):
            pyro.sample(f"y_{k}", Fragile(x))

    torch.manual_seed(0)
    population = Population(simulate(fragile, (0,), 60))
    failed = int((population["x"] > 1.0).sum())
    with pytest.warns(UserWarning, match=f"candidate 0 leaves out {failed} of 60 outer samples"):
        ranking = expected_information_gain(population, [1], lambda touch: (touch,), seed=0)
    assert int(torch.isnan(ranking.best.gains).sum()) == failed and ranking.best.information_gain > 0.5
    Fragile.limit = -10.0
    with pytest.raises(InferenceError, match="at 'y_0' have no log-probability at any"):
        expected_information_gain(population, [1], lambda touch: (touch,), seed=0)
