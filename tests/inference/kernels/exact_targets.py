"""Programs whose posterior can be drawn from exactly, for tests of proposals and kernels."""

from __future__ import annotations

import math
from collections.abc import Callable

import pyro
import pyro.distributions as dist
import torch

from bcppl import poses
from bcppl.distributions.poses import MixturePose, NormalPose, UniformPose
from bcppl.poses import Freedom
from bcppl.traces import Trace, generate, simulate
from tests.invariance import matrix, number

COVARIANCE = matrix([[1.0, 0.8, 0.0], [0.8, 1.0, 0.3], [0.0, 0.3, 0.5]])
SEEN = matrix([1.0, -0.5, 2.0])


def correlated() -> None:
    x = pyro.sample("x", dist.MultivariateNormal(torch.zeros(3, dtype=torch.float64), COVARIANCE))
    pyro.sample("y", dist.Normal(x, 0.7).to_event(1))


def correlated_draws(count: int) -> Trace:
    """The posterior by Gauss: precision S^-1 + I / s^2."""
    posterior = torch.linalg.inv(torch.linalg.inv(COVARIANCE) + torch.eye(3, dtype=torch.float64) / 0.49)
    exact = torch.distributions.MultivariateNormal(posterior @ SEEN / 0.49, posterior)
    return generate(correlated, (), {"y": SEEN}, count)[0].at({"x": exact.sample((count,))})


CENTER = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
UPRIGHT = poses.as_pose([0.1, -0.2, 0.3, math.cos(0.4), 0.0, 0.0, math.sin(0.4)])
WIDE = matrix([0.2, 0.1, 0.3, 1.1, 0.9, 1.3])
PLANAR = Freedom("xy", "z")


def wide() -> None:
    pyro.sample("pose", NormalPose(CENTER, WIDE))


def planar() -> None:
    pyro.sample(
        "pose", NormalPose(CENTER, matrix([[0.04, 0.0, 0.1], [0.0, 0.01, 0.0], [0.1, 0.0, 1.0]]), PLANAR)
    )


def on_a_table() -> None:
    spread = matrix([[0.04, 0.0, 0.1], [0.0, 0.01, 0.0], [0.1, 0.0, 1.0]])
    pyro.sample("pose", NormalPose(UPRIGHT, spread, PLANAR))


def edged() -> None:
    pyro.sample("pose", UniformPose(CENTER, (0.1, 0.02, 0.0), 1.2))


def two_modes() -> None:
    """A part and the same turned by a quarter and a bit, less likely."""
    other = poses.retract(CENTER, matrix([0.05, 0.0, 0.02, 0.0, 0.1, 1.6]))
    spread = torch.diag(matrix([0.01, 0.02, 0.01, 0.1, 0.05, 0.1]) ** 2)
    pyro.sample("pose", MixturePose(matrix([0.7, 0.3]).log(), torch.stack([CENTER, other]), spread))


def bounded() -> None:
    """Values whose support is an interval that depends on another, positive, a simplex, single precision."""
    top = pyro.sample("top", dist.Gamma(number(2.0), number(1.5)))
    pyro.sample("below", dist.Uniform(torch.zeros_like(top), top))
    pyro.sample("shares", dist.Dirichlet(matrix([2.0, 0.7, 1.5])))
    pyro.sample("single", dist.LogNormal(torch.tensor(0.1), torch.tensor(0.6)))
    with pyro.plate("rows", 3, dim=-2):
        pyro.sample("each", dist.Beta(top, number(1.5)).expand([3, *top.shape]))


def draws_of(program: Callable[[], None]) -> Callable[[int], Trace]:
    return lambda count: simulate(program, (), count)
