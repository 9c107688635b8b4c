"""Evidence and posterior moments of problems with exact answers, for every kernel in tempered SMC.

For each problem, kernel and number of particles the bias of log Z over several seeds, beside its standard
error; the log of the mean of the estimated evidence over the exact one, which is what theory makes unbiased
(the mean of a logarithm is lower by about half the variance); and the posterior moments: the largest |z| of a
mean over the axes, and the mean ratio of estimated to exact variance.

A bias is explained where it is within two standard errors of minus half the variance of log Z; for other
kernels that are known to be biased `REASONS` states why. All kernels of a problem have the same seeds, so
their errors are correlated: a bias common to all of them is one draw, not many. Of so many cells one in
twenty lies beyond two standard errors by chance: --confirm runs those without a stated reason again, with
other seeds, and prints both. With --file cells are written as they are done, and a later call adds the runs
that are missing. All of it takes days: with --seconds a cell is given runs until they took that long, three
at least, and with --limit it is left out, and its row says so, where a run with fewer particles took longer
than that. With --recorded nothing is run: each cell of the file is shown with the runs that it has.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from exact_kernels import FEW, KERNELS, REASONS, UNLEARNED, WIDE
from exact_problems import PROBLEMS, Problem
from report import Row, finish, options, show

from bcppl.arrays import Array
from bcppl.beliefs import normalised
from bcppl.inference import tempered_importance_sampling
from bcppl.sweeps import in_order, keep, kept

COUNTS = (75, 1000, 10_000)
LEAST = 3  # runs of a cell, for a standard error


class Cell(NamedTuple):
    """What is run: a problem and a kernel by name, N, and the seeds."""

    problem: str
    kernel: str
    particles: int
    seeds: tuple[int, ...]


class Outcome(NamedTuple):
    """The figures of a cell."""

    runs: int
    bias: float  # of log Z
    deviation: float  # standard deviation of log Z
    log_mean: float  # log of the mean of Zhat / Z
    largest: float  # |z| of the posterior mean, over the axes
    variance: float  # over the exact one
    variance_deviation: float
    seconds: float  # of one run, of the processor

    @property
    def error(self) -> float:
        """The standard error of the bias."""
        return self.deviation / math.sqrt(self.runs)

    @property
    def verdict(self) -> str:
        """Empty where the bias is small; whether it is that of the logarithm of an unbiased estimate."""
        if abs(self.bias) <= min(0.1, 2.0 * self.error):
            return ""
        logarithm = abs(self.bias) <= 2.0 * self.error or (
            abs(self.bias + 0.5 * self.deviation**2) <= 2.0 * self.error
        )
        return "variance" if logarithm else "biased"


class Spend(NamedTuple):
    """How long the runs of a cell may take, and how many there are at least."""

    seconds: float
    least: int = LEAST

    def beside(self, known: Sequence[Outcome]) -> Spend | None:
        """What is left beside runs that there are already; None if nothing."""
        runs = sum(each.runs for each in known)
        left = Spend(self.seconds - sum(each.runs * each.seconds for each in known), max(0, LEAST - runs))
        return left if left.least or left.seconds > 0.0 else None


UNLIMITED = Spend(math.inf)


@cache
def problem_named(name: str) -> Problem:
    return PROBLEMS[name]()


def measured(cell: Cell, spend: Spend = UNLIMITED) -> tuple[tuple[int, ...], Outcome]:
    """The runs of one cell, on one thread: as many as there is time for, and the seeds of these."""
    problem, errors, means, variances = problem_named(cell.problem), [], [], []
    begun = time.process_time()
    for seed in cell.seeds:
        if len(errors) >= spend.least and time.process_time() - begun > spend.seconds:
            break
        torch.manual_seed(seed)
        step = KERNELS[cell.kernel](problem.dimension, cell.particles)
        done = tempered_importance_sampling(
            problem.program, (), {"y": problem.observed}, cell.particles, step
        ).population
        weights, x = normalised(done.log_weights), done["x"]
        errors.append(done.log_evidence - problem.log_evidence)
        mean = weights @ x
        means.append(((mean - problem.mean) / problem.variance.sqrt()).numpy())
        # About the exact mean: about its own it would be too small by one part in the effective sample size.
        variances.append(float((weights @ (x - problem.mean).square() / problem.variance).mean()))
    runs = len(errors)
    fewer = min(1, runs - 1)  # of one run alone the deviation is 0, and counts for nothing where it is pooled
    spread = np.std(means, axis=0, ddof=fewer) / math.sqrt(runs)
    figures = (
        np.mean(errors),
        np.std(errors, ddof=fewer),
        np.logaddexp.reduce(errors) - math.log(runs),
        (np.abs(np.mean(means, axis=0)) / np.maximum(spread, 1e-12)).max(),
        np.mean(variances),
        np.std(variances, ddof=fewer),
        (time.process_time() - begun) / runs,
    )
    return cell.seeds[:runs], Outcome(runs, *(float(f"{figure:.6g}") for figure in figures))


def pooled(outcomes: list[Outcome]) -> Outcome:
    """What a cell's runs give together; of |z| the largest."""
    runs, *figures = (np.array(each) for each in zip(*outcomes, strict=True))
    bias, deviation, log_mean, largest, variance, variance_deviation, seconds = figures
    weights = runs / runs.sum()

    def spread(means: Array, deviations: Array) -> float:
        between = runs @ (means - weights @ means) ** 2
        return float(np.sqrt(((runs - 1) @ deviations**2 + between) / (runs.sum() - 1)))

    return Outcome(
        int(runs.sum()),
        float(weights @ bias),
        spread(bias, deviation),
        float(np.logaddexp.reduce(log_mean + np.log(weights))),
        float(largest.max()),
        float(weights @ variance),
        spread(variance, variance_deviation),
        float(weights @ seconds),
    )


def outcome_of(
    file: Path | None, limit: float, seconds: float, cell: Cell, longest: float = 0.0
) -> Outcome | None:
    """The runs of a cell that the file holds, and those that it lacks where none before took too long."""
    held = held_by(file).get(cell[:3], {})
    known = [Outcome(*outcome) for seeds, outcome in held.items() if {*seeds} <= {*cell.seeds}]
    missing = tuple(sorted({*cell.seeds}.difference(*held)))
    spend = Spend(seconds).beside(known)
    if missing and longest <= limit and spend is not None:
        seeds, outcome = measured(cell._replace(seeds=missing), spend)
        known.append(outcome)
        if file is not None:
            keep(file, cell._replace(seeds=seeds), outcome)
    return pooled(known) if known else None


def held_by(file: Path | None) -> Mapping[tuple[str, str, int], Mapping[tuple[int, ...], list[float]]]:
    """What a file holds, by problem, kernel and number of particles, and by seeds."""
    held: dict[tuple[str, str, int], dict[tuple[int, ...], list[float]]] = {}
    for key, outcome in ({} if file is None else kept(file)).items():
        problem, kernel, particles, seeds = json.loads(key)
        held.setdefault((problem, kernel, particles), {})[tuple(seeds)] = outcome
    return held


def in_turn(file: Path | None, limit: float, seconds: float, cells: list[Cell]) -> list[Outcome | float]:
    """The outcomes with more and more particles; where there is none, the longest run before, in seconds."""
    outcomes: list[Outcome | float] = []
    longest = 0.0
    for cell in cells:
        outcome = outcome_of(file, limit, seconds, cell, longest)
        longest = max(longest, outcome.seconds if outcome else 0.0)
        outcomes.append(outcome or longest)
    return outcomes


def second_opinion(file: Path | None, cell: Cell, others: tuple[int, ...]) -> Outcome | None:
    """The cell with other seeds; without any, the runs of the file with none of its own."""
    if others:
        return outcome_of(file, math.inf, math.inf, cell._replace(seeds=others))
    held = held_by(file).get(cell[:3], {})
    apart = [Outcome(*outcome) for seeds, outcome in held.items() if not {*seeds} & {*cell.seeds}]
    return pooled(apart) if apart else None


def reason(file: Path | None, cell: Cell, others: tuple[int, ...]) -> str:
    """Why a kernel is biased: as stated, or what other seeds give."""
    if cell.kernel in REASONS:
        return REASONS[cell.kernel]
    axes = problem_named(cell.problem).dimension
    learning = "independent" in cell.kernel or cell.kernel == "delayed acceptance"
    if learning and axes * (axes + 3) > cell.particles:
        return UNLEARNED
    if "independent" in cell.kernel and axes >= 50:
        return WIDE
    if cell.particles < 1000:
        return FEW
    again = second_opinion(file, cell, others)
    if again is None:
        return "unexplained"
    found = {"": "chance, ", "variance": "variance, ", "biased": "unexplained, "}[again.verdict]
    return f"{found}{again.runs} other seeds give {again.bias:+.3f} ± {again.error:.3f}"


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS), metavar="NAME")
    parser.add_argument("--kernels", nargs="+", choices=KERNELS, default=list(KERNELS), metavar="NAME")
    parser.add_argument("--counts", nargs="+", type=int, default=list(COUNTS), metavar="N")
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--confirm", type=int, default=0, metavar="RUNS", help="seeds for a second opinion")
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time")
    parser.add_argument(
        "--limit", type=float, default=math.inf, help="seconds that a run with fewer particles may take"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=math.inf,
        help="of the processor that the runs of a cell may take",
    )
    parser.add_argument("--file", type=Path, help="where the outcome of each cell is kept")
    parser.add_argument("--recorded", action="store_true", help="show what --file holds, and run nothing")
    arguments = parser.parse_args()
    if arguments.recorded and not (arguments.file and arguments.file.exists()):
        parser.error("--recorded shows what --file holds; give a file that exists.")
    torch.set_num_threads(1)
    problems, kernels, counts, runs = (
        (list(PROBLEMS)[:4], ["drift", "hmc"], [75], 5)
        if arguments.quick
        else (arguments.problems, arguments.kernels, arguments.counts, arguments.runs)
    )
    seeds = tuple(range(arguments.seed, arguments.seed + runs))
    others = tuple(range(arguments.seed + runs, arguments.seed + runs + arguments.confirm))
    kernels_on = [[Cell(p, k, n, seeds) for n in sorted(counts)] for p in problems for k in kernels]
    limit = -1.0 if arguments.recorded else arguments.limit
    work = partial(in_turn, arguments.file, limit, arguments.seconds)
    outcomes = in_order(work, kernels_on, arguments.jobs)
    done = dict(zip(chain(*kernels_on), chain(*outcomes), strict=True))
    rows: list[Row] = []
    for problem in problems:
        lines = []
        for cell in (Cell(problem, k, n, seeds) for n in sorted(counts) for k in kernels):
            figures = done[cell]
            if isinstance(figures, float):
                took = f"> {figures:.1f}" if figures else ""
                lines.append([cell.kernel, cell.particles, 0, *"-----", took, "not run"])
                continue
            name = f"{problem}, {cell.kernel}, N = {cell.particles}"
            # Goals where theory promises them: many particles, and not more axes than they can learn.
            goal = cell.particles >= 1000 and "D = 100" not in problem
            rows += [
                Row(f"{name}: |bias of log Z|", abs(figures.bias), "nats", 0.1 if goal else None),
                Row(
                    f"{name}: bias in standard errors",
                    abs(figures.bias) / figures.error,
                    "1",
                    2.0 if goal else None,
                ),
                Row(f"{name}: log of the mean of Zhat / Z", figures.log_mean, "nats"),
                Row(f"{name}: sd of log Z", figures.deviation, "nats"),
                Row(f"{name}: largest |z| of a mean", figures.largest, "1"),
                Row(f"{name}: variance over the exact one", figures.variance, "1"),
            ]
            lines.append(
                [
                    cell.kernel,
                    cell.particles,
                    figures.runs,
                    f"{figures.bias:+.3f} ± {figures.error:.3f}",
                    f"{figures.deviation:.3f}",
                    f"{figures.log_mean:+.3f}",
                    f"{figures.largest:.1f}",
                    f"{figures.variance:.3f} ± {figures.variance_deviation / math.sqrt(figures.runs):.3f}",
                    figures.seconds,
                    figures.verdict,
                ]
            )
        columns = [
            "kernel",
            "N",
            "runs",
            "bias of log Z",
            "sd",
            "log mean Zhat/Z",
            "|z| of means",
            "variance",
            "s",
            "",
        ]
        show(problem, columns, lines)
        for kernel, particles, *_, verdict in lines:
            if verdict == "biased":
                why = reason(arguments.file, Cell(problem, kernel, particles, seeds), others)
                print(f"biased, {kernel}, N = {particles}: {why}", flush=True)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
