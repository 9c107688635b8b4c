"""Rejecting before physics: the same decisions as evaluating everything, for less work."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.contact import ChamferContacts, PegPose
from bcppl.distributions.lazy import LazyDistribution
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import generate


class Dear(LazyDistribution):
    """A site whose log-probability is -x^2, which counts the particles it is asked for."""

    cost = 2
    asked: list[int] = []  # noqa: RUF012

    def __init__(self, value: Tensor, bound: float) -> None:
        self.value, self.bound = value, bound
        super().__init__(len(value), ())

    @property
    def log_prob_bound(self) -> float:
        return self.bound

    def log_prob(self, value: Tensor) -> Tensor:
        Dear.asked.append(len(self.value))
        return -(self.value**2)


def program(bound: float) -> None:
    x = pyro.sample("x", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 2.0))
    for k in range(4):
        pyro.sample(f"dear_{k}", Dear(x, bound))


OBSERVED = {f"dear_{k}": torch.tensor(0.0) for k in range(4)}


@pytest.mark.parametrize("target", [POSTERIOR, Target({"dear_3": 0.25, "dear_1": 0.0})])
@pytest.mark.parametrize("bound", [0.0, math.inf])
def test_early_rejection_decides_as_full_evaluation_does(target: Target, bound: float) -> None:
    torch.manual_seed(0)
    trace, _ = generate(program, (bound,), OBSERVED, 400)
    needed = -12.0 * torch.rand(400, dtype=torch.float64)
    expected = (target(trace) > needed).nonzero().flatten()
    fresh, _ = generate(program, (bound,), OBSERVED, 400)
    fresh = fresh.at({"x": trace["x"]})
    Dear.asked.clear()
    index, survivors = target.above(fresh, needed)
    assert torch.equal(index, expected)
    assert torch.equal(survivors["x"], trace["x"][expected])
    torch.testing.assert_close(target(survivors), target(trace)[expected])
    sites = 4 if target is POSTERIOR else 3
    if bound == 0.0:
        assert sum(Dear.asked) < 0.8 * sites * 400
    else:
        assert Dear.asked == [400] * sites


def test_a_bound_below_the_truth_would_change_decisions() -> None:
    """The mutant: a bound that can be exceeded drops particles that pass."""
    torch.manual_seed(0)
    trace, _ = generate(program, (-3.0,), OBSERVED, 400)
    needed = torch.full((400,), -6.0, dtype=torch.float64)
    fresh, _ = generate(program, (-3.0,), OBSERVED, 400)
    index, _ = POSTERIOR.above(fresh.at({"x": trace["x"]}), needed)
    assert len(index) < int((POSTERIOR(trace) > needed).sum())


class Still:
    """A track of one particle whose peg stands still and feels nothing."""

    def __init__(self, pose: Tensor) -> None:
        self.pose = pose
        self.inputs, self.diverged = (pose,), torch.zeros(len(pose), dtype=torch.bool)

    def __len__(self) -> int:
        return len(self.pose)

    def window(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        nothing = torch.full((len(self.pose), last - first, 3), math.nan, dtype=torch.float64)
        return nothing, self.pose[:, None].expand(-1, last - first, 7)


@pytest.mark.parametrize("rotation_scale", [1e-3, 0.02, 0.19])
def test_the_bounds_of_contact_likelihoods_are_reached_and_never_exceeded(rotation_scale: float) -> None:
    torch.manual_seed(1)
    spread = torch.tensor([2e-4] * 3 + [2 * rotation_scale] * 3, dtype=torch.float64)
    pose = poses.retract(poses.identity(2000), spread * torch.randn(2000, 6, dtype=torch.float64))
    pose[0] = poses.identity()
    for first in (0, 7, 50):
        site = PegPose(Still(pose), first, first + 50, 3e-4, rotation_scale, every=25)
        scores = site.log_prob(poses.identity(50))
        assert float(scores[0]) == pytest.approx(site.log_prob_bound, abs=1e-9)
        assert float(scores.max()) <= site.log_prob_bound + 1e-9
    empty = ChamferContacts(Still(pose), 0, 5, 0.001, 1e-5)
    assert float(empty.log_prob(torch.full((5, 3), math.nan)).max()) == empty.log_prob_bound == 0.0
    assert math.isinf(PegPose(Still(pose), 0, 5, 3e-4, 0.5).log_prob_bound)
