"""Programs whose posterior is drawn exactly, and inferences that are wrong in one way each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.inference.calibration import Joint
from bcppl.inference.population import Population
from bcppl.traces import generate
from tests.invariance import matrix, number

PARTICLES = 100
# y = DESIGN (x_0, x_1, offset) + noise
DESIGN, NOISE = matrix([[1.0, 0.8, 1.0], [0.0, 1.0, -0.5]]), 0.5
Data = Mapping[str, Tensor]


def sought() -> None:
    """A position, a nuisance parameter, and two readings, all of them normal."""
    x = pyro.sample("x", dist.Normal(torch.zeros(2).double(), 1.0).to_event(1))
    offset = pyro.sample("offset", dist.Normal(number(0.0), 1.0))
    both = torch.cat([x, offset[..., None]], dim=-1)
    pyro.sample("y", dist.Normal(both @ DESIGN.T, NOISE).to_event(1))


def folded() -> None:
    """A value whose square is read: its posterior has two modes, of unequal mass."""
    x = pyro.sample("x", dist.Normal(number(0.3), 1.0))
    pyro.sample("y", dist.Normal(x**2, 0.3))


@dataclass(frozen=True)
class Posterior:
    """The normal posterior of `sought`: mean (3,) and covariance (3, 3)."""

    mean: Tensor
    covariance: Tensor


Mutation = Callable[[Posterior], Posterior]


def exact(posterior: Posterior) -> Posterior:
    """No mutation."""
    return posterior


def scaled(factor: float, posterior: Posterior) -> Posterior:
    """Standard deviations times a factor."""
    return Posterior(posterior.mean, factor**2 * posterior.covariance)


def shifted(by: float, posterior: Posterior) -> Posterior:
    """The first coordinate's mean moved, in standard deviations of the posterior."""
    away = torch.zeros(3).double()
    away[0] = by * posterior.covariance[0, 0].sqrt()
    return Posterior(posterior.mean + away, posterior.covariance)


def ignorant(posterior: Posterior) -> Posterior:
    """The prior: the data are ignored."""
    return Posterior(torch.zeros(3).double(), torch.eye(3).double())


def uncorrelated(posterior: Posterior) -> Posterior:
    """Each coordinate has its own distribution, and they are independent."""
    return Posterior(posterior.mean, posterior.covariance.diagonal().diag())


def flipped_nuisance(posterior: Posterior) -> Posterior:
    """The dependence of the position on the nuisance parameter has the wrong sign."""
    flip = torch.tensor([1.0, 1.0, -1.0]).double()
    return Posterior(posterior.mean, flip[:, None] * posterior.covariance * flip)


def held_nuisance(posterior: Posterior) -> Posterior:
    """The nuisance parameter is held at its mean, so that the position is too certain."""
    own, cross, both = posterior.covariance[:2, :2], posterior.covariance[:2, 2:], posterior.covariance[2, 2]
    covariance = torch.eye(3).double() * 1e-6
    covariance[:2, :2] = own - cross @ cross.T / both
    return Posterior(posterior.mean, covariance)


def normal_inference(mutation: Mutation, data: Data) -> Population:
    """Independent draws of the posterior of `sought`, mutated."""
    precision = torch.eye(3).double() + DESIGN.T @ DESIGN / NOISE**2
    covariance = torch.linalg.inv(precision)
    posterior = mutation(Posterior(covariance @ DESIGN.T @ data["y"] / NOISE**2, covariance))
    root = torch.linalg.cholesky(posterior.covariance)
    values = posterior.mean + torch.randn(PARTICLES, 3, dtype=torch.float64) @ root.T
    trace, _ = generate(sought, (), data, PARTICLES, choices={"x": values[:, :2], "offset": values[:, 2]})
    return Population(trace)


def folded_inference(modes: str, data: Data) -> Population:
    """Independent draws of the posterior of `folded`, by its density on a grid; perhaps of one mode."""
    grid = torch.linspace(-5.0, 5.0, 4001, dtype=torch.float64)
    density = dist.Normal(0.3, 1.0).log_prob(grid) + dist.Normal(grid**2, 0.3).log_prob(data["y"])
    if modes == "positive":
        density = density.masked_fill(grid < 0, -torch.inf)
    if modes == "one":
        density = density.masked_fill(grid.sign() != torch.randn(()).sign(), -torch.inf)
    if modes == "equal":
        density = torch.logaddexp(density, density.flip(0))
    places = torch.multinomial(density.softmax(0), PARTICLES, replacement=True)
    values = grid[places] + 0.0025 * (torch.rand(PARTICLES, dtype=torch.float64) - 0.5)
    trace, _ = generate(folded, (), data, PARTICLES, choices={"x": values})
    return Population(trace)


NORMAL, FOLDED = Joint(sought, (), ("y",)), Joint(folded, (), ("y",))
SOUND = {
    "normal": (NORMAL, partial(normal_inference, exact)),
    "two modes": (FOLDED, partial(folded_inference, "both")),
}
MUTANTS = {
    "too narrow by a fifth": (NORMAL, partial(normal_inference, partial(scaled, 0.8))),
    "too narrow by a half": (NORMAL, partial(normal_inference, partial(scaled, 0.5))),
    "too wide by a quarter": (NORMAL, partial(normal_inference, partial(scaled, 1.25))),
    "shifted by 0.3 sd": (NORMAL, partial(normal_inference, partial(shifted, 0.3))),
    "shifted by 1 sd": (NORMAL, partial(normal_inference, partial(shifted, 1.0))),
    "the prior": (NORMAL, partial(normal_inference, ignorant)),
    "correlation dropped": (NORMAL, partial(normal_inference, uncorrelated)),
    "nuisance of the wrong sign": (NORMAL, partial(normal_inference, flipped_nuisance)),
    "nuisance held": (NORMAL, partial(normal_inference, held_nuisance)),
    "always the positive mode": (FOLDED, partial(folded_inference, "positive")),
    "one mode at random": (FOLDED, partial(folded_inference, "one")),
    "modes of equal mass": (FOLDED, partial(folded_inference, "equal")),
}
