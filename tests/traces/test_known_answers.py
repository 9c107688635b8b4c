"""Small programs whose answer is known by enumeration, conjugacy, quadrature or a Kalman filter."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from scipy import special, stats
from torch import Tensor

from bcppl.inference import (
    Observed,
    importance_sampling,
    rejuvenate,
    resample,
    steps,
    tempered,
    tempered_importance_sampling as tempered_sampling,
)
from bcppl.inference.kernels import Kernel, metropolis_hastings, sequence
from bcppl.inference.proposals import drift, independent, joint_drift, prior
from bcppl.inference.series import smooth
from bcppl.inference.structures import (
    Jump,
    StrataMove,
    generate_strata,
    jump,
    probabilities,
    resample_strata,
)
from bcppl.inference.summaries import mean
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Series, Trace, structural


def real(x: Any) -> Tensor:
    return torch.tensor(x, dtype=torch.float64)


def agree(run: Callable[[], Iterable[Any]], exact: Any, seeds: int) -> None:
    """Means over seeds are within four standard errors of the exact values."""
    rows = []
    for seed in range(seeds):
        torch.manual_seed(1000 + seed)
        rows.append([float(x) for x in run()])
    runs = np.array(rows)
    error = runs.std(0, ddof=1) / math.sqrt(seeds)
    assert (abs(runs.mean(0) - exact) < 4.0 * error + 1e-9).all(), (runs.mean(0), error, exact)


def test_discrete_and_continuous_latent_values() -> None:
    places, widths, shares = [-2.0, 0.0, 3.0], [0.5, 1.0, 2.0], [0.5, 0.3, 0.2]

    def program() -> None:
        kind = pyro.sample("kind", dist.Categorical(real(shares)))
        x = pyro.sample("x", dist.Normal(real(places)[kind], real(widths)[kind]))
        pyro.sample("y", dist.Normal(x, 0.5))

    each = np.array(shares) * stats.norm.pdf(1.3, places, np.hypot(widths, 0.5))
    inner = (np.array(places) / np.square(widths) + 1.3 / 0.25) / (1.0 / np.square(widths) + 4.0)
    step = tempered(sequence(metropolis_hastings(prior("kind")), metropolis_hastings(drift("x"))))

    def run() -> Iterable[Any]:
        population = tempered_sampling(program, (), {"y": np.float32(1.3)}, 200, step).population
        third = torch.softmax(population.log_weights, 0)[population["kind"] == 2].sum()
        return math.exp(population.log_evidence) / each.sum(), third, mean(population, "x")

    agree(run, [1.0, each[2] / each.sum(), each @ inner / each.sum()], 10)


def test_dirichlet_multinomial() -> None:
    prior_counts, counts = np.array([0.5, 1.0, 2.0, 3.0]), np.array([3.0, 0.0, 5.0, 1.0])

    def program() -> None:
        shares = pyro.sample("shares", dist.Dirichlet(torch.tensor(prior_counts)))
        pyro.sample("counts", dist.Multinomial(9, shares, validate_args=False))

    gamma = special.gammaln
    log_evidence = gamma(10) - gamma(counts + 1).sum() + gamma(6.5) - gamma(15.5)
    log_evidence += (gamma(prior_counts + counts) - gamma(prior_counts)).sum()
    step = tempered(metropolis_hastings(independent("shares")))

    def run() -> Iterable[Any]:
        population = tempered_sampling(program, (), {"counts": counts}, 150, step).population
        return math.exp(population.log_evidence - log_evidence), *mean(population, "shares")

    agree(run, [1.0, *((prior_counts + counts) / 15.5)], 8)


def test_support_that_depends_on_another_latent_value() -> None:
    def program() -> None:
        top = pyro.sample("top", dist.Uniform(real(0.0), real(1.0)))
        place = pyro.sample("place", dist.Uniform(torch.zeros_like(top), top))
        pyro.sample("y", dist.Normal(place, 0.2))

    grid = np.linspace(5e-4, 1.0, 2000)
    top, place = np.meshgrid(grid, grid, indexing="ij")
    weight = (place < top) / top * stats.norm.pdf(0.5, place, 0.2)
    exact = [(weight * top).sum() / weight.sum(), (weight * place).sum() / weight.sum()]
    kernels = [
        metropolis_hastings(joint_drift("place", "top")),
        sequence(metropolis_hastings(drift("top")), metropolis_hastings(drift("place"))),
    ]
    for kernel in kernels:

        def run(kernel: Kernel = kernel) -> Iterable[Any]:
            start = resample(importance_sampling(program, (), {"y": 0.5}, 500))
            moved = rejuvenate(start, kernel, sweeps=3)
            return moved["top"].mean(), moved["place"].mean()

        agree(run, exact, 6)


def test_smoothing_with_missing_observations() -> None:
    along, noise, error, seen = 0.7, 0.8, 0.5, [0.5, None, None, 2.0, None]

    def onward(x: Tensor, observed: bool) -> Tensor:
        x = pyro.sample("x", dist.Normal(along * x, noise))
        if observed:
            pyro.sample("y", dist.Normal(x, error))
        return x

    series = Series(lambda: pyro.sample("x", dist.Normal(real(0.0), 1.0)), onward)
    # The joint Gaussian of x_0 ... x_5 by hand: precision of the chain, then of the readings.
    information, shift, log_evidence = np.zeros((6, 6)), np.zeros(6), 0.0
    information[0, 0] = 1.0
    for k in range(5):
        row = np.zeros(6)
        row[k], row[k + 1] = -along, 1.0
        information += np.outer(row, row) / noise**2
    cov = np.linalg.inv(information)
    where = [k + 1 for k, y in enumerate(seen) if y is not None]
    values = np.array([y for y in seen if y is not None])
    log_evidence = stats.multivariate_normal.logpdf(
        values, np.zeros(2), cov[np.ix_(where, where)] + error**2 * np.eye(2)
    )
    gain = cov[:, where] @ np.linalg.inv(cov[np.ix_(where, where)] + error**2 * np.eye(2))
    shift = gain @ values

    def run() -> Iterable[Any]:
        start = importance_sampling(series, (), {}, 300)
        observed = [Observed((y is not None,), {} if y is None else {"y": y}) for y in seen]
        filtered = [start, *(each.population for each in steps(tempered(share=0.0), start, observed))]
        path = smooth(filtered, 300)
        return math.exp(filtered[-1].log_evidence - log_evidence), *(path["x", k].mean() for k in range(6))

    agree(run, [1.0, *shift], 12)


def summed() -> None:
    count = structural("count", dist.Categorical(real([0.2, 0.3, 0.5]))) + 1
    terms = [pyro.sample(f"x{j}", dist.Normal(real(0.0), 1.0)) for j in range(count)]
    pyro.sample("y", dist.Normal(sum(terms), 0.5))


def split(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    last = len(trace.choices) - 2 if "count" in trace.choices else len(trace.choices) - 1
    apart, x = pyro.sample("apart", dist.Normal(real(0.0), 1.0)), trace[f"x{last}"]
    return {f"x{last}": x / 2 - apart, f"x{last + 1}": x / 2 + apart}, {}


def join(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    last = len(trace.choices) - 2 if "count" in trace.choices else len(trace.choices) - 1
    low, high = trace[f"x{last - 1}"], trace[f"x{last}"]
    return {f"x{last - 1}": low + high}, {"apart": (high - low) / 2}


def more(structure: Mapping[str, int]) -> Mapping[str, int] | None:
    return {"count": structure["count"] + 1} if structure["count"] < 2 else None


def fewer(structure: Mapping[str, int]) -> Mapping[str, int] | None:
    return {"count": structure["count"] - 1} if structure["count"] > 0 else None


def test_reversible_jumps_leave_the_posterior_of_structures_invariant() -> None:
    each = np.array([0.2, 0.3, 0.5]) * stats.norm.pdf(1.7, 0.0, np.sqrt(np.arange(3) + 1.25))
    for jumps in (Jump(more, fewer), Jump(more, fewer, split, join, check=True)):
        move = jump(jumps)

        def run(move: StrataMove = move) -> Iterable[Any]:
            strata = resample_strata(generate_strata(summed, (), {"y": 1.7}, 2000), 300)
            for _ in range(3):
                strata, _ = move(strata, POSTERIOR)
            return probabilities(strata, "count").probabilities

        agree(run, each / each.sum(), 12)


def test_structural_choice_that_depends_on_a_latent_value() -> None:
    def program() -> None:
        chance = pyro.sample("chance", dist.Beta(real(1.0), real(1.0)))
        pyro.sample("y", dist.Normal(2.0 * structural("on", dist.Bernoulli(chance)), real(1.0)))

    off, on = stats.norm.pdf(1.7), stats.norm.pdf(-0.3)

    def run() -> Iterable[Any]:
        strata = generate_strata(program, (), {"y": 1.7}, 300)
        return probabilities(strata, "on").probabilities[-1], math.exp(strata.log_evidence)

    agree(run, [on / (off + on), 0.5 * (off + on)], 20)
