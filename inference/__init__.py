"""Inference programs and the pieces they are made of; `infer` runs the one that suits a model best.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling, rejuvenate, resample
    from bcppl.inference.kernels import metropolis_hastings
    from bcppl.inference.proposals import drift
    from bcppl.inference.summaries import mean

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    population = importance_sampling(weighed, (), {"reading": torch.tensor(2.4).double()}, 1000)
    population = rejuvenate(resample(population), metropolis_hastings(drift("mass")), sweeps=3)
    print(population.log_evidence, mean(population, "mass"))

`help(bcppl.inference.NAME)` goes on: kernels, proposals, summaries, calibration, saved and others.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
