"""BlackJAX: Bayesian logistic regression by NUTS, or by HMC with a fixed number of steps, window-adapted.

Every chain has a warm-up of its own (step size and diagonal or dense mass, as in Stan); all run side by side.
Single precision, JAX's default. The draws (chains, draws, features) go to a file.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from problems import FEATURES, emit, logistic_regression

STEPS = 8  # leapfrog steps of a trajectory of HMC


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("algorithm", choices=("nuts", "hmc"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--warm-up", type=int, default=1000)
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--dense", action="store_true", help="a dense mass matrix")
    arguments = parser.parse_args()
    features, labels = (jnp.asarray(each) for each in logistic_regression())

    def log_density(b: Any) -> Any:
        logits = features @ b
        return jnp.sum(labels * logits - jnp.logaddexp(0.0, logits)) - 0.5 * jnp.sum(b**2)

    algorithm = getattr(blackjax, arguments.algorithm)
    extra = {"num_integration_steps": STEPS} if arguments.algorithm == "hmc" else {}
    warm_up = blackjax.window_adaptation(
        algorithm, log_density, is_mass_matrix_diagonal=not arguments.dense, **extra
    )

    def chain(key: Any) -> Any:
        first, second, third = jax.random.split(key, 3)
        start = jax.random.normal(first, (FEATURES,))
        (state, settings), _ = warm_up.run(second, start, num_steps=arguments.warm_up)
        step = algorithm(log_density, **settings).step

        def one(state: Any, key: Any) -> Any:
            state, info = step(key, state)
            return state, (state.position, info.num_integration_steps)

        _, recorded = jax.lax.scan(one, state, jax.random.split(third, arguments.draws))
        return recorded

    keys = jax.random.split(jax.random.key(arguments.seed), arguments.chains)
    begun = time.perf_counter()
    compiled = jax.jit(jax.vmap(chain)).lower(keys).compile()
    between = time.perf_counter()
    draws, steps = jax.block_until_ready(compiled(keys))
    ended = time.perf_counter()
    np.save(arguments.file, np.asarray(draws))
    emit(
        compilation=between - begun,
        running=ended - between,
        steps=float(jnp.mean(steps)),
    )


if __name__ == "__main__":
    main()
