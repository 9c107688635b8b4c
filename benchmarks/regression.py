"""Effective draws a second of a logistic regression with 50 coefficients, beside BlackJAX.

Each sampler is a process of its own, timed from its start to its end: imports, compilation, warm-up and
draws. bcppl runs many chains of adaptive HMC, which start from tempering from the prior; BlackJAX runs NUTS
and HMC with a window-adapted step size and mass (diagonal, as in Stan). Effective draws are the smallest of
all coefficients' bulk effective sample sizes (Vehtari, Gelman, Simpson, Carpenter and Buerkner, Bayesian
Analysis 16, 2021), of the chains together. All must agree on the posterior mean and variance of every
coefficient.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from peer import ask
from report import Row, cores, finish, options, show

CHAINS, DRAWS, SWEEPS = 256, 400, 1
AGREEMENT = 4.5  # standard errors, of the largest of 100 differences


class Drawn(NamedTuple):
    """Draws (chains, draws, coefficients), the seconds of the whole process, and what it reported."""

    draws: np.ndarray[Any, Any]
    seconds: float
    report: dict[str, Any]


def sample(file: Path, chains: int, draws: int, seed: int) -> None:
    """Bcppl's own process: what a user would write."""
    begun = time.perf_counter()
    import pyro
    import pyro.distributions as dist
    import torch
    from peers.problems import FEATURES, logistic_regression

    from bcppl.inference import markov_chains, tempered, tempered_importance_sampling
    from bcppl.inference.learning import adaptive_hmc

    torch.set_num_threads(cores())
    features, labels = (torch.from_numpy(each) for each in logistic_regression())

    def program() -> None:
        b = pyro.sample("b", dist.Normal(torch.zeros(FEATURES, dtype=torch.float64), 1.0).to_event(1))
        pyro.sample("y", dist.Bernoulli(logits=b @ features.T).to_event(1))

    torch.manual_seed(seed)
    kernel = adaptive_hmc("b")
    imported = time.perf_counter()
    start, _ = tempered_importance_sampling(
        program, (), {"y": labels}, chains, tempered(kernel, sweeps=SWEEPS)
    )
    warm = time.perf_counter()
    drawn = markov_chains(kernel, start, draws, warm_up=2, progress=False)
    ended = time.perf_counter()
    np.save(file, drawn.draws["b"].transpose(0, 1).numpy())
    seconds = {"importing": imported - begun, "tempering": warm - imported, "chains": ended - warm}
    print(json.dumps({**seconds, "acceptance": float(drawn.acceptance.mean())}))


def own(chains: int, draws: int, seed: int) -> Drawn | None:
    """Draws of bcppl."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "draws.npy"
        command = [sys.executable, __file__, "--sample", str(file), str(chains), str(draws), str(seed)]
        begun = time.perf_counter()
        # Threads that wait for others give their core away: on a busy machine they would hold it in vain.
        variables = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
        done = subprocess.run(command, env=variables, capture_output=True, text=True, check=True)
        seconds = time.perf_counter() - begun
        return Drawn(np.load(file), seconds, json.loads(done.stdout.splitlines()[-1]))


def peer(algorithm: str, *arguments: object) -> Drawn | None:
    """Draws of BlackJAX; None where it has no environment."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "draws.npy"
        begun = time.perf_counter()
        answer = ask("blackjax", "blackjax_regression.py", algorithm, file, *arguments)
        seconds = time.perf_counter() - begun
        return None if answer is None else Drawn(np.load(file), seconds, answer[0])


def effective(draws: np.ndarray[Any, Any], method: str = "bulk") -> float:
    """The smallest effective sample size of all coefficients."""
    import arviz

    with np.errstate(all="ignore"):
        return float(arviz.ess({"b": draws}, method=method)["b"].min())


def moments(draws: np.ndarray[Any, Any]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Posterior means and variances (2, coefficients), and their standard errors."""
    import arviz

    off = draws - draws.mean(axis=(0, 1))
    both = np.stack([draws, off**2])
    errors = [arviz.mcse({"b": each}, method="mean")["b"].to_numpy() for each in both]
    return both.mean(axis=(1, 2)), np.stack(errors)


def disagreement(first: Drawn, second: Drawn) -> float:
    """The largest difference of posterior means and variances, in standard errors."""
    (values, errors), (others, their_errors) = moments(first.draws), moments(second.draws)
    return float((np.abs(values - others) / np.hypot(errors, their_errors)).max())


def samplers(quick: bool, seed: int) -> dict[str, Callable[[], Drawn | None]]:
    """By name, what runs."""
    if quick:
        few = ("--chains", 2, "--warm-up", 300, "--draws", 300, "--seed", seed)
        return {
            "bcppl": lambda: own(64, 50, seed),
            "BlackJAX NUTS": lambda: peer("nuts", *few),
            "BlackJAX HMC": lambda: peer("hmc", *few),
        }
    return {
        "bcppl": lambda: own(CHAINS, DRAWS, seed),
        "BlackJAX NUTS": lambda: peer("nuts", "--seed", seed),
        "BlackJAX NUTS, 10 times the draws": lambda: peer("nuts", "--seed", seed, "--draws", 10_000),
        "BlackJAX HMC": lambda: peer("hmc", "--seed", seed),
        "BlackJAX HMC, 32 chains": lambda: peer("hmc", "--seed", seed, "--chains", 32),
    }


def main() -> None:
    if sys.argv[1:2] == ["--sample"]:
        file, *numbers = sys.argv[2:]
        sample(Path(file), *map(int, numbers))
        return
    parser = options(__doc__ or "")
    parser.add_argument("--runs", type=int, help="of each sampler, one after another in turn; 3 unless given")
    arguments = parser.parse_args()
    rows: list[Row] = []
    lines: list[list[Any]] = []
    speeds: dict[str, list[float]] = {}
    first: dict[str, Drawn] = {}
    for run in range(arguments.runs or (1 if arguments.quick else 3)):
        for name, draw in samplers(arguments.quick, arguments.seed + run).items():
            drawn = draw()
            if drawn is None:
                continue
            first.setdefault(name, drawn)
            bulk, tail = effective(drawn.draws), effective(drawn.draws, "tail")
            speeds.setdefault(name, []).append(bulk / drawn.seconds)
            report = ", ".join(f"{key} {value:.2f}" for key, value in drawn.report.items())
            lines.append([name, drawn.seconds, bulk, tail, bulk / drawn.seconds, report])
    show(
        "logistic regression, 50 coefficients, 1000 rows: seconds with start-up, effective draws",
        ["sampler", "s", "bulk", "tail", "bulk per s", "of which (s)"],
        lines,
    )
    medians = {name: float(np.median(each)) for name, each in speeds.items()}
    rows += [
        Row(f"{name}: effective draws a second", v, "1/s", direction="min") for name, v in medians.items()
    ]
    for name, drawn in first.items():
        if name != "bcppl":
            off = disagreement(first["bcppl"], drawn)
            rows.append(Row(f"moments, bcppl and {name}, apart at most", off, "standard errors", AGREEMENT))
            ratio = medians["bcppl"] / medians[name]
            goal = None if arguments.quick else 1.0
            rows.append(Row(f"effective draws a second, bcppl over {name}", ratio, "", goal, "min"))
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
