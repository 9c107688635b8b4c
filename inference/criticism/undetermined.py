"""The direction in which measurements leave a part's position as open as the prior did.

    where = undetermined(population, "part")
    if where is not None:
        print(where.direction, where.deviation)

Touches of one face leave a part free to slide along it, and the mean of a belief in two places, far apart, is
in neither. The belief states that by its spread; whoever reads its mean alone has to be warned.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl.distributions.poses import SwingTwistPose, UniformPose
from bcppl.inference.population import Population
from bcppl.traces.series import SeriesTrace

LEARNT = 1.0  # nats of entropy that a direction has to lose to count as measured


class Undetermined(NamedTuple):
    """A direction, and how far off a part may be along it.

    Attributes:
        direction: (3,) unit vector in the world.
        deviation: standard deviation of the part's position along it, metres.
        before: the largest standard deviation of the prior's position, metres.
    """

    direction: Tensor
    deviation: float
    before: float


def undetermined(population: Population, address: str) -> Undetermined | None:
    """The direction of the largest standard deviation, where that is hardly less than the prior's largest.

    They are compared as entropies of Gaussians. None where measurements determine the position better,
    without measurements, and for a prior that is not uniform.
    """
    trace = population.trace
    prior = None if isinstance(trace, SeriesTrace) else trace.distributions.get(address)
    if not isinstance(prior, UniformPose | SwingTwistPose) or not trace.observations:
        return None
    before = float(prior.widths.max()) / math.sqrt(3.0)
    variances, directions = torch.linalg.eigh(population.belief(address).covariance[:3, :3])
    deviation = math.sqrt(max(0.0, float(variances[-1])))
    if deviation <= math.exp(-LEARNT) * before:
        return None
    along = directions[:, -1]
    return Undetermined(along * torch.sign(along[along.abs().argmax()]), deviation, before)
