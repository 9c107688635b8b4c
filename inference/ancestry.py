"""Families and sides of particles: which descend from one ancestor, and in which half of the population.

Families are (N, G): the number of each particle's ancestor G resamplings ago, then of later ones. Sides are
(N,): whether a particle is on the first. Proposals that move one half are fitted to the other
(`bcppl.inference.kernels.halving`).
"""

from __future__ import annotations

import torch
from torch import Tensor

LEAST = 0.25  # of the particles, on either side
# Effective number of families on either side, or an eighth of N. A proposal that is fitted to fewer is narrow
# and off: with one to four on a side, 75 particles took two to four times as many moves to be displaced.
FEWEST = 8.0
MEMORY = 30  # resamplings


def inherited(ancestors: Tensor, families: Tensor, sides: Tensor) -> dict[str, Tensor]:
    """Families (M, G) and sides (M,) of the descendants of `ancestors` (M,), by name.

    The sides are those of the ancestors as long as either has enough particles of enough families. Else they
    are shared out again, by the ancestors of as many resamplings ago as gives enough on either side:
    relatives that may be on both sides have been moved since then, and copies of this resampling never are.
    Shared out by this resampling's ancestors alone, particles that move slowly shape their own proposals: log
    Z of a Gaussian of D = 100 by 1000 particles and `drift` was off by +3.1 +- .3 nats, and is by 1.7 +- .3.
    With all equal particles in one family, a population that its proposals hardly move would die out: log Z
    of D = 20 by 75 particles and `independent` was off by -346 +- 31 nats so.
    """
    families = torch.cat([families[ancestors, -MEMORY:], ancestors[:, None]], dim=1)
    sides = sides[ancestors]
    if _enough(families[:, 0], sides):
        return {"families": families, "sides": sides}
    for generation in range(families.shape[1]):
        sides = split(families[:, generation])
        if _enough(families[:, generation], sides):
            break
    return {"families": families[:, generation:], "sides": sides}


def split(families: Tensor) -> Tensor:
    """Sides (N,) of families (N,) in random order, the first of them, up to half of the particles, on one."""
    _, family, sizes = torch.unique(families, return_inverse=True, return_counts=True)
    order = torch.randperm(len(sizes))
    middle = sizes[order].cumsum(0) - 0.5 * sizes[order]
    first = torch.empty(len(sizes), dtype=torch.bool)
    first[order] = middle <= 0.5 * len(families)
    return first[family]


def _enough(families: Tensor, sides: Tensor) -> bool:
    particles = len(families)
    for side in (sides, ~sides):
        sizes = torch.unique(families[side], return_counts=True)[1].double()
        count = float(sizes.sum())
        if count < LEAST * particles or count**2 / float(sizes.square().sum()) < min(FEWEST, particles / 8.0):
            return False
    return True
