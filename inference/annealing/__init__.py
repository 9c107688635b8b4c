"""Between the prior and the posterior: particles of all temperatures kept, and states exchanged.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference.annealing import persistent_sampling, replica_exchange
    from bcppl.inference.kernels import metropolis_hastings
    from bcppl.inference.proposals import drift
    from bcppl.traces import generate

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    seen, kernel = {"reading": torch.tensor(2.4).double()}, metropolis_hastings(drift("mass"))
    population, info = persistent_sampling(weighed, (), seen, 200, kernel)
    start, _ = generate(weighed, (), seen, 4 * 10)
    replicas = replica_exchange(kernel, start, 50, [0.0, 0.1, 0.4, 1.0])
    print(population.log_evidence, replicas.log_evidence, replicas.rejection)

Tempered SMC and waste-free SMC are `bcppl.inference.tempered` and `bcppl.inference.waste_free_moves`.
Annealed importance sampling (Neal, Statistics and Computing 11, 2001) is `tempered` with fixed exponents,
that never resamples and always moves.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
