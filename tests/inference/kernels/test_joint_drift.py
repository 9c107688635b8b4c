"""The walk over several latent values: it leaves a ridge's exact target invariant, and comes far along it."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import Proposal, drift
from bcppl.inference.proposals.coordinates import continuous_addresses
from bcppl.inference.proposals.walk import joint_drift
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Trace, simulate
from tests.inference.kernels.exact_targets import CENTER
from tests.invariance import largest_z, matrix, number

DRAWS = 7_000
SOUND, BROKEN = 4.5, 8.0  # as in the tests of other proposals
NARROW = 0.05


def ridge() -> None:
    """A pose, a positive number, and what is tied to both: the pose's x plus the number's logarithm."""
    pose = pyro.sample("pose", NormalPose(CENTER, matrix([0.5, 0.3, 0.4, 0.6, 0.5, 0.7])))
    size = pyro.sample("size", dist.LogNormal(number(0.0), number(0.5)))
    pyro.sample("seen", dist.Normal(pose[..., 0] - CENTER[0] + torch.log(size), NARROW))
    pyro.sample("which", dist.Bernoulli(torch.full_like(size, 0.3)))


def of(trace: Trace) -> Tensor:
    """Expectations (N, K) of all three together."""
    tangent = poses.local(CENTER, trace["pose"])
    x = torch.cat([tangent, torch.log(trace["size"])[:, None], trace["seen"][:, None]], dim=1)
    return torch.cat([x, (x[:, :, None] * x[:, None, :]).flatten(1), torch.cos(3.0 * x)], dim=1)


def moved(proposal: Proposal, times: int = 2) -> tuple[Trace, Trace, float]:
    """Exact draws before and after some moves that were fitted to draws of their own, and the acceptance."""
    torch.manual_seed(3)
    move = metropolis_hastings(proposal)(Population(simulate(ridge, (), 60)))
    before = after = simulate(ridge, (), DRAWS)
    shares = []
    for _ in range(times):
        after, accepted = move(after, POSTERIOR)
        shares.append(float(accepted.mean()))
    return before, after, sum(shares) / times


@pytest.mark.parametrize("addresses", [("pose", "size", "seen"), ("seen", "size", "pose"), ("seen", "pose")])
def test_it_leaves_the_target_invariant(addresses: tuple[str, ...]) -> None:
    before, after, acceptance = moved(joint_drift(*addresses, scales=(0.3, 1.5)))
    assert largest_z(of(before), of(after)) < SOUND
    assert 0.05 < acceptance < 0.95


def test_mutant_without_the_jacobian_of_the_positive_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "bcppl.inference.proposals.coordinates.Unflattened.log_abs_det_jacobian",
        lambda self, x, y: torch.zeros(len(x), dtype=torch.float64),
    )
    before, after, _ = moved(joint_drift("pose", "size", "seen", scales=(0.3, 1.5)))
    assert largest_z(of(before), of(after)) > BROKEN


def test_it_comes_farther_along_a_ridge_than_each_value_alone() -> None:
    def far(proposal: Proposal) -> float:
        before, after, _ = moved(proposal)
        return float((after["seen"] - before["seen"]).square().mean())

    together = far(joint_drift("seen", "size", "pose", scales=(0.3, 1.5)))
    assert together > 5.0 * far(drift("seen", (0.3, 1.5)))


def test_discrete_values_are_not_moved() -> None:
    trace = simulate(ridge, (), 5)
    assert continuous_addresses(trace) == ["pose", "size", "seen"]
    with pytest.raises(InputError, match="which"):
        joint_drift("pose", "which").fit(Population(trace))


@pytest.mark.parametrize("addresses", [(), ("pose",), ("pose", "pose")])
def test_it_refuses_fewer_than_two_values(addresses: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="two or more"):
        joint_drift(*addresses)
