"""Amortised proposals: programs that propose latent values given whatever was observed.

    import pyro
    import pyro.distributions as dist
    import torch

    from bcppl.inference import importance_sampling
    from bcppl.inference.learning import Amortised, forward_kl, train

    def program():
        x = pyro.sample("x", dist.Normal(0.0, 2.0))
        pyro.sample("y", dist.Normal(x, 1.0))

    gain = torch.nn.Parameter(torch.zeros(()))

    def guess(observed):
        pyro.sample("x", dist.Normal(gain * observed["y"], 1.0))

    proposal = Amortised(guess)
    train([gain], forward_kl(proposal, program, (), ["y"]), steps=300)
    seen = {"y": torch.tensor(1.5)}
    print(importance_sampling(program, (), seen, 100, proposal.given(seen)))

The same guess serves every observation that the program may give.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from bcppl.traces import Trace
from bcppl.traces.values import tensors

# Samples latent values given observations (K, *event) by address, K being 1 or the number of particles, and
# the arguments of the model's program.
Guide = Callable[..., Any]


@dataclass(frozen=True)
class Amortised:
    """A proposal that is made for all observations that a program may give, not for one set of them.

    It is an independence proposal: the program reads no latent value. As it is, `proposal(trace)`, it is for
    `metropolis_hastings` and for pairs of `smcp3`, and reads what the trace has observed; for
    `importance_sampling` the observations are given, `proposal.given(observations)`.

    Attributes:
        guide: `guide(observed, *args)` samples some or all of the latent addresses. `observed` holds values
            by address with one more axis at their left, which is that of the particles in training, where
            each has observations of its own, and has one entry otherwise: so a network reads them once.
    """

    guide: Guide

    def given(self, observations: Mapping[str, Tensor]) -> Callable[..., Any]:
        """The proposal program `program(*args)` for these observations, of the sites' event shape."""
        observed = {address: value[None] for address, value in tensors(observations).items()}
        return lambda *args: self.guide(observed, *args)

    def __call__(self, trace: Trace) -> None:
        """Sample latent addresses given what a trace has observed."""
        self.given(trace.observations)(*trace.args)
