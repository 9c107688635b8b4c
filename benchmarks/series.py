"""Inference of a series' static parameter, and its smoothing, against Kalman's filter and smoother.

The autoregression x_t = rho x_{t-1} + N(0, 1), y_t = x_t + N(0, 0.7^2), T = 200, rho uniform on [-1, 1].

1. Particle Gibbs, PMMH and SMC^2 beside the PMMH and the SMC^2 of `particles`: how far from the exact
   posterior mean, and effective draws a processor second. Chains run together, and start from the prior; a
   fifth of each is left out, and its time counts.
2. Backward sampling and paths traced along ancestors, at the true parameter: the mean at each step.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import pyro
import pyro.distributions as dist
import torch
from evidence import problems
from peer import ask
from report import Row, finish, options, show
from torch import Tensor

from bcppl.inference import Observed, importance_sampling, markov_chains, steps, tempered
from bcppl.inference.kernels import metropolis_hastings, repeat, sequence
from bcppl.inference.proposals import drift
from bcppl.inference.series import marginal, particle_gibbs, smooth, unrolled
from bcppl.inference.summaries import mean
from bcppl.traces import Series, generate

NOISE, RHO = problems.SERIES_NOISE, problems.SERIES_RHO


class Size(NamedTuple):
    """How much is run: chains and their moves, runs of SMC^2, particles of each kind, seeds of smoothing."""

    steps: int = 200
    chains: int = 100
    moves: int = 100
    gibbs_moves: int = 40
    runs: int = 8
    thetas: int = 200
    states: int = 300
    path_particles: int = 20
    seeds: int = 20
    filtered: int = 400
    peer_chains: int = 8
    peer_moves: int = 1000


QUICK = Size(20, 10, 20, 5, 2, 30, 30, 5, 3, 50, 2, 30)


class Estimates(NamedTuple):
    """Estimates (R,) of the posterior mean by independent chains or runs, and the seconds of all together."""

    means: Tensor
    seconds: float
    log_evidences: Tensor | None = None


def init() -> dict[str, Tensor]:
    low = torch.tensor(-1.0, dtype=torch.float64)
    rho = pyro.sample("rho", dist.Uniform(low, -low))
    return {"rho": rho, "x": pyro.sample("x", dist.Normal(torch.zeros_like(rho), 1.0))}


def step(state: dict[str, Tensor]) -> dict[str, Tensor]:
    x = pyro.sample("x", dist.Normal(state["rho"] * state["x"], 1.0))
    pyro.sample("y", dist.Normal(x, NOISE))
    return {"rho": state["rho"], "x": x}


SERIES = Series(init, step)


def observations(observed: Tensor) -> dict[str, Tensor]:
    """By the addresses of the unrolled program."""
    return {f"y/{t}": y for t, y in enumerate(observed, 1)}


def chains_of(kernel: Any, program: Any, observed: Tensor, count: int, moves: int) -> Estimates:
    """Chains from the prior; the kernel is fitted at the start and once more after a fifth of the moves."""
    begun = time.process_time()
    trace, _ = generate(program, ([()] * len(observed),), observations(observed), count)
    burnt = markov_chains(kernel, trace, moves // 5, addresses="rho", progress=False).trace
    draws = markov_chains(kernel, burnt, moves - moves // 5, addresses="rho", progress=False).draws["rho"]
    return Estimates(draws.mean(dim=0), time.process_time() - begun)


def gibbs(observed: Tensor, size: Size) -> Estimates:
    """Particle Gibbs, and random walks of the parameter given the path."""
    walk = repeat(metropolis_hastings(drift("rho", (0.3, 2.0))), 2)
    kernel = sequence(particle_gibbs("rho", particles=size.path_particles), walk)
    return chains_of(kernel, unrolled(SERIES), observed, size.chains, size.gibbs_moves)


def pmmh(observed: Tensor, size: Size) -> Estimates:
    """Random walks of the parameter, the path integrated out."""
    program = marginal(SERIES, "rho", observed="y", particles=size.states)
    kernel = metropolis_hastings(drift("rho", (0.3, 2.0)))
    return chains_of(kernel, program, observed, size.chains, size.moves)


def smc_squared(observed: Tensor, size: Size) -> Estimates:
    """Tempered SMC on the marginal program, one observation at a time."""
    program = marginal(SERIES, "rho", observed="y", particles=size.states)
    kernel = metropolis_hastings(drift("rho", (0.3, 2.0)))
    means, logs, begun = [], [], time.process_time()
    seen = [Observed(([()] * t,), {f"y/{t}": y}) for t, y in enumerate(observed, 1)]
    for _ in range(size.runs):
        start = importance_sampling(program, ([],), {}, size.thetas)
        *_, (population, _) = steps(tempered(kernel, sweeps=3, share=0.0), start, seen)
        means.append(mean(population, "rho"))
        logs.append(population.log_evidence)
    return Estimates(torch.stack(means), time.process_time() - begun, torch.tensor(logs, dtype=torch.float64))


def peers(size: Size, seed: int) -> dict[str, Estimates]:
    """`particles`, by method."""
    given = {
        "steps": size.steps,
        "states": size.states,
        "chains": size.peer_chains,
        "moves": size.peer_moves,
        "runs": size.runs,
        "thetas": size.thetas,
        "seed": seed,
    }
    words = [word for name, value in given.items() for word in (f"--{name}", value)]
    threads = {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    lines = ask("particles", "particles_series.py", *words, environment=threads) or []
    results = {}
    for method in ("pmmh", "smc2"):
        mine = [line for line in lines if line["method"] == method]
        if mine:
            means = torch.tensor([line["mean"] for line in mine], dtype=torch.float64)
            results[method] = Estimates(means, sum(line["seconds"] for line in mine))
    return results


def parameters(observed: Tensor, size: Size, seed: int) -> list[Row]:
    """The parameter by every method."""
    centre, spread, evidence = problems.autoregression_posterior(observed.numpy())
    rows: list[Row] = []
    lines: list[list[Any]] = []
    rates: dict[str, float] = {}

    def add(name: str, estimated: Estimates) -> None:
        off = (estimated.means - centre) / spread
        effective = len(off) / float(off.square().mean())
        z = float(off.mean() / (off.std() / math.sqrt(len(off))))
        rates[name] = effective / estimated.seconds
        lines.append([name, len(off), float(off.mean()), z, effective, estimated.seconds, rates[name]])
        rows.append(Row(f"{name}: effective draws a second", rates[name], "1/s"))
        if not name.startswith("particles"):
            rows.append(Row(f"{name}: |z| of the posterior mean", abs(z), "standard errors", 3.5))
        if estimated.log_evidences is not None:
            ratio = (estimated.log_evidences - evidence).exp()
            rows.append(Row(f"{name}: Z-hat / Z", float(ratio.mean()), ""))
            rows.append(Row(f"{name}: deviation of log Z", float(estimated.log_evidences.std()), "nats"))
            z = float((ratio.mean() - 1.0) / (ratio.std() / math.sqrt(len(ratio))))
            rows.append(Row(f"{name}: |z| of Z-hat / Z", abs(z), "standard errors", 3.5))

    methods: dict[str, Callable[[Tensor, Size], Estimates]] = {
        "particle Gibbs": gibbs,
        "PMMH": pmmh,
        "SMC^2": smc_squared,
    }
    for name, method in methods.items():
        torch.manual_seed(seed)
        add(name, method(observed, size))
    for method_name, estimated in peers(size, seed).items():
        add(f"particles, {'PMMH' if method_name == 'pmmh' else 'SMC^2'}", estimated)
    columns = ["method", "runs", "bias / sd", "z", "effective", "seconds", "effective a second"]
    show(f"rho, exact {centre:.4f} +- {spread:.4f}", columns, lines)
    for name in ("PMMH", "SMC^2"):
        if f"particles, {name}" in rates:
            ratio = rates[name] / rates[f"particles, {name}"]
            rows.append(Row(f"{name}: effective draws a second, over particles'", ratio, "", 1.0, "min"))
    return rows


def smoothed(observed: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (T + 1,) of the states at the true parameter given all observations."""
    count = len(observed)
    lag = torch.eye(count + 1, dtype=torch.float64)
    lag[torch.arange(1, count + 1), torch.arange(count)] = -RHO
    precision = lag.T @ lag
    precision[1:, 1:] += torch.eye(count, dtype=torch.float64) / NOISE**2
    covariance = torch.linalg.inv(precision)
    return covariance[:, 1:] @ observed / NOISE**2, covariance.diagonal().sqrt()


def smoothing(observed: Tensor, size: Size, seed: int) -> list[Row]:
    """The mean at every step, over seeds."""
    known = Series(
        lambda: pyro.sample("x", dist.Normal(torch.zeros((), dtype=torch.float64), 1.0)),
        lambda x: step({"rho": torch.tensor(RHO, dtype=torch.float64), "x": x})["x"],
    )
    exact, spread = smoothed(observed)
    seen = [Observed((), {"y": y}) for y in observed]
    drawn, traced, seconds = [], [], []
    for k in range(size.seeds):
        torch.manual_seed(seed + k)
        start = importance_sampling(known, (), {}, size.filtered)
        populations = [start, *(each.population for each in steps(tempered(share=0.0), start, seen))]
        begun = time.process_time()
        paths = smooth(populations, size.filtered)
        seconds.append(time.process_time() - begun)
        times = range(size.steps + 1)
        drawn.append(torch.stack([paths["x", t].mean() for t in times]))
        last = populations[-1]
        weights = torch.softmax(last.log_weights, 0)
        traced.append(torch.stack([weights @ last.trace["x", t] for t in times]))
    lines, rows = [], []
    for name, runs in (("backward sampling", torch.stack(drawn)), ("along ancestors", torch.stack(traced))):
        z = (runs.mean(dim=0) - exact) / (runs.std(dim=0) / math.sqrt(size.seeds))
        beyond, largest = int((z.abs() > 3.0).sum()), float(z.abs().max())
        rmse = ((runs - exact) / spread).square().mean(dim=0).sqrt()
        lines.append([name, beyond, largest, float(rmse.mean()), float(rmse[: size.steps // 2].max())])
        rows.append(Row(f"{name}: steps of {size.steps + 1} beyond 3 standard errors", beyond, "steps"))
        rows.append(Row(f"{name}: largest |z|", largest, "standard errors"))
        rows.append(Row(f"{name}: error of a run", float(rmse.mean()), "standard deviations"))
    # Of Student's t with as many degrees as seeds, about one in a hundred is beyond 3.
    rows[0] = rows[0]._replace(goal=0.02 * (size.steps + 1))
    rows.append(Row("backward sampling: seconds", sorted(seconds)[len(seconds) // 2], "s"))
    columns = ["means of the path", "beyond 3 se", "largest z", "error / sd", "worst in the first half"]
    show(f"{size.filtered} particles and paths, {size.seeds} seeds", columns, lines)
    return rows


def main() -> None:
    arguments = options(__doc__ or "").parse_args()
    size = QUICK if arguments.quick else Size()
    observed = torch.from_numpy(problems.autoregression(size.steps))
    rows = [*parameters(observed, size, arguments.seed), *smoothing(observed, size, arguments.seed)]
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
