"""Learning for inference: trained proposals, networks that read measurements, adapted kernels.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling
    from bcppl.inference.learning import Amortised, forward_kl, train

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    network = torch.nn.Linear(1, 1)

    def guess(observed):  # of any reading
        pyro.sample("mass", dist.Normal(network(observed["reading"][..., None])[..., 0], 0.3))

    proposal = Amortised(guess)
    print(train(network, forward_kl(proposal, weighed, (), ["reading"]), steps=300))
    seen = {"reading": torch.tensor(2.4)}
    print(importance_sampling(weighed, (), seen, 100, proposal.given(seen)))

`evidence_bound` trains for one set of observations; `networks` reads depth images and sets of touches;
`bridged` is SMC from a proposal to the posterior; `adaptive_hmc` tunes its own step size, mass and length.
"""

from bcppl.inference.learning.amortised import Amortised
from bcppl.inference.learning.bridging import bridged
from bcppl.inference.learning.hmc_adaptation import adaptive_hmc
from bcppl.inference.learning.networks import DepthEncoder, PoseHead, SetEncoder
from bcppl.inference.learning.objectives import evidence_bound, forward_kl
from bcppl.inference.learning.training import Checks, Trained, train

__all__ = [
    "Amortised",
    "Checks",
    "DepthEncoder",
    "PoseHead",
    "SetEncoder",
    "Trained",
    "adaptive_hmc",
    "bridged",
    "evidence_bound",
    "forward_kl",
    "train",
]
