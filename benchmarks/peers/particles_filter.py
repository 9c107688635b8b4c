"""`particles`: a bootstrap filter of the linear-Gaussian series.

One line per N: milliseconds a step (median of the repeats, and each of them), log evidence of each repeat,
and the exact one.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import particles
from particles import distributions, state_space_models
from problems import NOISE, WALK, emit, linear_gaussian


class Walk(state_space_models.StateSpaceModel):
    """The series; its first state is one step after N(0, 1)."""

    def PX0(self) -> Any:
        """The first state."""
        return distributions.Normal(scale=np.sqrt(1 + WALK**2))

    def PX(self, t: int, xp: Any) -> Any:
        """The next state."""
        return distributions.Normal(loc=xp, scale=WALK)

    def PY(self, t: int, xp: Any, x: Any) -> Any:
        """The observation."""
        return distributions.Normal(loc=x, scale=NOISE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("counts", type=int, nargs="+", metavar="N", help="how many particles")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--repeats", type=int, default=5, help="after one that is not counted")
    parser.add_argument("--seed", type=int, default=0, help="of the filter; the data are always the same")
    parser.add_argument("--threshold", type=float, default=0.5, help="resample below this share of N")
    arguments = parser.parse_args()
    observed, exact = linear_gaussian(arguments.steps)
    for count in arguments.counts:
        np.random.seed(arguments.seed)
        milliseconds, log_evidences = [], []
        for _ in range(arguments.repeats + 1):
            model = state_space_models.Bootstrap(ssm=Walk(), data=observed)
            smc = particles.SMC(fk=model, N=count, resampling="systematic", ESSrmin=arguments.threshold)
            begun = time.perf_counter()
            smc.run()
            milliseconds.append(1e3 * (time.perf_counter() - begun) / arguments.steps)
            log_evidences.append(float(smc.logLt))
        emit(
            peer="particles",
            particles=count,
            steps=arguments.steps,
            milliseconds_per_step=float(np.median(milliseconds[1:])),
            each_milliseconds_per_step=milliseconds[1:],
            log_evidences=log_evidences[1:],
            exact=exact,
        )


if __name__ == "__main__":
    main()
