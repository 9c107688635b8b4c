"""What a step costs: a bootstrap filter of a linear-Gaussian series, 50 steps, by four engines in one run.

bcppl (a `Series`, its verbs and its population, the history kept or not), Pyro's SMCFilter without
rejuvenation, `particles`, and a bare loop in torch. All resample systematically below half the effective
sample size, SMCFilter whenever it does so by itself. The log evidence is checked against Kalman's filter.
"""

from __future__ import annotations

import importlib.util
import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import peer
import pyro
import pyro.distributions as dist
import torch
from pyro.infer import SMCFilter
from report import Row, cores, finish, options, show
from torch import Tensor

from bcppl.inference.filters.smc import FEW_PARTICLES
from bcppl.inference.population import Population
from bcppl.inference.resampling import adaptive
from bcppl.traces import Series, extend, generate

_spec = importlib.util.spec_from_file_location("problems", peer.SCRIPTS / "problems.py")
assert _spec is not None and _spec.loader is not None
problems = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(problems)

WALK, NOISE = problems.WALK, problems.NOISE
STEPS = 50
COUNTS = (100, 10_000, 1_000_000)
REPEATS = {100: 21, 10_000: 11, 1_000_000: 5}

Filter = Callable[[int, Tensor], float]


ZERO, ONE, WALKED, NOISED = torch.tensor([0.0, 1.0, WALK, NOISE], dtype=torch.float64)


def start() -> Tensor:
    return pyro.sample("x", dist.Normal(ZERO, ONE))


def walk(x: Tensor) -> Tensor:
    x = pyro.sample("x", dist.Normal(x, WALKED))
    pyro.sample("y", dist.Normal(x, NOISED))
    return x


def language(history: bool) -> Filter:
    """The filter in bcppl; returns the log evidence."""
    series = Series(start, walk, history=history)
    resample = adaptive()

    def run(count: int, observed: Tensor) -> float:
        trace, log_weights = generate(series, (), {}, count)
        population = Population(trace, log_weights)
        for y in observed:
            trace, log_factor = extend(population.trace, (), {"y": y})
            population = population.with_trace(trace).reweighed(log_factor)
            population, _ = resample(population)
        return population.log_evidence

    return run


def bare(count: int, observed: Tensor) -> float:
    """The same arithmetic in plain torch, float64, nothing checked and nothing kept."""
    constant = -math.log(NOISE * math.sqrt(2 * math.pi))
    x = torch.randn(count, dtype=torch.float64)
    log_weights = torch.zeros(count, dtype=torch.float64)
    log_evidence, log_total = 0.0, math.log(count)
    for y in observed:
        x = x + WALK * torch.randn(count, dtype=torch.float64)
        log_weights = log_weights - 0.5 * ((y - x) / NOISE) ** 2 + constant
        total = float(torch.logsumexp(log_weights, 0))
        log_evidence, log_total = log_evidence + total - log_total, total
        weights = torch.exp(log_weights - total)
        if 1.0 / float((weights**2).sum()) < 0.5 * count:
            points = (torch.arange(count, dtype=torch.float64) + torch.rand(())) / count
            x = x[torch.searchsorted(weights.cumsum(0), points).clamp_max(count - 1)]
            log_weights, log_total = torch.zeros(count, dtype=torch.float64), math.log(count)
    return log_evidence


class Walk:
    """The series as SMCFilter takes it."""

    def init(self, state: Any) -> None:
        """Draw the first state."""
        self.t = 0
        state["x"] = pyro.sample("x_0", dist.Normal(0.0, 1.0))

    def step(self, state: Any, y: Tensor | None = None) -> None:
        """Take one step and see it."""
        self.t += 1
        state["x"] = pyro.sample(f"x_{self.t}", dist.Normal(state["x"], WALK))
        pyro.sample(f"y_{self.t}", dist.Normal(state["x"], NOISE), obs=y)


class Blind:
    """The same without seeing and without writing: the proposal of a bootstrap filter."""

    def init(self, state: Any) -> None:
        """Draw the first state."""
        self.t = 0
        pyro.sample("x_0", dist.Normal(0.0, 1.0))

    def step(self, state: Any, y: Tensor | None = None) -> None:
        """Take one step."""
        self.t += 1
        pyro.sample(f"x_{self.t}", dist.Normal(state["x"], WALK))


def pyro_filter(count: int, observed: Tensor) -> float:
    """SMCFilter; it has no evidence."""
    smc = SMCFilter(Walk(), Blind(), num_particles=count, max_plate_nesting=0)
    smc.init()
    for y in observed.to(torch.float32):
        smc.step(y)
    return math.nan


class Timed:
    """Milliseconds a step and log evidences of one engine at one N."""

    def __init__(self) -> None:
        self.milliseconds: list[float] = []
        self.log_evidences: list[float] = []
        self.failures: list[str] = []

    @property
    def median(self) -> float:
        """NaN where every run failed."""
        return statistics.median(self.milliseconds) if self.milliseconds else math.nan


def together(
    engines: dict[str, Filter], count: int, observed: Tensor, repeats: int, seed: int
) -> dict[str, Timed]:
    """The engines in turn, repeat by repeat, so that a machine that slows down slows all of them."""
    found = {name: Timed() for name in engines}
    for repeat in range(repeats + 1):
        for name, run in engines.items():
            pyro.clear_param_store()
            torch.manual_seed(seed + repeat)
            begun = time.perf_counter()
            try:
                log_evidence = run(count, observed)
            except IndexError as error:  # SMCFilter's resampling at large N
                found[name].failures.append(f"{type(error).__name__}: {error}")
                continue
            if repeat:  # the first warms up
                found[name].milliseconds.append(1e3 * (time.perf_counter() - begun) / len(observed))
                found[name].log_evidences.append(log_evidence)
    return found


def error(log_evidences: Sequence[float], exact: float) -> tuple[float, float]:
    """Log of the mean of the estimated evidence over the exact one, and its standard error."""
    ratios = [math.exp(each - exact) for each in log_evidences]
    mean = statistics.fmean(ratios)
    deviation = statistics.stdev(ratios) / math.sqrt(len(ratios)) if len(ratios) > 1 else math.nan
    return math.log(mean), deviation / mean


GOALS = {
    (100, "SMCFilter"): 1.0,
    (10_000, "particles"): 1.0,
    (1_000_000, "particles"): 1.0,
    (1_000_000, "torch"): 2.0,
}


def ratios(timed: dict[str, Timed], count: int) -> list[Row]:
    """The time of bcppl over each other engine's, with the goals."""
    own = timed["bcppl"].median
    return [
        Row(f"bcppl / {name}, N = {count}", own / found.median, "ratio of times", GOALS.get((count, name)))
        for name, found in timed.items()
        if name != "bcppl" and not math.isnan(found.median)
    ]


def main() -> None:
    arguments = options(__doc__.partition("\n")[0]).parse_args()
    series, exact = problems.linear_gaussian(STEPS)
    observed = torch.from_numpy(series)
    engines: dict[str, Filter] = {
        "bcppl": language(history=False),
        "bcppl with history": language(history=True),
        "torch": bare,
        "SMCFilter": pyro_filter,
    }
    lines, rows = [], []
    threads = torch.get_num_threads()
    for count in COUNTS[:2] if arguments.quick else COUNTS:
        repeats = 3 if arguments.quick else REPEATS[count]
        # As `bcppl.inference.filters.smc` does it, for all engines alike.
        torch.set_num_threads(1 if count < FEW_PARTICLES else threads)
        timed = together(engines, count, observed, repeats, arguments.seed)
        torch.set_num_threads(threads)
        answered = peer.ask(
            "particles", "particles_filter.py", count, "--repeats", repeats, "--seed", arguments.seed
        )
        if answered:
            found = timed["particles"] = Timed()
            found.milliseconds = answered[0]["each_milliseconds_per_step"]
            found.log_evidences = answered[0]["log_evidences"]
        for name, found in timed.items():
            known = [each for each in found.log_evidences if not math.isnan(each)]
            off, deviation = error(known, exact) if known else (math.nan, math.nan)
            few, many = min(found.milliseconds, default=math.nan), max(found.milliseconds, default=math.nan)
            failed = len(found.failures)
            numbers = [f"{value:.3f}" for value in (found.median, few, many, off, deviation)]
            lines.append([name, count, *numbers[:3], len(found.milliseconds), failed, *numbers[3:]])
            rows.append(Row(f"{name}, N = {count}", found.median, "ms a step"))
            rows.append(Row(f"{name}, N = {count}", failed, "failed runs", 0 if "bcppl" in name else None))
            # Of few particles the mean of the evidence depends on rare runs: there it is only reported.
            if name == "bcppl" and count > 1000:
                rows.append(Row(f"evidence, N = {count}", abs(off), "nats from exact", 4 * deviation + 0.005))
            if failed:
                print(f"{name} failed at N = {count} in {failed} runs: {found.failures[0]}")
        rows += ratios(timed, count)
    show(
        f"bootstrap filter, {STEPS} steps, ms a step, {cores()} cores",
        ["", "N", "median", "least", "most", "runs", "failed", "log mean Z/exact", "standard error"],
        lines,
    )
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
