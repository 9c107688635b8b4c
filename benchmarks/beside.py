"""bcppl beside other packages: squared errors of log Z at the same number of likelihood calls, and times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from evidence import PROBLEMS, run, within
from kernel_table import COMPARED, LIKE_THEIRS
from peer import ask
from report import Row, show

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
TIMED = 10_000


def ratio(ours: Sequence[float], theirs: Sequence[float], draws: int = 10_000) -> tuple[float, float, float]:
    """The ratio of two mean squared errors, and its 2.5 and 97.5 % bounds.

    By the bootstrap: both sets of runs are resampled, each with replacement (percentile interval; Efron and
    Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3).
    """
    generator = np.random.default_rng(0)

    def means(errors: Sequence[float]) -> np.ndarray[Any, Any]:
        squared = np.square(errors)
        return squared[generator.integers(len(squared), size=(draws, len(squared)))].mean(1)

    low, high = np.quantile(means(ours) / means(theirs), (0.025, 0.975))
    return float(np.mean(np.square(ours)) / np.mean(np.square(theirs))), float(low), float(high)


def beside(seed: int, runs: int, counts: tuple[int, ...]) -> list[Row]:
    """Beside other packages: squared errors at the same number of likelihood calls, and times."""
    asked = [*counts, "--runs", runs, "--seed", seed]
    theirs: list[dict[str, Any]] = []
    for peer in ("particles", "blackjax"):
        theirs += ask(peer, f"{peer}_tempering.py", *asked, environment=ONE_THREAD) or []
    rows: list[Row] = []
    lines: list[list[Any]] = []
    for result in sorted(theirs, key=lambda r: (r["problem"], r["particles"])):
        for kernel, method in (("drift", LIKE_THEIRS), ("independent", COMPARED)):
            who = f"{result['peer']} {result['variant']}"
            best = method is COMPARED
            # Like for like once for each problem and N; the best kernel against all of them.
            if not best and who != "particles standard":
                continue
            problem = PROBLEMS[result["problem"]]
            allowed = float(np.mean(result["calls"]))
            particles = within(problem, method, allowed, seed)
            ours = [run(problem, method, particles, seed + k) for k in range(runs)]
            errors, calls = [one.error for one in ours], float(np.mean([one.calls for one in ours]))
            against, low, high = ratio(errors, result["errors"])
            seconds = float(np.median([one.seconds for one in ours]))
            slower = seconds / float(np.median(result["seconds"]))
            lines.append(
                [
                    result["problem"],
                    who,
                    kernel,
                    result["particles"],
                    particles,
                    int(allowed),
                    f"{calls / allowed:.2f}",
                    f"{np.mean(np.square(result['errors'])):.2g}",
                    f"{np.mean(np.square(errors)):.2g}",
                    f"{against:.2f} [{low:.2f}, {high:.2f}]",
                    f"{np.median(result['seconds']):.3g}",
                    f"{seconds:.3g}",
                    slower,
                ]
            )
            name = f"{result['problem']}, {kernel} and {who}, N {result['particles']}"
            rows += [
                Row(f"{name}: squared error, ours over theirs", against, "ratio", 1.0 if best else None),
                Row(f"{name}: the same, 2.5 % bound", low, "ratio"),
                Row(f"{name}: the same, 97.5 % bound", high, "ratio"),
                Row(f"{name}: likelihood calls, ours over theirs", calls / allowed, "ratio"),
                Row(f"{name}: time at these calls, ours over theirs", slower, "ratio"),
            ]
    if lines:
        show(
            f"beside other packages: {runs} runs each, ratios with 95 % bootstrap intervals, one thread",
            [
                "problem",
                "peer",
                "our kernel",
                "its N",
                "our N",
                "calls",
                "ours",
                "its error^2",
                "ours",
                "ratio",
                "its s",
                "ours",
                "ratio",
            ],
            lines,
        )
    return rows


def timed(seed: int, passes: int = 3, runs: int = 10) -> list[Row]:
    """Times at equal N, alternating with `particles`, so that a busy machine slows both."""
    rows: list[Row] = []
    lines: list[list[Any]] = []
    for name, problem in PROBLEMS.items():
        run(problem, COMPARED, TIMED, seed)
        seconds: dict[str, list[float]] = {"standard": [], "waste-free": [], "ours": []}
        for _ in range(passes):
            asked = (TIMED, "--problems", name, "--runs", runs, "--seed", seed)
            theirs = ask("particles", "particles_tempering.py", *asked, environment=ONE_THREAD)
            if theirs is None:
                return []
            for result in theirs:
                seconds[result["variant"]].append(float(np.median(result["seconds"])))
            ours = [run(problem, COMPARED, TIMED, seed + k).seconds for k in range(runs)]
            seconds["ours"].append(float(np.median(ours)))
        for variant, goal in (("standard", 2.0), ("waste-free", None)):
            slower = float(np.median(np.divide(seconds["ours"], seconds[variant])))
            medians = [f"{np.median(seconds[who]):.3g}" for who in (variant, "ours")]
            lines.append([name, f"particles {variant}", *medians, slower])
            title = f"{name}, {TIMED} particles: time, ours over particles' {variant}"
            rows.append(Row(title, slower, "ratio", goal))
    show(f"{TIMED} particles, median of {passes} passes", ["", "peer", "its s", "ours", "ratio"], lines)
    return rows
