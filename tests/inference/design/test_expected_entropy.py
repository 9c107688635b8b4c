"""Expected posterior entropy against exact answers: toys in which it is a sum, and a closed form."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.inference.design import (
    Ranking,
    discrete_entropy,
    expected_entropy,
    expected_information_gain,
    mixture_entropy,
    neighbour_entropy,
    weight_entropy,
)
from bcppl.inference.design.rules import by_reweighted_gain
from bcppl.inference.population import Population
from bcppl.models import load_recording, look_and_touch
from bcppl.sensors import View
from bcppl.sensors.candidates import with_candidates
from bcppl.traces import generate, simulate
from tests.invariance import matrix

# A measurement reads x by a table of probabilities, a row for each state.


def readings(prior: Tensor, tables: list[Tensor]) -> None:
    x = pyro.sample("x", dist.Categorical(prior))
    for k, table in enumerate(tables):
        pyro.sample(f"y_{k}", dist.Categorical(table[x]))


def states(prior: Tensor, done: list[Tensor]) -> Population:
    """One particle for each state, weighted by the prior."""
    count = len(prior)
    trace, log_weights = generate(
        readings, (prior, done), {}, count, choices={"x": torch.arange(count, dtype=torch.int64)}
    )
    return Population(trace, log_weights)


def entropy(chances: Tensor) -> Tensor:
    return torch.special.entr(chances).sum(-1)


def exact_entropy(prior: Tensor, *tables: Tensor) -> float:
    """Expected posterior entropy after tables are read one after another: a sum over what is read."""
    joint = prior[:, None]
    for table in tables:
        joint = (joint[:, :, None] * table[:, None, :]).reshape(len(prior), -1)
    chance = joint.sum(0)
    kept = chance > 0
    return float(chance[kept] @ entropy((joint[:, kept] / chance[kept]).T))


def rank(prior: Tensor, tables: list[Tensor], **options: Any) -> Ranking:
    options = {"seed": 0, "outer_samples": 600, **options}
    return expected_information_gain(
        states(prior, []), tables, lambda table: (prior, [table]), options.pop("entropy", None), **options
    )


def random_table(states: int, outcomes: int, sharpness: float) -> Tensor:
    return torch.softmax(sharpness * torch.randn(states, outcomes, dtype=torch.float64), dim=1)


def line_tables(noise: float) -> list[Tensor]:
    """Which of 6 places on a line, read by a ruler that is wrong, or by whether it is left of 3."""
    place = torch.arange(6, dtype=torch.float64)
    ruler = torch.softmax(-0.5 * ((place[:, None] - place) / noise) ** 2, dim=1)
    side = torch.stack([0.9 * (place < 3) + 0.05, 0.95 - 0.9 * (place < 3)], dim=1).double()
    return [ruler, side]


def grid_tables(noise: float) -> list[Tensor]:
    """Which of 5 x 4 places in a plane, read along three directions."""
    places = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0)).double()
    marks = torch.linspace(-2.0, 6.0, 17, dtype=torch.float64)
    tables = []
    for direction in ([1.0, 0.0], [0.0, 1.0], [0.6, -0.8]):
        along = places @ matrix(direction)
        tables.append(torch.softmax(-0.5 * ((along[:, None] - marks) / noise) ** 2, dim=1))
    return tables


def line_prior() -> Tensor:
    return matrix([0.05, 0.3, 0.1, 0.25, 0.1, 0.2])


def worst_z(ranking: Ranking, prior: Tensor, tables: list[Tensor]) -> float:
    """How many standard errors the estimates are off, at most."""
    return max(
        abs(p.entropy - exact_entropy(prior, tables[p.number])) / p.standard_error for p in ranking.utilities
    )


@pytest.mark.parametrize("noise", [0.4, 1.0])
def test_on_a_line_it_is_the_exact_sum(noise: float) -> None:
    tables = line_tables(noise)
    ranking = rank(line_prior(), tables)
    assert ranking.entropy == pytest.approx(float(entropy(line_prior())))
    assert worst_z(ranking, line_prior(), tables) < 3.0
    assert all(p.standard_error < 0.03 for p in ranking.utilities)
    # Every particle once: six draws have a large variance, but no bias.
    everyone = [rank(line_prior(), tables, outer_samples=None, seed=seed) for seed in range(50)]
    assert len(everyone[0].best.gains) == 6
    for k, table in enumerate(tables):
        found = torch.tensor([ranking.of(k).entropy for ranking in everyone], dtype=torch.float64)
        assert (
            abs(float(found.mean()) - exact_entropy(line_prior(), table)) < 3.0 * float(found.std()) / 50**0.5
        )


def test_in_a_plane_it_is_the_exact_sum() -> None:
    torch.manual_seed(1)
    prior = torch.softmax(torch.randn(20, dtype=torch.float64), 0)
    for noise in (0.5, 1.5):
        assert worst_z(rank(prior, grid_tables(noise)), prior, grid_tables(noise)) < 3.0


def test_the_standard_error_is_that_of_repeated_estimates_or_a_little_more() -> None:
    tables = line_tables(1.0)
    found = [rank(line_prior(), tables, outer_samples=60, seed=seed).of(0) for seed in range(60)]
    spread = float(torch.tensor([p.information_gain for p in found]).std())
    stated = sum(p.standard_error for p in found) / len(found)
    assert 0.8 < stated / spread < 2.0


def test_a_flipped_sign_or_forgotten_weights_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    tables, right = line_tables(1.0), expected_entropy.posterior_entropies
    mutants: list[Callable[..., Tensor]] = [
        lambda weights, likelihoods, of: right(weights, -likelihoods, of),
        lambda weights, likelihoods, of: right(torch.zeros_like(weights), likelihoods, of),
        lambda weights, likelihoods, of: -right(weights, likelihoods, of),
    ]
    for mutant in mutants:
        monkeypatch.setattr(expected_entropy, "posterior_entropies", mutant)
        assert worst_z(rank(line_prior(), tables), line_prior(), tables) > 5.0
    monkeypatch.setattr(expected_entropy, "posterior_entropies", right)
    unweighted = Population(states(line_prior(), []).trace, torch.zeros(6, dtype=torch.float64))
    ranking = expected_information_gain(
        unweighted, tables, lambda table: (line_prior(), [table]), outer_samples=600, seed=0
    )
    assert worst_z(ranking, line_prior(), tables) > 5.0


def test_the_choice_is_right_in_60_of_60_instances() -> None:
    torch.manual_seed(2)
    right = done = 0
    while done < 60:
        prior = torch.softmax(torch.randn(8, dtype=torch.float64), 0)
        tables = [random_table(8, 4, float(s)) for s in 3.0 * torch.rand(4)]
        exact = torch.tensor([exact_entropy(prior, table) for table in tables])
        if float(exact.sort().values.diff()[0]) < 0.1:
            continue
        done += 1
        right += rank(prior, tables, outer_samples=300, seed=done).best.number == int(exact.argmin())
    assert right == 60


def test_gains_fall_with_the_noise_to_nothing() -> None:
    noises = [0.2, 0.4, 0.6, 0.9, 1.3, 2.0, 4.0]
    tables = [line_tables(noise)[0] for noise in noises]
    gains = [rank(line_prior(), tables).of(k).information_gain for k in range(len(noises))]
    assert gains == sorted(gains, reverse=True)
    nothing = matrix([[0.2, 0.5, 0.3]]).expand(6, 3)
    utility = rank(line_prior(), [*tables, nothing]).of(len(tables))
    assert abs(utility.information_gain) < 1e-12 and utility.standard_error < 1e-12
    assert utility.number == rank(line_prior(), [*tables, nothing])[-1].number


def test_information_is_never_lost_in_expectation() -> None:
    torch.manual_seed(3)
    for seed in range(20):
        prior = torch.softmax(2.0 * torch.randn(5, dtype=torch.float64), 0)
        utility = rank(prior, [random_table(5, 3, 0.5)], seed=seed).best
        assert utility.information_gain > -3.0 * utility.standard_error


def test_common_random_numbers_sharpen_the_difference() -> None:
    # Two rulers that differ a little.
    tables = [line_tables(0.8)[0], line_tables(0.9)[0]]
    pairs = [rank(line_prior(), tables, outer_samples=50, seed=seed) for seed in range(40)]
    others = [rank(line_prior(), tables[1:], outer_samples=50, seed=100 + seed).best for seed in range(40)]
    common = torch.tensor([r.of(0).information_gain - r.of(1).information_gain for r in pairs])
    apart = torch.tensor(
        [r.of(0).information_gain - o.information_gain for r, o in zip(pairs, others, strict=True)]
    )
    assert float(common.std()) < 0.4 * float(apart.std())
    exact = exact_entropy(line_prior(), tables[1]) - exact_entropy(line_prior(), tables[0])
    difference, error = pairs[0].difference(pairs[0].of(0), pairs[0].of(1))
    assert abs(difference - exact) < 3.0 * error
    assert error < 0.6 * pairs[0].of(0).standard_error


def linear(scales: list[Tensor]) -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(2, dtype=torch.float64), matrix([2.0, 0.5])).to_event(1))
    for k, row in enumerate(scales):
        pyro.sample(f"y_{k}", dist.Normal(x @ row, 0.7).to_event(0))


@pytest.mark.parametrize("measure", ["modes", "neighbours"])
def test_a_linear_gaussian_program_has_the_closed_form(measure: str) -> None:
    torch.manual_seed(4)
    population = Population(simulate(linear, ([],), 3000))
    rows = [matrix([1.0, 0.0]), matrix([0.0, 1.0]), matrix([0.6, 0.8])]
    kind = mixture_entropy("x") if measure == "modes" else neighbour_entropy("x", 5)
    ranking = expected_information_gain(
        population, rows, lambda row: ([row],), kind, outer_samples=200, seed=0
    )
    covariance = torch.cov(population["x"].T)
    for k, row in enumerate(rows):
        utility = ranking.of(k)
        # 1/2 log det of the covariance before over that after.
        exact = 0.5 * math.log1p(float(row @ covariance @ row) / 0.49)
        assert utility.information_gain == pytest.approx(exact, abs=3 * utility.standard_error + 0.02)


def test_the_gain_of_a_discrete_value_is_that_of_its_marginal() -> None:
    # Ten particles for each state, differently weighted: the weights' entropy would count them all.
    torch.manual_seed(5)
    prior, tables = line_prior(), line_tables(0.7)
    which = torch.arange(6).repeat(10)
    shares = torch.rand(60, dtype=torch.float64)
    shares = shares * (prior / torch.zeros(6, dtype=torch.float64).index_add_(0, which, shares))[which]
    trace, _ = generate(readings, (prior, []), {}, 60, choices={"x": which})
    ranking = expected_information_gain(
        Population(trace, shares.log()),
        tables,
        lambda table: (prior, [table]),
        discrete_entropy("x"),
        outer_samples=600,
        seed=0,
    )
    assert ranking.entropy == pytest.approx(float(entropy(prior)))
    assert worst_z(ranking, prior, tables) < 3.0


def bits_tables() -> list[Tensor]:
    """Four bits: one table reads the first, the third and much of the second, the others two bits each."""
    outcomes = list(itertools.product((0, 1), repeat=4))
    flip = 0.11
    tables = [
        torch.zeros(16, 8, dtype=torch.float64),
        *(torch.zeros(16, 4, dtype=torch.float64) for _ in "ab"),
    ]
    for k, (a, b, c, d) in enumerate(outcomes):
        for seen, chance in ((b, 1.0 - flip), (1 - b, flip)):
            tables[0][k, 4 * a + 2 * c + seen] = chance
        tables[1][k, 2 * a + b] = 1.0
        tables[2][k, 2 * c + d] = 1.0
    return [0.97 * table + 0.03 / table.shape[1] for table in tables]


def best_of_two(prior: Tensor, tables: list[Tensor], first: int) -> float:
    """Expected entropy after a table and then the table that is best by what was read: a sum."""
    total = 0.0
    for chance, posterior in after(prior, tables[first]):
        total += chance * min(exact_entropy(posterior, table) for table in tables)
    return total


def after(prior: Tensor, table: Tensor) -> list[tuple[float, Tensor]]:
    joint = prior[:, None] * table
    return [(float(column.sum()), column / column.sum()) for column in joint.T]


@pytest.mark.long
def test_two_steps_ahead_are_the_exact_sum_and_right_where_greedy_is_wrong() -> None:
    torch.manual_seed(6)
    prior, tables = torch.softmax(0.3 * torch.randn(16, dtype=torch.float64), 0), bits_tables()
    greedy = rank(prior, tables, outer_samples=400)
    ahead = rank(prior, tables, outer_samples=400, horizon=2, shortlist=3)
    exact = [best_of_two(prior, tables, k) for k in range(3)]
    assert greedy.best.number == 0 and max(exact[1:]) < exact[0] - 0.15
    assert ahead.best.number in (1, 2)
    for utility in ahead:
        assert abs(utility.entropy - exact[utility.number]) < 3.0 * utility.standard_error < 0.2
    then = ahead.of(1).second
    assert then is not None and bool((then == 2).all()), "after one half, the other"
    # With three on the list and one looked at, the others stay at one step and behind.
    short = rank(prior, tables, outer_samples=100, horizon=2, shortlist=1)
    assert [p.horizon for p in short] == [2, 1, 1] and short.best.number == 0


def test_reading_twice_has_noise_of_its_own_each_time() -> None:
    prior, table = line_prior(), line_tables(1.0)[0]
    ahead = rank(prior, [table], outer_samples=600, horizon=2).best
    assert abs(ahead.entropy - exact_entropy(prior, table, table)) < 3.0 * ahead.standard_error


def test_costs_are_traded_against_information() -> None:
    prior, tables = line_prior(), line_tables(0.5)
    free = rank(prior, tables)
    assert free.best.number == 0
    gains = [free.of(k).information_gain for k in range(2)]
    seconds = {0: 10.0, 1: 1.0}
    names = {id(table): k for k, table in enumerate(tables)}
    rate = (gains[0] - gains[1]) / 9.0

    def cost(table: Tensor) -> float:
        return seconds[names[id(table)]]

    assert rank(prior, tables, cost=cost, rate=0.99 * rate).best.number == 0
    dear = rank(prior, tables, cost=cost, rate=1.01 * rate)
    assert dear.best.number == 1 and dear.best.cost == pytest.approx(1.01 * rate)
    assert dear.best.information_gain == gains[1], "the gain is not touched by the cost"
    both = rank(
        prior, tables, cost=lambda t: {"time": cost(t), "force": 2.0}, rate={"time": rate, "force": 0.1}
    )
    assert both.of(0).cost == pytest.approx(10.0 * rate + 0.2)
    # A second step is taken only where it is worth its cost.
    never = rank(prior, tables, cost=lambda t: 50.0, horizon=2, outer_samples=50)
    then = never.best.second
    assert then is not None and bool((then == -1).all())
    assert never.best.cost == 50.0
    by_name = expected_information_gain(
        states(prior, []),
        ["ruler", "side"],
        lambda name: (prior, [tables[0 if name == "ruler" else 1]]),
        cost={"ruler": 10.0, "side": 1.0},
        rate=1.01 * rate,
        outer_samples=600,
        seed=0,
    )
    assert by_name.best.candidate == "side"


def test_the_seed_is_the_generators_and_nothing_else_is_drawn_from_it() -> None:
    torch.manual_seed(9)
    first = rank(line_prior(), line_tables(1.0), seed=None)
    state = torch.get_rng_state()
    torch.manual_seed(9)
    again = rank(line_prior(), line_tables(1.0)[:1], seed=None)
    assert torch.equal(state, torch.get_rng_state()), "however many candidates there are"
    assert torch.equal(first.of(0).gains, again.best.gains)
    assert "entropy now" in str(first) and len(first) == 2


def test_measurements_that_were_made_stay() -> None:
    prior, (ruler, side) = line_prior(), line_tables(0.6)
    trace, log_weights = generate(
        readings, (prior, [side]), {"y_0": torch.tensor(0)}, 6, choices={"x": torch.arange(6)}
    )
    ranking = expected_information_gain(
        Population(trace, log_weights),
        [ruler, side],
        lambda table: (prior, [side, table]),
        weight_entropy(),
        outer_samples=600,
        seed=0,
    )
    posterior = prior * side[:, 0] / (prior @ side[:, 0])
    assert worst_z(ranking, posterior, [ruler, side]) < 3.0
    assert ranking.entropy == pytest.approx(float(entropy(posterior)))


def test_errors_that_another_camera_brings_are_not_observed() -> None:
    """From six metres farther a camera shows nothing, and its errors are none the wiser either."""
    recording = load_recording("peg_probe")
    view = next(m.action for m in recording.measurements if isinstance(m.action, View))
    world_from_camera = torch.as_tensor(view.camera.world_from_camera)

    def behind(name: str, by: float) -> View:
        moved = world_from_camera.clone()
        moved[:3] -= by * poses.rotation_matrix(world_from_camera)[:, 2]
        return replace(view, camera=replace(view.camera, name=name, world_from_camera=moved.numpy()))

    views = [behind("as recorded", 0.0), behind("far", 6.0)]
    model = look_and_touch.model
    scene = model.prepare(with_candidates(recording, views))
    torch.manual_seed(0)
    spread = torch.tensor([0.002] * 3 + [0.01] * 3, dtype=torch.float64)
    near = poses.retract(
        torch.as_tensor(recording.truth).expand(300, 7), spread * torch.randn(300, 6).double()
    )
    trace, _ = generate(model.program, (scene, []), {}, 300, {model.pose: near})
    ranking = by_reweighted_gain(model.pose, outer_samples=8, seed=0)(Population(trace), views, scene)
    gains = {each.candidate.camera.name: each.information_gain for each in ranking}
    assert gains["as recorded"] > 2.0 and abs(gains["far"]) < 0.1
