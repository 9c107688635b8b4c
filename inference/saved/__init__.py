"""Populations and steps of a run in files: saved in one process, gone on with in another, equal to the bit.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling, saved

    def coin():
        chance = pyro.sample("chance", dist.Beta(torch.tensor(2.0).double(), 2.0))
        pyro.sample("heads", dist.Binomial(10, chance))

    population = importance_sampling(coin, (), {"heads": torch.tensor(7.0).double()}, 1000)
    saved.save(population, "coin.h5")  # with the state of torch's generator

    population = saved.load("coin.h5", coin)  # in another process, with the same program
    torch.set_rng_state(saved.random_state("coin.h5"))

A run over a recording is resumed from a step: `save_step`, `load_step`. A file holds numbers and no code.
"""

from bcppl.inference.saved.populations import load, load_several, random_state, save
from bcppl.inference.saved.steps import load_step, save_step

__all__ = ["load", "load_several", "load_step", "random_state", "save", "save_step"]
