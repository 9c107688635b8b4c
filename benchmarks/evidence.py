"""Two problems whose evidence is known exactly, as Pyro programs, and bcppl's tempered SMC on them.

Every call of a likelihood is counted, one for each particle, as the peers' scripts count theirs.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.distributions.lazy import LazyDistribution
from bcppl.inference.filters.step import Observed
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.kernels import Kernel
from bcppl.inference.population import Population
from bcppl.inference.resampling import adaptive, systematic
from bcppl.traces import generate

sys.path.insert(0, str(Path(__file__).parent / "peers"))
import problems


class Counted(LazyDistribution):
    """A likelihood given as a function of x (N, d), and how often it was asked for a particle."""

    calls = 0

    def __init__(self, x: Tensor, log_likelihood: Callable[[Tensor], Tensor]) -> None:
        self.x, self.log_likelihood = x, log_likelihood
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        """Of the data, which the function holds."""
        Counted.calls += len(self.x)
        return self.log_likelihood(self.x)


@dataclass(frozen=True)
class Problem:
    """A program `program(count)` with a latent x and, where count is 1, its data.

    Attributes:
        program: what is run.
        log_evidence: exact.
        spread: (d,) exact standard deviations of the posterior, whose mean is 0.
    """

    program: Callable[[int], None]
    log_evidence: float
    spread: Tensor


_precision = torch.tensor(problems.GAUSSIAN_PRECISION)
_half = torch.full((2,), problems.SHELL_HALF, dtype=torch.float64)


def gaussian_log_likelihood(x: Tensor) -> Tensor:
    """Of values (N, 6)."""
    return float(problems.GAUSSIAN_PEAK) - 0.5 * ((x @ _precision) * x).sum(1)


def shells_log_likelihood(x: Tensor) -> Tensor:
    """Of values (N, 2)."""
    centres = (-problems.SHELL_CENTRE, problems.SHELL_CENTRE)
    off = [torch.hypot(x[:, 0] - centre, x[:, 1]) - problems.SHELL_RADIUS for centre in centres]
    nearest = torch.logaddexp(*(-(each**2) / (2 * problems.SHELL_WIDTH**2) for each in off))
    return nearest - 0.5 * math.log(2 * math.pi * problems.SHELL_WIDTH**2)


def gaussian(count: int) -> None:
    """Six axes, one likelihood that is much narrower than the prior."""
    at = torch.zeros(problems.GAUSSIAN_AXES, dtype=torch.float64)
    x = pyro.sample("x", dist.Normal(at, 1.0).to_event(1))
    if count:
        pyro.sample("y", Counted(x, gaussian_log_likelihood))


def shells(count: int) -> None:
    """Two thin rings in a square."""
    x = pyro.sample("x", dist.Uniform(-_half, _half).to_event(1))
    if count:
        pyro.sample("y", Counted(x, shells_log_likelihood))


def _shells_spread() -> Tensor:
    """Of the two rings, on a grid whose step is a fifth of their width."""
    side = torch.arange(-problems.SHELL_HALF, problems.SHELL_HALF, problems.SHELL_WIDTH / 5).double()
    grid = torch.cartesian_prod(side, side)
    return torch.sqrt(normalised(shells_log_likelihood(grid)) @ grid**2)


PROBLEMS = {
    "gaussian": Problem(
        gaussian,
        float(problems.GAUSSIAN_LOG_EVIDENCE),
        torch.linalg.inv(torch.eye(problems.GAUSSIAN_AXES, dtype=torch.float64) + _precision)
        .diagonal()
        .sqrt(),
    ),
    "shells": Problem(shells, problems.SHELLS_LOG_EVIDENCE, _shells_spread()),
}


@dataclass(frozen=True)
class Method:
    """How a problem is worked on.

    Attributes:
        kernel: moves the particles.
        sweeps: of the kernel, after each resampling.
        share: of the particles; tempering keeps the conditional effective sample size above it.
        threshold: of the particles; they are resampled, and then moved, below it.
    """

    kernel: Kernel
    sweeps: int = 3
    share: float = 0.8
    threshold: float = 1.0


class Outcome(NamedTuple):
    """One run: error of log Z, likelihood calls, seconds, tempering steps, distinct particles.

    `deviation` (d,) is the posterior mean in units of the exact standard deviations.
    """

    error: float
    calls: int
    seconds: float
    steps: int
    distinct: int
    deviation: list[float]


def run(problem: Problem, method: Method, particles: int, seed: int) -> Outcome:
    """One run of tempered SMC, on one thread."""
    torch.manual_seed(seed)
    step = tempered(
        method.kernel,
        sweeps=method.sweeps,
        resample=adaptive(systematic, method.threshold),
        share=method.share,
    )
    observed = {"y": torch.tensor(0.0, dtype=torch.float64)}
    Counted.calls, begun = 0, time.perf_counter()
    start, log_weights = generate(problem.program, (0,), {}, particles)
    done = step(Population(start, log_weights), Observed((1,), observed))
    seconds = time.perf_counter() - begun
    population = done.population
    mean = normalised(population.log_weights) @ population.trace["x"]
    return Outcome(
        population.log_evidence - problem.log_evidence,
        Counted.calls,
        seconds,
        len(done.info.exponents),
        population.distinct,
        (mean / problem.spread).tolist(),
    )


def within(problem: Problem, method: Method, calls: float, seed: int) -> int:
    """How many particles make as many likelihood calls as they may, on average, and not more."""
    particles = 100
    for _ in range(4):
        spent = np.mean([run(problem, method, particles, seed + k).calls for k in range(3)])
        # Below this, a half of them has nothing to learn a spread from.
        particles = max(8, int(0.99 * particles * calls / spent))
    return particles


def effective(deviations: Sequence[Sequence[float]]) -> float:
    """How many independent draws of the posterior estimate its mean as well as one run does.

    From the means of several runs, in standard deviations of the posterior: so copies count once, which the
    effective sample size of the weights does not see.
    """
    return float(1.0 / np.mean(np.square(deviations)))
