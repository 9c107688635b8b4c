"""`particles`: evidence by adaptive tempering, standard and waste-free.

Its defaults: the next exponent keeps the effective sample size at half of N, systematic resampling, chains
of ten whose nine moves are random walks shaped by the particles' covariance. One line for each N and variant.
Waste-free runs with N particles in all: `SMC(N=)` counts chains there, so it is given N over their length.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import particles
from particles import distributions, smc_samplers
from problems import (
    GAUSSIAN_AXES,
    GAUSSIAN_LOG_EVIDENCE,
    SHELL_HALF,
    SHELLS_LOG_EVIDENCE,
    emit,
    gaussian_log_likelihood,
    shells_log_likelihood,
)

CHAIN = 10

PROBLEMS: dict[str, tuple[Any, Callable[[Any], Any], float]] = {
    "gaussian": (
        distributions.IndepProd(*[distributions.Normal()] * GAUSSIAN_AXES),
        gaussian_log_likelihood,
        GAUSSIAN_LOG_EVIDENCE,
    ),
    "shells": (
        distributions.IndepProd(*[distributions.Uniform(-SHELL_HALF, SHELL_HALF)] * 2),
        shells_log_likelihood,
        SHELLS_LOG_EVIDENCE,
    ),
}


class Bridge(smc_samplers.TemperingBridge):
    """From a prior to its product with a likelihood, whose calls it counts."""

    def __init__(self, prior: Any, log_likelihood: Callable[[Any], Any]) -> None:
        super().__init__(base_dist=prior)
        self.log_likelihood = log_likelihood
        self.calls = 0

    def loglik(self, theta: Any) -> Any:
        """Asked for directly, so the prior is not added and taken away again."""
        self.calls += len(theta)
        return self.log_likelihood(theta)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("counts", type=int, nargs="+", metavar="N", help="how many particles")
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument("--runs", type=int, default=100, help="after one that is not counted")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for problem in arguments.problems:
        prior, log_likelihood, exact = PROBLEMS[problem]
        for count in arguments.counts:
            for waste_free in (False, True):
                errors, calls, seconds, steps = [], [], [], []
                for run in range(arguments.runs + 1):
                    np.random.seed(arguments.seed + run)
                    bridge = Bridge(prior, log_likelihood)
                    model = smc_samplers.AdaptiveTempering(
                        model=bridge, wastefree=waste_free, len_chain=CHAIN
                    )
                    smc = particles.SMC(fk=model, N=max(2, count // CHAIN) if waste_free else count)
                    begun = time.perf_counter()
                    # A start outside the prior's support has log-density -inf: it is no trouble.
                    with np.errstate(all="ignore"):
                        smc.run()
                    seconds.append(time.perf_counter() - begun)
                    errors.append(float(smc.logLt) - exact)
                    calls.append(bridge.calls)
                    steps.append(int(smc.t))
                emit(
                    peer="particles",
                    variant="waste-free" if waste_free else "standard",
                    problem=problem,
                    particles=count,
                    errors=errors[1:],
                    calls=calls[1:],
                    seconds=seconds[1:],
                    steps=steps[1:],
                )


if __name__ == "__main__":
    main()
