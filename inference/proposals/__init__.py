"""Proposals: programs that sample new values at latent addresses.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling, rejuvenate
    from bcppl.inference.kernels import metropolis_hastings

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    population = importance_sampling(weighed, (), {"reading": torch.tensor(2.4).double()}, 1000)
    def nudge(trace):  # a proposal is a program that is given the trace
        pyro.sample("mass", dist.Normal(trace["mass"], 0.1))

    population = rejuvenate(population, metropolis_hastings(nudge))

Those here are fitted to the particles that they do not move: `drift`, `independent`, and others.
"""

from bcppl.inference.proposals.ancestral import prior as prior
from bcppl.inference.proposals.contact_points import contact_alignment as contact_alignment
from bcppl.inference.proposals.density import independent as independent
from bcppl.inference.proposals.depth_points import depth_alignment as depth_alignment
from bcppl.inference.proposals.differences import differential_evolution as differential_evolution
from bcppl.inference.proposals.proposal import (
    Fittable as Fittable,
    Proposal as Proposal,
    program_of as program_of,
)
from bcppl.inference.proposals.spread import spread_of as spread_of
from bcppl.inference.proposals.symmetries import (
    Continuous as Continuous,
    rotations as rotations,
    symmetry as symmetry,
)
from bcppl.inference.proposals.walk import drift as drift, joint_drift as joint_drift
