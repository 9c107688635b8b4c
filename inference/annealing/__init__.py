"""Between the prior and the posterior: particles of all temperatures kept, and states exchanged.

    population, info = persistent_sampling(program, args, observations, 200, kernel)
    start, _ = generate(program, args, observations, 8 * 10)
    replicas = replica_exchange(kernel, start, 1000, [0.0, 0.01, 0.03, 0.1, 0.2, 0.4, 0.7, 1.0])

Tempered SMC and waste-free SMC are `bcppl.inference.tempered` and `bcppl.inference.waste_free_moves`.
Annealed importance sampling (Neal, Statistics and Computing 11, 2001) is `tempered` with fixed exponents,
that never resamples and always moves.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
