"""A switch evaluates for each particle what that particle chose, and nothing else."""

from __future__ import annotations

from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import UniformPose
from bcppl.distributions.support import freedom_of
from bcppl.distributions.switch import Switch
from bcppl.errors import InputError
from bcppl.inference.proposals.coordinates import coordinates_of
from bcppl.poses import Freedom
from bcppl.traces import generate, simulate

MEANS = torch.tensor([-1.0, 2.0, 5.0], dtype=torch.float64)


class Counting(LazyDistribution):
    """Normal about an input, expensive, and counted."""

    cost = 2
    asked: list[int] = []  # noqa: RUF012

    def __init__(self, mean: Tensor) -> None:
        super().__init__(len(mean), ())
        self.center = mean

    def log_prob(self, value: Tensor) -> Tensor:
        self.asked.append(len(self.center))
        return torch.distributions.Normal(self.center, 1.0).log_prob(value)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return torch.distributions.Normal(self.center, 1.0).sample()


def program() -> None:
    which = pyro.sample("which", dist.Categorical(torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)))
    shift = pyro.sample("shift", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
    pyro.sample("seen", Switch(which, lambda k, rows: Counting(MEANS[k] + shift[rows])))


def test_each_particle_is_weighed_by_what_it_chose() -> None:
    torch.manual_seed(0)
    Counting.asked.clear()
    trace, weight = generate(program, (), {"seen": torch.tensor(1.3, dtype=torch.float64)}, 200)
    expected = torch.distributions.Normal(MEANS[trace["which"]] + trace["shift"], 1.0)
    torch.testing.assert_close(weight, expected.log_prob(torch.tensor(1.3, dtype=torch.float64)))
    assert sum(Counting.asked) == 200
    assert trace.distributions["seen"].cost == 2


def test_draws_follow_the_choice() -> None:
    torch.manual_seed(0)
    trace = simulate(program, (), 20_000)
    for k in range(3):
        rows = trace["which"] == k
        assert float((trace["seen"] - trace["shift"])[rows].mean()) == pytest.approx(
            float(MEANS[k]), abs=0.05
        )


def test_what_did_not_change_is_not_asked_again() -> None:
    torch.manual_seed(0)
    trace, _ = generate(program, (), {"seen": torch.tensor(1.3, dtype=torch.float64)}, 50)
    Counting.asked.clear()
    same = trace.at({"shift": trace["shift"].clone()})
    torch.testing.assert_close(same.log_prob("seen"), trace.log_prob("seen"))
    assert Counting.asked == []
    flipped = trace.at({"which": (trace["which"] + 1) % 3})
    assert bool((flipped.log_prob("seen") != trace.log_prob("seen")).all())
    assert sum(Counting.asked) == 50


def test_arithmetic_choices_are_never_taken_for_known() -> None:
    def plain() -> None:
        which = pyro.sample("which", dist.Bernoulli(torch.tensor(0.5, dtype=torch.float64)))
        mean = pyro.sample("mean", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
        pyro.sample("seen", Switch(which, lambda k, rows: dist.Normal(mean[rows] + 10 * k, 1.0)))

    torch.manual_seed(0)
    trace, weight = generate(plain, (), {"seen": torch.tensor(3.0, dtype=torch.float64)}, 20)
    moved = trace.at({"mean": trace["mean"] + 1.0})
    assert bool((moved.log_prob("seen") != weight).all())


def test_what_does_not_fit_is_refused() -> None:
    which = torch.tensor([0, 1, 1])
    with pytest.raises(InputError, match="whole number for each particle"):
        Switch(torch.tensor([0.5, 1.0, 1.0]), lambda k, rows: dist.Normal(torch.zeros(len(rows)), 1.0))
    with pytest.raises(InputError, match=r"choice 0 .*values at the given rows"):
        Switch(which, lambda k, rows: dist.Normal(torch.zeros(3), 1.0))
    with pytest.raises(InputError, match="events of different shapes"):
        Switch(which, lambda k, rows: dist.Normal(torch.zeros(len(rows), k + 1), 1.0).to_event(1))


def test_a_switch_has_the_support_of_its_choices() -> None:
    which = torch.tensor([0, 1, 1])
    one = torch.ones(3, dtype=torch.float64)
    positive = Switch(
        which, lambda k, rows: dist.LogNormal(one[rows], 1.0) if k else dist.Gamma(one[rows], 1.0)
    )
    assert bool((positive.support.check(torch.tensor([1.0, -1.0, 2.0])) == torch.tensor([1, 0, 1])).all())
    with pyro.validation_enabled(False):
        assert positive.log_prob(torch.tensor(-1.0, dtype=torch.float64)).tolist() == [-torch.inf] * 3
    bounded = Switch(which, lambda k, rows: dist.Uniform(0 * one[rows], (k + 1.0) * one[rows]))
    assert bounded.support.upper_bound.tolist() == [1.0, 2.0, 2.0]
    with pytest.raises(InputError, match="different kinds"):
        Switch(which, lambda k, rows: dist.Normal(one[rows], 1.0) if k else dist.Gamma(one[rows], 1.0))

    def program() -> None:
        choice = pyro.sample("which", dist.Bernoulli(torch.tensor(0.5, dtype=torch.float64)))
        rate = torch.ones_like(choice)
        size = pyro.sample("size", Switch(choice, lambda k, rows: dist.Exponential((k + 1) * rate[rows])))
        count = Switch(choice, lambda k, rows: dist.Poisson(size[rows]))
        pyro.sample("count", count)

    trace, _ = generate(program, (), {}, 3)
    torch.testing.assert_close(coordinates_of(trace, "size").places(trace["size"])[:, 0], trace["size"].log())
    with pytest.raises(InputError, match="discrete"):
        coordinates_of(trace, "count")


def test_a_switch_over_poses_has_their_free_axes() -> None:
    prior = UniformPose(poses.identity(), [0.01, 0.0, 0.0], 0.1, rotation="z")
    other = UniformPose(poses.identity(), [0.01, 0.01, 0.0], 0.1, rotation="z")
    which = torch.tensor([0, 1, 1])
    assert freedom_of(Switch(which, lambda k, rows: prior.expand([len(rows)]))) == Freedom("x", "z")
    with pytest.raises(InputError, match="different free axes"):
        Switch(which, lambda k, rows: (other if k else prior).expand([len(rows)]))


def test_the_cost_does_not_hang_on_what_was_chosen() -> None:
    one = torch.ones(3, dtype=torch.float64)

    def build(k: int, rows: Tensor) -> Any:
        return Counting(one[rows]) if k else dist.Normal(one[rows], 1.0)

    for which in ([0, 0, 0], [0, 1, 1], [1, 1, 1]):
        assert Switch(torch.tensor(which), build, cost=2).cost == 2
    with pytest.raises(InputError, match="as cost="):
        Switch(torch.tensor([0, 1, 1]), build)


def test_draws_of_different_precision_are_kept() -> None:
    kinds = (torch.float32, torch.float64)
    third = torch.tensor(1 / 3, dtype=torch.float64)
    drawn = Switch(torch.tensor([0, 1]), lambda k, rows: dist.Delta(third.to(kinds[k]).expand(1))).sample()
    assert drawn.dtype == torch.float64
    assert float(drawn[1]) == 1 / 3
