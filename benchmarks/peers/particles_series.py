"""`particles`: PMMH and SMC^2 for the persistence of the autoregression.

One line per run: the posterior mean as the run estimates it, its log evidence (SMC^2), and processor seconds.
PMMH adapts its random walk, as the package does by default; a fifth of a chain is left out. SMC^2 is
waste-free, the package's default.
"""

from __future__ import annotations

import argparse
import time
from typing import Any, ClassVar

import numpy as np
import particles
from particles import distributions, mcmc, smc_samplers, state_space_models
from problems import SERIES_NOISE, autoregression, emit


class Autoregression(state_space_models.StateSpaceModel):
    """The series; its first state is one step after N(0, 1)."""

    default_params: ClassVar = {"rho": 0.0}

    def PX0(self) -> Any:
        """The first state."""
        return distributions.Normal(scale=np.sqrt(1.0 + self.rho**2))

    def PX(self, t: int, xp: Any) -> Any:
        """The next state."""
        return distributions.Normal(loc=self.rho * xp, scale=1.0)

    def PY(self, t: int, xp: Any, x: Any) -> Any:
        """The observation."""
        return distributions.Normal(loc=x, scale=SERIES_NOISE)


def pmmh(observed: Any, prior: Any, states: int, moves: int) -> dict[str, float]:
    """One chain from a draw of the prior."""
    chain = mcmc.PMMH(
        niter=moves, ssm_cls=Autoregression, prior=prior, data=observed, Nx=states, theta0=prior.rvs(size=1)
    )
    chain.run()
    return {
        "mean": float(chain.chain.theta["rho"][moves // 5 :].mean()),
        "acceptance": float(np.mean(np.diff(chain.chain.theta["rho"]) != 0.0)),
    }


def smc_squared(observed: Any, prior: Any, states: int, thetas: int) -> dict[str, float]:
    """One run; a tenth of the particles are resampled, and make chains of ten."""
    model = smc_samplers.SMC2(
        ssm_cls=Autoregression, prior=prior, data=observed, init_Nx=states, len_chain=10
    )
    run = particles.SMC(fk=model, N=thetas // 10)
    run.run()
    return {"mean": float(np.average(run.X.theta["rho"], weights=run.W)), "log_evidence": float(run.logLt)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--states", type=int, default=300, help="particles of each filter")
    parser.add_argument("--chains", type=int, default=8)
    parser.add_argument("--moves", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=8, help="of SMC^2")
    parser.add_argument("--thetas", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    observed = autoregression(arguments.steps)
    prior = distributions.StructDist({"rho": distributions.Uniform(a=-1.0, b=1.0)})
    np.random.seed(arguments.seed)
    for name, count, run, size in (
        ("pmmh", arguments.chains, pmmh, arguments.moves),
        ("smc2", arguments.runs, smc_squared, arguments.thetas),
    ):
        for _ in range(count):
            begun = time.process_time()
            estimated = run(observed, prior, arguments.states, size)
            emit(peer="particles", method=name, seconds=time.process_time() - begun, **estimated)


if __name__ == "__main__":
    main()
