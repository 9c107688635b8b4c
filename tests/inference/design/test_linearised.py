"""Information matrices added in the tangent space, against closed forms, symmetries and bad input."""

from __future__ import annotations

import math
import warnings

import pyro
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.contact.quasi_static import QuasiStaticMotion, WindowMotion
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.manifold import ContactManifold, Quadratic
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, box_peg
from bcppl.geometry.gap import PegGap
from bcppl.inference.design import linearised_information_gain, mixture_entropy
from bcppl.inference.design.tangent_mixture import TangentMixture
from bcppl.inference.population import Population
from bcppl.robot.motion import ProbeWindow
from bcppl.robot.plan import Plan
from bcppl.sensors.candidates import action_of
from bcppl.traces import Trace, generate
from tests.inference.design.probing_programs import CENTER, SPREAD, at, doubled, particles


class Read(LazyDistribution):
    """A number (,) read off a pose: a linear function of its tangent at a center, with noise."""

    def __init__(self, pose: Tensor, row: Tensor, noise: float) -> None:
        self.expected, self.row, self.noise = poses.local(CENTER, pose) @ row, row, noise
        self.pose = pose
        super().__init__(len(pose), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return -0.5 * ((value - self.expected) / self.noise) ** 2 - math.log(
            self.noise * math.sqrt(2 * math.pi)
        )

    def sample(self, sample_shape: object = None) -> Tensor:
        return self.expected + self.noise * torch.randn(len(self.expected), dtype=torch.float64)

    def quadratic(self, value: Tensor) -> Quadratic:
        turn = torch.linalg.inv(poses.right_jacobian(poses.local(CENTER, self.pose)[:, 3:]))
        rows = self.row.expand(len(self.pose), 6).clone()
        rows[:, 3:] = (rows[:, None, 3:] @ turn)[:, 0]
        pull = rows * ((self.expected - value) / self.noise**2)[:, None]
        return Quadratic(pull, rows[:, :, None] * rows[:, None, :] / self.noise**2)


Reading = tuple[tuple[float, ...], float]


def readings(spread: Tensor, asked: list[Reading]) -> None:
    part = pyro.sample("part", NormalPose(CENTER, spread))
    for k, (row, noise) in enumerate(asked):
        pyro.sample(f"y_{k}", Read(part, torch.tensor(row, dtype=torch.float64), noise))


SPREADS = torch.diag(torch.tensor(SPREAD, dtype=torch.float64) ** 2)
ASKED: list[Reading] = [
    ((1.0, 0, 0, 0, 0, 0), 5e-4),
    ((0, 0, 1.0, 0, 0, 0), 5e-4),
    ((0, 0.5, 0, 0, 0, 0.05), 1e-4),
    ((0, 0, 0, 0, 0, 0), 1.0),
]


def drawn(count: int, seed: int = 0, centers: Tensor | None = None) -> Population:
    """Particles of equal weight, about one place or in turn about several (K, 6)."""
    torch.manual_seed(seed)
    tangent = torch.randn(count, 6, dtype=torch.float64) * torch.tensor(SPREAD, dtype=torch.float64)
    if centers is not None:
        tangent = tangent + centers.repeat(count // len(centers), 1)
    trace, _ = generate(readings, (SPREADS, []), {}, count, choices={"part": poses.retract(CENTER, tangent)})
    return Population(trace)


def arguments(one: Reading) -> tuple[Tensor, list[Reading]]:
    return SPREADS, [one]


def test_it_is_the_closed_form_of_a_linear_reading() -> None:
    population = drawn(300)
    ranking = linearised_information_gain(population, ASKED, arguments, seed=0)
    tangent = poses.local(CENTER, population["part"])
    covariance = torch.cov(tangent.T, correction=0)
    for k, (row, noise) in enumerate(ASKED):
        h = torch.tensor(row, dtype=torch.float64)
        exact = 0.5 * math.log1p(float(h @ covariance @ h) / noise**2)
        utility = ranking.of(k)
        # A single particle's floor makes the covariance larger by n^(-1 - 1/3).
        assert utility.information_gain == pytest.approx(exact, abs=2e-3)
        assert utility.standard_error < 2e-3
        assert utility.entropy == pytest.approx(ranking.entropy - utility.information_gain)
    assert ranking.best.number == 2 and ranking[-1].number == 3
    assert ranking.entropy == pytest.approx(
        float(mixture_entropy("part")(population)(torch.full((1, 300), 1 / 300).double())[0])
    )


def test_copies_of_particles_change_nothing_nor_does_a_budget() -> None:
    population = drawn(60, 1)
    once = linearised_information_gain(population, ASKED, arguments, seed=0)
    twice = linearised_information_gain(doubled(population), ASKED, arguments, seed=0)
    few = linearised_information_gain(population, ASKED, arguments, outer_samples=10, seed=0)
    for k in range(len(ASKED)):
        assert twice.of(k).information_gain == pytest.approx(once.of(k).information_gain, abs=1e-9)
        assert few.of(k).information_gain == pytest.approx(once.of(k).information_gain, abs=2e-3)
    assert len(few.best.gains) == 10


def test_costs_and_two_steps() -> None:
    population = drawn(200, 2)
    dear = linearised_information_gain(
        population, ASKED, arguments, cost=lambda one: 100.0 * one[0][1], seed=0
    )
    assert dear.best.number == 0
    both = linearised_information_gain(population, ASKED, arguments, horizon=2, seed=0)
    h = torch.tensor([ASKED[k][0] for k in (0, 2)], dtype=torch.float64)
    noise = torch.diag(torch.tensor([ASKED[k][1] for k in (0, 2)], dtype=torch.float64) ** 2)
    covariance = torch.cov(poses.local(CENTER, population["part"]).T, correction=0)
    exact = 0.5 * float(torch.logdet(noise + h @ covariance @ h.T) - torch.logdet(noise))
    for k, other in ((2, 0), (0, 2)):
        utility = both.of(k)
        assert utility.information_gain == pytest.approx(exact, abs=4e-3)
        assert utility.second is not None and int(utility.second[0]) == other


def test_a_second_step_that_fails_for_some_adds_its_mean_over_the_others() -> None:
    population = drawn(400, 6)

    def information(candidate: str, trace: Trace) -> Tensor:
        far = trace["part"][:, 0] > CENTER[0]
        precision = torch.where(far, 1e9, 1e3) if candidate == "unequal" else torch.where(far, 0.0, math.nan)
        return precision[:, None, None] * torch.eye(6, dtype=torch.float64)

    def of(candidates: list[str], depth: int) -> float:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the failed ones
            ranking = linearised_information_gain(
                population,
                candidates,
                lambda c: (SPREADS, []),
                information=information,
                horizon=depth,
                seed=0,
            )
        return ranking.of(0).information_gain

    assert of(["unequal", "failing"], 2) == pytest.approx(of(["unequal", "unequal"], 2))
    alone = of(["unequal"], 1)
    assert alone <= of(["unequal", "failing"], 2) < alone + 0.7 * 6


def test_of_two_orders_the_one_with_the_larger_first_gain_ranks_first() -> None:
    population = drawn(200, 2)
    for asked in (ASKED, ASKED[::-1]):
        ranking = linearised_information_gain(population, asked, arguments, horizon=2, seed=0)
        alone = linearised_information_gain(population, asked, arguments, seed=0)
        assert ranking.best.number == alone.best.number
        assert ranking[0].value == pytest.approx(ranking[1].value, abs=1e-9)
        assert ranking.best.myopic == pytest.approx(alone.best.value)


def test_the_discrimination_between_modes_counts_as_well() -> None:
    centers = torch.zeros(2, 6, dtype=torch.float64)
    centers[:, 0] = torch.tensor([-0.05, 0.05])
    population = drawn(200, 3, centers)
    belief = TangentMixture.fit(population, "part")
    assert len(belief) == 2 and float(belief.mass[0]) == pytest.approx(0.5)
    asked: list[Reading] = [((1.0, 0, 0, 0, 0, 0), 1e-3), ((0, 1.0, 0, 0, 0, 0), 1e-3)]
    ranking = linearised_information_gain(population, asked, arguments, seed=0)

    def within(axis: int) -> float:
        size = torch.stack([(f @ f.T)[axis, axis] for f in belief.factor])
        return float((belief.mass * 0.5 * torch.log1p(size / 1e-6)).sum())

    # Along x the modes are discriminated with certainty, along y not at all.
    assert ranking.of(0).information_gain == pytest.approx(within(0) + math.log(2.0), abs=0.02)
    # A y that is more frequent in one mode is a little informative.
    assert ranking.of(1).information_gain == pytest.approx(within(1), abs=0.05)
    assert ranking.of(1).information_gain >= within(1) - 0.01


def test_given_information_is_used() -> None:
    population = drawn(100, 4)
    known = torch.diag(torch.tensor([1e8, 0, 0, 0, 0, 0], dtype=torch.float64))

    def information(candidate: Reading, trace: Trace) -> Tensor | None:
        return known.expand(trace.particles, 6, 6) if candidate is ASKED[3] else None

    ranking = linearised_information_gain(population, ASKED, arguments, information=information, seed=0)
    size = float(torch.cov(poses.local(CENTER, population["part"]).T, correction=0)[0, 0])
    assert ranking.of(3).information_gain == pytest.approx(0.5 * math.log1p(1e8 * size), abs=2e-3)
    uneven = torch.triu(torch.ones(6, 6, dtype=torch.float64)) * 1e4
    for wrong, message in (
        (-known.expand(100, 6, 6), "check the sign"),
        (uneven.expand(100, 6, 6), "not symmetric"),
    ):
        with pytest.raises(InputError, match=f"the information of candidate 0 .*{message}"):
            linearised_information_gain(
                population,
                ["view"],
                lambda c: (SPREADS, []),
                information=lambda c, trace, wrong=wrong: wrong,  # type: ignore[misc]
                seed=0,
            )


def test_given_information_warns_where_there_are_several_modes() -> None:
    centers = torch.zeros(2, 6, dtype=torch.float64)
    centers[:, 0] = torch.tensor([-0.05, 0.05])
    known = 1e6 * torch.eye(6, dtype=torch.float64).expand(200, 6, 6)
    with pytest.warns(UserWarning, match="has 2 modes, and the gain of 1 of 1 candidates"):
        linearised_information_gain(
            drawn(200, 3, centers), ["view"], lambda c: (SPREADS, []), information=lambda *now: known, seed=0
        )


def touch(x: float, depth: float) -> Plan:
    """Down on the block at x, its tip ending at a depth below the top."""
    at = poses.identity(2)
    at[:, 0], at[:, 2] = x, torch.tensor([0.06, 0.05 - depth])
    stiffness, damping = torch.ones(6).numpy(), torch.ones(6).numpy()
    times = torch.tensor([0.0, 1.0]).double().numpy()
    return Plan(f"at {x}", times, at.numpy(), ("guarded",), 4.0, stiffness, damping)


def test_touches_that_meet_the_part_inform_its_height() -> None:
    proxy = QuasiStaticMotion(PegGap(block((0.06, 0.06, 0.025)), box_peg(0.016, 0.05)))
    spread = torch.diag(torch.tensor([1e-3, 1e-3, 2e-3, 1e-2, 1e-2, 1e-2], dtype=torch.float64) ** 2)

    def touching(windows: list[ProbeWindow]) -> None:
        part = pyro.sample("part", NormalPose(poses.identity(), spread))
        for k, window in enumerate(windows):
            stamps = len(range(window.first, window.last, 5))
            motion = WindowMotion(proxy, window, 5)
            site = ContactManifold(proxy.gap, part, stamps, 7e-5, 3e-5, motion=motion)
            pyro.sample(f"touch_{k}", site)

    torch.manual_seed(0)
    trace, _ = generate(touching, ([],), {}, 60)
    population = Population(trace)
    plans = [touch(0.0, 0.008), touch(0.2, 0.008), touch(0.0, -0.02), touch(0.015, 0.008), touch(0.0, 0.0)]
    ranking = linearised_information_gain(population, plans, lambda plan: ([action_of(plan)],), seed=0)
    gain = [ranking.of(k).information_gain for k in range(5)]
    assert gain[1] == pytest.approx(0.0, abs=1e-6) and gain[2] == pytest.approx(0.0, abs=1e-3)
    height = math.log(2e-3 / 3e-5)  # the error that all stamps share bounds it
    assert 0.8 * height < gain[0] < 1.6 * height
    # Half of the outer samples are not reached; the touch bounds their height from above.
    assert 0.2 * gain[0] < gain[4] < 0.8 * gain[0]
    assert abs(gain[3] - gain[0]) < 1.0
    # The noise is the same whatever else is asked.
    again = linearised_information_gain(
        population, [plans[3], plans[0], plans[0]], lambda plan: ([action_of(plan)],), seed=0
    )
    assert again.of(1).information_gain == pytest.approx(gain[0], abs=1e-9)
    assert again.difference(again.of(1), again.of(2)) == (0.0, 0.0)


def test_bad_input_is_refused_in_a_sentence() -> None:
    population = drawn(50, 5)
    with pytest.raises(InputError, match="no candidates to choose from"):
        linearised_information_gain(population, [], arguments)
    with pytest.raises(InputError, match="collapsed to a point"):
        linearised_information_gain(at(CENTER.repeat(20, 1)), ASKED, arguments)
    with pytest.raises(InputError, match="the belief has no weight"):
        lost = Population(population.trace, torch.full((50,), -torch.inf, dtype=torch.float64))
        linearised_information_gain(lost, ASKED, arguments)
    for name in ("translation", "rotation"):
        with pytest.raises(InputError, match="modes are to be separated by 0"):
            linearised_information_gain(population, ASKED, arguments, **{name: 0.0})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="a rate of 5 is given without a cost"):
        linearised_information_gain(population, ASKED, arguments, rate=5)
    with pytest.raises(InputError, match="adds no site"):
        linearised_information_gain(population, ASKED, lambda one: (SPREADS, []))
    with pytest.raises(InputError, match="has no `quadratic`"):
        linearised_information_gain(particles(50), [0], lambda axis: (poses.FREE, [axis]))
    with pytest.raises(InputError, match="do not span its 6 free axes"):
        flat = population["part"].clone()
        flat[:, 2] = 0.0
        linearised_information_gain(at(flat), ASKED, arguments)
