"""Mixtures of one to three Gaussians: how many there are, by strata, by reversible jump, and padded.

Known weights and variance, means with a normal prior, so that the probability of each number is known from
quadrature on a grid. Strata hold as many means as their structure has; the padded program holds three means
for every particle and leaves some out of the likelihood. All move the means by random walks fitted to the
other particles; strata jump by splitting and merging components, the padded program redraws the number.

Effective samples: the variance of independent draws of "three" over that of a run's estimate of its
probability, over seeds. Times are those of the processor.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import pyro
import pyro.distributions as dist
import report
import torch
from report import Row
from torch import Tensor

from bcppl.inference.filters.tempering import tempered
from bcppl.inference.importance import tempered_importance_sampling
from bcppl.inference.kernels import metropolis_hastings, sequence
from bcppl.inference.proposals import drift, prior
from bcppl.inference.resampling import adaptive
from bcppl.inference.structures import (
    Jump,
    Strata,
    generate_strata,
    in_turn,
    jump,
    resample_strata,
    tempered_strata,
    within,
)
from bcppl.inference.summaries import probabilities as padded_probabilities
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Structure, Trace, structural

MOST, WIDTH = 3, 3.0  # components, and the standard deviation of the prior of their means
EXPONENTS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.6, 1.0)
SWEEPS = 2  # moves of every particle after each exponent
DATA = torch.tensor(
    [
        -2.64,
        -2.57,
        -2.06,
        -1.81,
        -1.18,
        -1.15,
        -1.11,
        -1.06,
        -1.03,
        -0.99,
        -0.86,
        -0.68,
        -0.68,
        -0.4,
        -0.39,
        -0.25,
        -0.22,
        -0.19,
        -0.16,
        -0.08,
        0.04,
        0.15,
        0.24,
        0.3,
        0.42,
        0.5,
        0.57,
        0.75,
        0.82,
        0.93,
        0.95,
        1.21,
        1.35,
        1.41,
        1.64,
        1.65,
        1.73,
        2.22,
        2.54,
        2.66,
    ],
    dtype=torch.float64,
)


def likelihood(means: Tensor, used: Tensor, count: int) -> None:
    """The sites of the data, given the means (N, K) and which of them are used (N, K)."""
    logits = torch.where(used, 0.0, -torch.inf).to(torch.float64)
    mixture = dist.MixtureSameFamily(dist.Categorical(logits=logits), dist.Normal(means, 1.0))
    with pyro.plate("points", count):
        pyro.sample("y", mixture.expand([count, len(means)]))


def in_strata(count: int) -> None:
    """As many means as there are components."""
    components = structural("components", dist.Categorical(torch.ones(MOST, dtype=torch.float64))) + 1
    spread = torch.full((components,), WIDTH, dtype=torch.float64)
    means = pyro.sample("means", dist.Normal(torch.zeros_like(spread), spread).to_event(1))
    likelihood(means, torch.ones_like(means, dtype=torch.bool), count)


def padded(count: int) -> None:
    """Always three means, of which some are not used."""
    components = pyro.sample("components", dist.Categorical(torch.ones(MOST, dtype=torch.float64))) + 1
    spread = torch.full((MOST,), WIDTH, dtype=torch.float64)
    means = pyro.sample("means", dist.Normal(torch.zeros_like(spread), spread).to_event(1))
    likelihood(means, torch.arange(MOST) < components[:, None], count)


def split(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """One of the means becomes two, as far from it on either side."""
    means = trace["means"]
    which = pyro.sample("which", dist.Categorical(torch.ones(means.shape[1], dtype=torch.float64)))
    apart = pyro.sample("apart", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
    chosen = torch.nn.functional.one_hot(which, means.shape[1]).to(torch.float64)
    other = (means * chosen).sum(dim=1) + apart
    return {"means": torch.cat([means - chosen * apart[:, None], other[:, None]], dim=1)}, {"which": which}


def merge(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The last mean and one of the others become the one between them."""
    means, last = trace["means"][:, :-1], trace["means"][:, -1]
    which = pyro.sample("which", dist.Categorical(torch.ones(means.shape[1], dtype=torch.float64)))
    chosen = torch.nn.functional.one_hot(which, means.shape[1]).to(torch.float64)
    apart = (last - (means * chosen).sum(dim=1)) / 2
    return {"means": means + chosen * apart[:, None]}, {"which": which, "apart": apart}


def more(structure: Structure) -> dict[str, int] | None:
    number = structure["components"] + 1
    return {"components": number} if number < MOST else None


def fewer(structure: Structure) -> dict[str, int] | None:
    number = structure["components"] - 1
    return {"components": number} if number >= 0 else None


def by_quadrature(data: Tensor, nodes: int = 73, reach: float = 10.8) -> Tensor:
    """The evidence of each number of components (3,), by the trapezoidal rule.

    The integrands are smooth and fall off as normal densities do, so that the error falls exponentially with
    the number of nodes.
    """
    grid = torch.linspace(-reach, reach, nodes, dtype=torch.float64)
    normal = torch.distributions.Normal(torch.zeros((), dtype=torch.float64), 1.0)
    density = torch.exp(normal.log_prob(data[:, None] - grid))
    weight = torch.exp(normal.log_prob(grid / WIDTH)) / WIDTH * (grid[1] - grid[0])
    one = (weight * density.log().sum(dim=0).exp()).sum()
    pairs = density[:, :, None] + density[:, None, :]
    two = weight @ (pairs / 2).log().sum(dim=0).exp() @ weight
    three = sum(
        w * (weight @ ((pairs + density[:, k, None, None]) / 3).log().sum(dim=0).exp() @ weight)
        for k, w in enumerate(weight)
    )
    return torch.stack([one, two, torch.as_tensor(three)]) / MOST


walk = metropolis_hastings(drift("means", (0.05, 1.0)))
move = in_turn(within(walk), jump(Jump(more, fewer, split, merge)), times=SWEEPS)


def of_strata(strata: Strata) -> list[float]:
    return [strata.shares.get(Structure({"components": k}), 0.0) for k in range(MOST)]


def strata_by_tempering(data: Tensor, particles: int) -> list[float]:
    step = tempered_strata(move, exponents=EXPONENTS, least=particles // 20)
    return of_strata(step.generate(in_strata, (len(data),), {"y": data}, particles).strata)


def padded_by_tempering(data: Tensor, particles: int) -> list[float]:
    kernel = sequence([walk, metropolis_hastings(prior("components"))])
    step = tempered(kernel, sweeps=SWEEPS, exponents=EXPONENTS, resample=adaptive(), always_move=True)
    population, _ = tempered_importance_sampling(padded, (len(data),), {"y": data}, particles, step)
    values, share = padded_probabilities(population, "components")
    return [float(share[values == k].sum()) for k in range(MOST)]


def chains_by_jumps(data: Tensor, particles: int) -> list[float]:
    """Chains that start from importance sampling's particles; the second half of their states counts."""
    strata = resample_strata(generate_strata(in_strata, (len(data),), {"y": data}, 5 * particles), particles)
    states = []
    for number in range(2 * len(EXPONENTS)):
        strata, _ = move(strata, POSTERIOR)
        if number >= len(EXPONENTS):
            states.append(of_strata(strata))
    return torch.tensor(states, dtype=torch.float64).mean(dim=0).tolist()


class Measured(NamedTuple):
    """Estimates over seeds (S, 3), and processor seconds of each (S,)."""

    estimates: Tensor
    seconds: Tensor

    def standard_errors(self, exact: Tensor) -> float:
        """How far the mean estimate of three components is from the exact one."""
        error = float(self.estimates[:, 2].std()) / math.sqrt(len(self.estimates))
        return abs(float(self.estimates[:, 2].mean() - exact[2])) / error

    def effective(self, exact: Tensor) -> float:
        """Effective samples of a run, for the probability of three components."""
        return float(exact[2] * (1 - exact[2]) / (self.estimates[:, 2] - exact[2]).square().mean())


def measured(run: Callable[[Tensor, int], list[float]], particles: int, seeds: range) -> Measured:
    estimates, seconds = [], []
    for seed in seeds:
        torch.manual_seed(seed)
        start = time.process_time()
        estimates.append(run(DATA, particles))
        seconds.append(time.process_time() - start)
    return Measured(torch.tensor(estimates, dtype=torch.float64), torch.tensor(seconds))


METHODS = {
    "strata, tempered": strata_by_tempering,
    "strata, reversible jump": chains_by_jumps,
    "padded, tempered": padded_by_tempering,
}


def main() -> None:
    parser = report.options(__doc__.partition("\n")[0])
    parser.add_argument("--particles", type=int, default=10_000)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    seeds = range(chosen.seed, chosen.seed + (4 if chosen.quick else 20))
    evidence = by_quadrature(DATA)
    exact = evidence / evidence.sum()
    lines, rows, cost = [["quadrature", *exact.tolist(), 0.0, math.nan, math.nan, math.nan]], [], {}
    for name, run in METHODS.items():
        result = measured(run, chosen.particles, seeds)
        off, effective = result.standard_errors(exact), result.effective(exact)
        cost[name] = 1000.0 * float(result.seconds.median()) / effective
        shares = result.estimates.mean(dim=0).tolist()
        lines.append([name, *shares, off, effective, float(result.seconds.median()), cost[name]])
        rows.append(Row(f"P(3), {name}: off the exact one", off, "standard errors", 3.0))
        rows.append(Row(f"{name}: time per effective sample", cost[name], "ms"))
    for name in ("strata, tempered", "strata, reversible jump"):
        ratio = cost[name] / cost["padded, tempered"]
        rows.append(Row(f"{name}: time per effective sample over the padded one's", ratio, "", 1.0))
    columns = ["", "P(1)", "P(2)", "P(3)", "P(3) off (s.e.)", "effective samples", "seconds", "ms each"]
    report.show(f"{len(DATA)} points, {chosen.particles} particles, {len(seeds)} seeds", columns, lines)
    report.finish(rows, chosen.json)


if __name__ == "__main__":
    main()
