"""BlackJAX: evidence by adaptive tempering.

Effective sample size kept at half of N, systematic resampling, nine random walks, their covariance that of
the weighted particles after each tempering step, times 2.38^2 / d. One line per problem and N. Compilation is
reported apart. Single precision, JAX's default, unless --double.

Its order is resample, move at the temperature before, weigh: the last particles are weighted and have not
been moved at temperature 1. So for each tempering step and particle the likelihood is asked once to choose
the temperature, once to begin the chain, once for each move and once for the weight; all of them count.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import blackjax
import jax
import jax.numpy as jnp
from blackjax.smc import extend_params, resampling
from problems import (
    GAUSSIAN_AXES,
    GAUSSIAN_LOG_EVIDENCE,
    GAUSSIAN_PEAK,
    GAUSSIAN_PRECISION,
    SHELL_CENTRE,
    SHELL_HALF,
    SHELL_RADIUS,
    SHELL_WIDTH,
    SHELLS_LOG_EVIDENCE,
    emit,
)

MOVES = 9
CALLS = 1 + 1 + MOVES + 1  # of the likelihood, for each particle and tempering step


def gaussian_prior(x: Any) -> Any:
    return -0.5 * jnp.sum(x**2) - 0.5 * GAUSSIAN_AXES * jnp.log(2 * jnp.pi)


def gaussian_likelihood(x: Any) -> Any:
    return GAUSSIAN_PEAK - 0.5 * x @ jnp.asarray(GAUSSIAN_PRECISION) @ x


def shells_prior(x: Any) -> Any:
    return jnp.where(jnp.all(jnp.abs(x) <= SHELL_HALF), -2 * jnp.log(2 * SHELL_HALF), -jnp.inf)


def shells_likelihood(x: Any) -> Any:
    off = jnp.array([jnp.hypot(x[0] - c, x[1]) - SHELL_RADIUS for c in (-SHELL_CENTRE, SHELL_CENTRE)])
    peak = -0.5 * jnp.log(2 * jnp.pi * SHELL_WIDTH**2)
    return jax.scipy.special.logsumexp(peak - off**2 / (2 * SHELL_WIDTH**2))


def gaussian_draws(key: Any, count: int) -> Any:
    return jax.random.normal(key, (count, GAUSSIAN_AXES))


def shells_draws(key: Any, count: int) -> Any:
    return jax.random.uniform(key, (count, 2), minval=-SHELL_HALF, maxval=SHELL_HALF)


PROBLEMS: dict[str, tuple[Any, Any, Any, int, float]] = {
    "gaussian": (gaussian_prior, gaussian_likelihood, gaussian_draws, GAUSSIAN_AXES, GAUSSIAN_LOG_EVIDENCE),
    "shells": (shells_prior, shells_likelihood, shells_draws, 2, SHELLS_LOG_EVIDENCE),
}


def sampler(prior: Any, likelihood: Any, axes: int) -> Callable[[Any, Any], Any]:
    """`(key, particles (N, axes)) -> (tempering steps, log evidence)`, ready to be compiled."""
    walk = blackjax.additive_step_random_walk
    step = walk.build_kernel()

    def move(key: Any, state: Any, log_density: Any, factor: Any) -> Any:
        return step(key, state, log_density, lambda k, at: factor @ jax.random.normal(k, at.shape))

    def fitted(key: Any, state: Any, info: Any) -> Any:
        off = state.particles - state.weights @ state.particles
        covariance = off.T @ (off * state.weights[:, None]) + 1e-10 * jnp.eye(axes)
        return extend_params({"factor": 2.38 / jnp.sqrt(axes) * jnp.linalg.cholesky(covariance)})

    algorithm = blackjax.inner_kernel_tuning(
        smc_algorithm=blackjax.adaptive_tempered_smc,
        logprior_fn=prior,
        loglikelihood_fn=likelihood,
        mcmc_step_fn=move,
        mcmc_init_fn=walk.init,
        resampling_fn=resampling.systematic,
        mcmc_parameter_update_fn=fitted,
        initial_parameter_value=extend_params({"factor": 2.38 / jnp.sqrt(axes) * jnp.eye(axes)}),
        num_mcmc_steps=MOVES,
        target_ess=0.5,
    )

    def run(key: Any, start: Any) -> Any:
        def unfinished(carry: Any) -> Any:
            return carry[1].sampler_state.tempering_param < 1

        def temper(carry: Any) -> Any:
            key, state, steps, log_evidence = carry
            key, mine = jax.random.split(key)
            state, info = algorithm.step(mine, state)
            return key, state, steps + 1, log_evidence + info.log_likelihood_increment

        _, _, steps, log_evidence = jax.lax.while_loop(
            unfinished, temper, (key, algorithm.init(start), 0, 0.0)
        )
        return steps, log_evidence

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("counts", type=int, nargs="+", metavar="N", help="how many particles")
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument("--runs", type=int, default=100, help="after one that is not counted")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--double", action="store_true", help="double precision")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", arguments.double)
    for problem in arguments.problems:
        prior, likelihood, draws, axes, exact = PROBLEMS[problem]
        for count in arguments.counts:
            begun = time.perf_counter()
            start = draws(jax.random.key(0), count)
            run = jax.jit(sampler(prior, likelihood, axes)).lower(jax.random.key(0), start).compile()
            compilation = time.perf_counter() - begun
            errors, calls, seconds, steps = [], [], [], []
            for k in range(arguments.runs + 1):
                key, first = jax.random.split(jax.random.key(arguments.seed + k))
                start = draws(first, count).block_until_ready()
                begun = time.perf_counter()
                tempered, log_evidence = jax.block_until_ready(run(key, start))
                seconds.append(time.perf_counter() - begun)
                errors.append(float(log_evidence) - exact)
                steps.append(int(tempered))
                calls.append(CALLS * count * int(tempered))
            emit(
                peer="blackjax",
                variant="double precision" if arguments.double else "standard",
                problem=problem,
                particles=count,
                errors=errors[1:],
                calls=calls[1:],
                seconds=seconds[1:],
                steps=steps[1:],
                compilation=compilation,
            )


if __name__ == "__main__":
    main()
