"""The backward program of an SMCP3 move, conditioned on where a prior that has limits lets values be.

The weight of a move is right on average only if all that the backward program L may choose is possible: what
it has beyond a box of the prior is lost from the evidence and, near the limits, from the density, however
many the particles. Conditioned, it is L(x | x') s(x) / Z(x'), with s the prior's density relative to its
largest (in the support at least, where that is not known) and Z(x') the integral of L(x | x') s(x). The
number of draws from L until one is accepted with probability s is 1 / Z on average, and takes its place,
which leaves the weight's expectation as it is.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.distributions import constraints

from bcppl.distributions.poses.uniform import BoxPose
from bcppl.distributions.support import Support, base, freedom_of
from bcppl.traces import Program, Trace, simulate
from bcppl.traces.values import Values

# Draws at a time, as long as none is accepted; what is accepted less often is taken for as probable.
_ROUNDS = (1, 4, 16, 64)

Share = Callable[[Tensor], Tensor]


def log_conditioned(
    backward: Program,
    old: Trace,
    new: Trace,
    latent: Values,
    read: Callable[[Trace, Values], Mapping[str, Any]],
) -> Tensor:
    """Log factors (N,) that condition a backward program which has moved `new` to `old`.

    Args:
        backward: of the new trace.
        old: the particles before, whose sites state where values may be.
        new: the particles after.
        latent: the old values by address.
        read: the old values that a trace of the backward program chose, given the new ones by address.
    """
    count = len(new)
    shares = {a: share for a in latent if (share := _share_of(old.distributions[a])) is not None}
    total = torch.zeros(count, dtype=torch.float64)
    if not shares:
        return total
    left, trials = torch.arange(count), torch.zeros(count, dtype=torch.float64)
    for draws in _ROUNDS:
        there = new if draws == 1 else new.chosen(left.repeat_interleave(draws))
        drawn = read(simulate(backward, (there,), len(there)), {a: there[a] for a in latent})
        accepted = torch.ones(len(there), dtype=torch.float64)
        for address, share in shares.items():
            if address in drawn:
                accepted = accepted * share(drawn[address])
        kept = (torch.rand(len(there), dtype=torch.float64) < accepted).reshape(len(left), draws)
        found = kept.any(dim=1)
        trials[left] += torch.where(found, kept.to(torch.float64).argmax(dim=1) + 1.0, float(draws))
        left = left[~found]
        if not len(left):
            break
    for address, share in shares.items():
        total = total + share(latent[address]).log()
    return total + trials.log()


def _share_of(distribution: Any) -> Share | None:
    """The density of values (N, ...) relative to the largest, (N,) in [0, 1]; None without limits.

    Of a distribution that differs between particles nothing is known of where other values may be.
    """
    own = base(distribution)
    if isinstance(own, BoxPose):
        if not _is_common(own):
            return None
        prior = copy.copy(own)
        prior.center = own.center.reshape(-1, 7)[0]
        highest = prior.log_prob(prior.center)
        return lambda value: (prior.log_prob(value) - highest).clamp(max=0.0).exp()
    if freedom_of(own) is not None:
        return None
    try:
        support = Support.of(distribution)
    except NotImplementedError:
        return None
    limits = support.constraint
    unlimited = limits in (constraints.real, constraints.real_vector) or constraints.is_dependent(limits)
    if unlimited or not (support.is_fixed or _is_common(own)):
        return None
    return lambda value: limits.check(value).reshape(len(value), -1).all(dim=1).to(torch.float64)


def _is_common(distribution: Any) -> bool:
    """Whether the parameters of a distribution are the same for all particles."""
    count = len(distribution.batch_shape) and distribution.batch_shape[0]
    tensors = [
        each
        for each in vars(distribution).values()
        if isinstance(each, Tensor) and each.shape[:1] == (count,)
    ]
    return all(bool((each == each[:1]).all()) for each in tensors)
