"""Evidence and posterior moments of problems with exact answers, for every kernel in tempered SMC.

For each problem, kernel and number of particles the bias of log Z over several seeds, beside its standard
error; the log of the mean of the estimated evidence over the exact one, which is what theory makes unbiased
(the mean of a logarithm is lower by about half the variance); and the posterior moments: the largest |z| of a
mean over the axes, and the mean ratio of estimated to exact variance.

A bias is explained where it is within two standard errors of minus half the variance of log Z; for other
kernels that are known to be biased `REASONS` states why. All kernels of a problem have the same seeds, so
their errors are correlated: a bias common to all of them is one draw, not many. Of so many cells one in
twenty lies beyond two standard errors by chance: --confirm runs those without a stated reason again, with
other seeds, and prints both. With --file cells are written as they are done, and a later call adds those that
are missing. With --limit a cell is left out, and its row says so, where a run with fewer particles took
longer than that. With --recorded nothing is run: each cell of the file is shown with as many runs as it has.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from exact_kernels import FEW, KERNELS, REASONS, UNLEARNED, WIDE
from exact_problems import PROBLEMS, Problem
from jobs import each
from kept import added, recorded
from report import Row, finish, options, show

from bcppl.beliefs import normalised
from bcppl.inference import tempered_importance_sampling

COUNTS = (75, 1000, 10_000)


class Cell(NamedTuple):
    """What is run: a problem and a kernel by name, N, and the seeds."""

    problem: str
    kernel: str
    particles: int
    seeds: tuple[int, ...]


class Outcome(NamedTuple):
    """What came out of a cell's runs: errors of log Z, posterior moments over the exact ones, seconds."""

    errors: list[float]
    means: list[list[float]]  # of each run, in exact standard deviations
    variances: list[float]  # of each run, its mean ratio over the axes
    seconds: float


@cache
def problem_named(name: str) -> Problem:
    return PROBLEMS[name]()


def measured(cell: Cell) -> Outcome:
    """The runs of one cell, on one thread."""
    problem, errors, means, variances = problem_named(cell.problem), [], [], []
    begun = time.perf_counter()
    for seed in cell.seeds:
        torch.manual_seed(seed)
        step = KERNELS[cell.kernel](problem.dimension, cell.particles)
        done = tempered_importance_sampling(
            problem.program, (), {"y": problem.observed}, cell.particles, step
        ).population
        weights, x = normalised(done.log_weights), done["x"]
        errors.append(done.log_evidence - problem.log_evidence)
        mean = weights @ x
        means.append(((mean - problem.mean) / problem.variance.sqrt()).tolist())
        # About the exact mean: about its own it would be too small by one part in the effective sample size.
        variances.append(float((weights @ (x - problem.mean).square() / problem.variance).mean()))
    return Outcome(errors, means, variances, time.perf_counter() - begun)


class Summary(NamedTuple):
    """The figures of a cell."""

    bias: float
    error: float  # standard error of the bias
    deviation: float  # standard deviation of log Z
    log_mean: float  # log of the mean of Zhat / Z
    largest: float  # |z| of the posterior mean, over the axes
    variance: float
    variance_error: float
    seconds: float  # of one run

    @property
    def verdict(self) -> str:
        """Empty where the bias is small; whether it is that of the logarithm of an unbiased estimate."""
        if abs(self.bias) <= min(0.1, 2.0 * self.error):
            return ""
        logarithm = abs(self.bias) <= 2.0 * self.error or (
            abs(self.bias + 0.5 * self.deviation**2) <= 2.0 * self.error
        )
        return "variance" if logarithm else "biased"


def summary(outcome: Outcome) -> Summary:
    errors, means, variances = (np.array(v) for v in outcome[:3])
    runs = len(errors)
    root = math.sqrt(runs)
    deviation = float(errors.std(ddof=1))
    spread = means.std(axis=0, ddof=1) / root
    return Summary(
        float(errors.mean()),
        deviation / root,
        deviation,
        float(np.logaddexp.reduce(errors) - math.log(runs)),
        float((np.abs(means.mean(axis=0)) / np.maximum(spread, 1e-12)).max()),
        float(variances.mean()),
        float(variances.std(ddof=1)) / root,
        outcome.seconds / runs,
    )


def in_turn(outcome_of: Callable[[Cell, float], Outcome | None], cells: list[Cell]) -> list[Outcome | float]:
    """The outcomes with more and more particles, given the seconds of the longest run before each.

    Where there is no outcome, these seconds stand in its place.
    """
    outcomes: list[Outcome | float] = []
    longest = 0.0
    for cell in cells:
        outcome = outcome_of(cell, longest)
        if outcome is not None:
            longest = max(longest, outcome.seconds / len(outcome.errors))
        outcomes.append(longest if outcome is None else outcome)
    return outcomes


def run_within(file: Path | None, limit: float, cell: Cell, longest: float) -> Outcome | None:
    """A cell as the file holds it, or else run; None where a run before it took longer than the limit."""
    known = recorded(file, cell)
    if known is None and longest > limit:
        return None
    return Outcome(*(known or added(file, cell, partial(measured, cell))))


@cache
def cells_of(file: Path) -> Mapping[tuple[str, str, int], Mapping[tuple[int, ...], Outcome]]:
    """What a file holds, by problem, kernel and number of particles, and by seeds."""
    held: dict[tuple[str, str, int], dict[tuple[int, ...], Outcome]] = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        (problem, kernel, particles, seeds), outcome = json.loads(line)
        held.setdefault((problem, kernel, particles), {})[tuple(seeds)] = Outcome(*outcome)
    return held


def as_recorded(file: Path, cell: Cell, _: float) -> Outcome | None:
    """Of a cell in a file the most runs that begin with its first seed."""
    runs = cells_of(file).get(cell[:3], {})
    own = [outcome for seeds, outcome in runs.items() if seeds[0] == cell.seeds[0]]
    return max(own, key=lambda outcome: len(outcome.errors), default=None)


def second_opinion(cell: Cell, file: Path | None, first: int) -> Outcome | None:
    """The cell with its own seeds; without any, the most runs of a file that do not begin with the first."""
    if cell.seeds:
        return run_within(file, math.inf, cell, 0.0)
    runs = {} if file is None or not file.exists() else cells_of(file).get(cell[:3], {})
    others = [outcome for seeds, outcome in runs.items() if seeds[0] != first]
    return max(others, key=lambda outcome: len(outcome.errors), default=None)


def reason(cell: Cell, file: Path | None, first: int) -> str:
    """Why a kernel is biased: as stated, or what a cell with other seeds than the first ones gives."""
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
    opinion = second_opinion(cell, file, first)
    if opinion is None:
        return "unexplained"
    again = summary(opinion)
    found = {"": "chance, ", "variance": "variance, ", "biased": "unexplained, "}[again.verdict]
    return f"{found}{len(opinion.errors)} other seeds give {again.bias:+.3f} ± {again.error:.3f}"


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
    outcome_of = (
        partial(as_recorded, arguments.file)
        if arguments.recorded
        else partial(run_within, arguments.file, arguments.limit)
    )
    outcomes = each(partial(in_turn, outcome_of), kernels_on, 1 if arguments.recorded else arguments.jobs)
    done = dict(zip(chain(*kernels_on), chain(*outcomes), strict=True))
    rows: list[Row] = []
    for problem in problems:
        lines = []
        for cell in (Cell(problem, k, n, seeds) for n in sorted(counts) for k in kernels):
            outcome = done[cell]
            if isinstance(outcome, float):
                took = f"> {outcome:.1f}" if outcome else ""
                lines.append([cell.kernel, cell.particles, 0, *"-----", took, "not run"])
                continue
            figures = summary(outcome)
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
                    len(outcome.errors),
                    f"{figures.bias:+.3f} ± {figures.error:.3f}",
                    f"{figures.deviation:.3f}",
                    f"{figures.log_mean:+.3f}",
                    f"{figures.largest:.1f}",
                    f"{figures.variance:.3f} ± {figures.variance_error:.3f}",
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
                why = reason(Cell(problem, kernel, particles, others), arguments.file, seeds[0])
                print(f"biased, {kernel}, N = {particles}: {why}", flush=True)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
