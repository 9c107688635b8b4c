"""Problems of one latent vector x whose evidence and posterior moments are known, as Pyro programs."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from scipy import integrate, special, stats
from torch import Tensor

FLOAT = torch.float64


class Problem(NamedTuple):
    """A program with a latent "x" (D,) and an observed "y", and its exact answers.

    Attributes:
        program: without arguments.
        observed: the value of "y".
        log_evidence: exact, or to the third decimal.
        mean, variance: (D,) of the posterior; NaN where they are not known.
    """

    program: Callable[[], None]
    observed: Tensor
    log_evidence: float
    mean: Tensor
    variance: Tensor

    @property
    def dimension(self) -> int:
        """D."""
        return len(self.mean)


class Likelihood(dist.TorchDistribution):
    """A likelihood given as a function of x (N, D); what is observed counts for nothing."""

    arg_constraints: dict[str, object] = {}  # noqa: RUF012
    support = dist.constraints.real

    def __init__(self, x: Tensor, log_likelihood: Callable[[Tensor], Tensor]) -> None:
        self.x, self.log_likelihood = x, log_likelihood
        super().__init__(torch.Size([len(x)]), torch.Size(), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        """(N,)."""
        return self.log_likelihood(self.x)


def gaussian(dimension: int, *, correlated: bool, scale: float = 0.1) -> Problem:
    """Prior N(0, I), likelihood N(0; x, S): S = scale^2 I, or eigenvalues from scale^2 / 10 to 10 scale^2."""
    zero = torch.zeros(dimension, dtype=FLOAT)
    covariance = scale**2 * torch.eye(dimension, dtype=FLOAT)
    if correlated:
        draws = torch.randn(dimension, dimension, generator=torch.Generator().manual_seed(0), dtype=FLOAT)
        axes = torch.linalg.qr(draws)[0]
        covariance = scale**2 * (axes * torch.logspace(-1, 1, dimension, dtype=FLOAT)) @ axes.T
        covariance = 0.5 * (covariance + covariance.T)
    factor = torch.linalg.cholesky(covariance)

    def program() -> None:
        x = pyro.sample("x", dist.Normal(zero, 1.0).to_event(1))
        pyro.sample("y", dist.MultivariateNormal(x, scale_tril=factor))

    one = torch.eye(dimension, dtype=FLOAT)
    exact = torch.distributions.MultivariateNormal(zero, one + covariance).log_prob(zero)
    precision = one + torch.linalg.inv(covariance)
    return Problem(program, zero, float(exact), zero, torch.linalg.inv(precision).diagonal())


def logistic(dimension: int = 50, count: int = 500) -> Problem:
    """Logistic regression, beta ~ N(0, I): reference by importance sampling from a t about the mode."""
    generator = torch.Generator().manual_seed(1)
    design = torch.randn(count, dimension, generator=generator, dtype=FLOAT)
    design[:, 1:] = 0.6 * design[:, :-1] + 0.8 * design[:, 1:]
    true = 0.5 * torch.randn(dimension, generator=generator, dtype=FLOAT)
    answers = (torch.rand(count, generator=generator, dtype=FLOAT) < torch.sigmoid(design @ true)).to(FLOAT)
    zero = torch.zeros(dimension, dtype=FLOAT)

    def program() -> None:
        beta = pyro.sample("x", dist.Normal(zero, 1.0).to_event(1))
        pyro.sample("y", dist.Bernoulli(logits=beta @ design.T).to_event(1))

    log_evidence, mean, variance = _by_importance(design, answers)
    return Problem(program, answers, log_evidence, mean, variance)


def _by_importance(design: Tensor, answers: Tensor) -> tuple[float, Tensor, Tensor]:
    signs = (2.0 * answers - 1.0)[:, None] * design

    def log_joint(beta: Tensor) -> Tensor:
        prior = -0.5 * beta.square().sum(-1) - 0.5 * beta.shape[-1] * math.log(2.0 * math.pi)
        return prior - torch.nn.functional.softplus(-(beta @ signs.T)).sum(-1)

    mode = torch.zeros(design.shape[1], dtype=FLOAT)
    for _ in range(30):
        step = torch.linalg.solve(torch.func.hessian(log_joint)(mode), torch.func.grad(log_joint)(mode))
        mode = mode - step
    mean, covariance = mode, torch.linalg.inv(-torch.func.hessian(log_joint)(mode))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        # The posterior is skewed: each round is about the moments of the one before.
        for count in (20_000, 20_000, 60_000):
            wide = dist.MultivariateStudentT(100.0, mean, torch.linalg.cholesky(1.2 * covariance))
            draws = wide.sample((count,))
            log_weights = log_joint(draws) - wide.log_prob(draws)
            weights = torch.softmax(log_weights, 0)
            mean = weights @ draws
            covariance = (weights[:, None] * (draws - mean)).T @ (draws - mean)
    if 1.0 / float(weights.square().sum()) < 1e4:
        raise RuntimeError("the reference of the logistic regression has an effective sample size below 1e4")
    return float(torch.logsumexp(log_weights, 0)) - math.log(count), mean, covariance.diagonal()


@cache
def eight_schools() -> Problem:
    """Rubin's eight schools, mu ~ N(0, 5), tau ~ half-Cauchy(5), in ten standard normal coordinates."""
    effects = torch.tensor([28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0], dtype=FLOAT)
    errors = torch.tensor([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0], dtype=FLOAT)

    def program() -> None:
        x = pyro.sample("x", dist.Normal(torch.zeros(10, dtype=FLOAT), 1.0).to_event(1))
        tau = 5.0 * torch.tan(0.5 * math.pi * torch.special.ndtr(x[:, 1]))
        pyro.sample("y", dist.Normal(5.0 * x[:, :1] + tau[:, None] * x[:, 2:], errors).to_event(1))

    mu, tau_of = np.meshgrid(np.linspace(-6, 6, 1201), np.linspace(-6, 6, 2401), indexing="ij")
    tau = 5.0 * np.tan(0.5 * np.pi * special.ndtr(tau_of))
    spread = np.sqrt(tau[..., None] ** 2 + errors.numpy() ** 2)
    log_density = stats.norm.logpdf(effects.numpy(), 5.0 * mu[..., None], spread).sum(-1)
    log_density += stats.norm.logpdf(mu) + stats.norm.logpdf(tau_of)
    top = log_density.max()
    weights = np.exp(log_density - top)
    cell = (mu[1, 0] - mu[0, 0]) * (tau_of[0, 1] - tau_of[0, 0])
    total = weights.sum()
    weights /= total
    # Given mu and tau the others are normal.
    gain = tau[..., None] / spread**2
    each = gain * (effects.numpy() - 5.0 * mu[..., None])
    left = 1.0 - gain * tau[..., None]
    first = np.concatenate([np.stack([mu, tau_of], -1), each], -1)
    second = np.concatenate([np.stack([mu**2, tau_of**2], -1), each**2 + left], -1)
    mean, square = (np.einsum("ab,abk->k", weights, moment) for moment in (first, second))
    return Problem(
        program,
        effects,
        float(top + math.log(total * cell)),
        torch.from_numpy(mean),
        torch.from_numpy(square - mean**2),
    )


def shells(dimension: int) -> Problem:
    """Two shells of radius 2 and width .1 about +-3.5 on the first axis, uniform on [-6, 6]^D.

    Feroz and Hobson, Multimodal nested sampling, MNRAS 384, 2008, section 5.3.
    """
    centre = torch.zeros(dimension, dtype=FLOAT)
    centre[0] = 3.5

    def log_likelihood(x: Tensor) -> Tensor:
        off = torch.stack([((x - c).norm(dim=-1) - 2.0) / 0.1 for c in (centre, -centre)])
        return torch.logsumexp(-0.5 * off**2, 0) - 0.5 * math.log(2 * math.pi * 0.01)

    def program() -> None:
        box = dist.Uniform(torch.full((dimension,), -6.0, dtype=FLOAT), 6.0)
        x = pyro.sample("x", box.to_event(1))
        pyro.sample("y", Likelihood(x, log_likelihood))

    radial = [
        integrate.quad(lambda r, p=power: r**p * stats.norm.pdf(r, 2.0, 0.1), 1.0, 3.0, epsabs=1e-12)[0]
        for power in (dimension - 1, dimension + 1)
    ]
    surface = math.log(2.0) + 0.5 * dimension * math.log(math.pi) - math.lgamma(0.5 * dimension)
    log_evidence = math.log(2.0 * radial[0]) + surface - dimension * math.log(12.0)
    variance = torch.full((dimension,), radial[1] / radial[0] / dimension, dtype=FLOAT)
    variance[0] += 3.5**2
    return Problem(program, torch.zeros((), dtype=FLOAT), log_evidence, torch.zeros_like(centre), variance)


def eggbox() -> Problem:
    """Log-likelihood (2 + cos(x / 2) cos(y / 2))^5, uniform on [0, 10 pi]^2 (the same paper, section 5.1)."""
    side = 10.0 * math.pi

    def log_likelihood(x: Tensor) -> Tensor:
        return (2.0 + torch.cos(0.5 * x).prod(dim=-1)) ** 5

    def program() -> None:
        box = dist.Uniform(torch.zeros(2, dtype=FLOAT), side)
        pyro.sample("y", Likelihood(pyro.sample("x", box.to_event(1)), log_likelihood))

    line = (torch.arange(4000, dtype=FLOAT) + 0.5) * side / 4000
    log_density = log_likelihood(torch.stack(torch.meshgrid(line, line, indexing="ij"), -1))
    log_evidence = float(torch.logsumexp(log_density.flatten(), 0)) - 2.0 * math.log(4000)
    along = torch.softmax(log_density.flatten(), 0).reshape(4000, 4000).sum(1)
    mean = along @ line
    variance = along @ (line - mean).square()
    return Problem(program, torch.zeros((), dtype=FLOAT), log_evidence, mean.repeat(2), variance.repeat(2))


PROBLEMS: dict[str, Callable[[], Problem]] = {
    **{
        f"Gaussian, D = {d}, {'correlated' if c else 'isotropic'}": (
            lambda d=d, c=c: gaussian(d, correlated=c)
        )
        for d in (2, 6, 20, 50, 100)
        for c in (False, True)
    },
    "logistic regression, D = 50": logistic,
    "eight schools": eight_schools,
    **{f"shells, D = {d}": (lambda d=d: shells(d)) for d in (2, 5, 10)},
    "eggbox": eggbox,
}
