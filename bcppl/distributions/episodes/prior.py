"""What holds before the first row of a probe: the compliance of contacts, and errors that touches share."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch

from bcppl.distributions.episodes.filter.branches import OF_CONTACT, Prior
from bcppl.distributions.episodes.filter.row_errors import Hypothesis
from bcppl.distributions.episodes.linear_errors import LinearErrors
from bcppl.distributions.manifold import FARTHEST

# Factors of the rows' own errors, after their probabilities: a peg that bounces off an edge or sinks into it
# touches less exactly than one that is pressed on a face.
NOISES = ((0.85, 1.0), (0.15, 2.5))
# Nodes of the compliance, in decades from its median: they are closer than `varying` is wide.
_DECADES = torch.linspace(-1.25, 1.25, 11, dtype=torch.float64)
# Standard deviations, m and rad, of the pose about which a likelihood is approximated: far wider than what
# any touch leaves.
WIDE = torch.tensor([0.1] * 3 + [1.0] * 3, dtype=torch.float64)


# The same for all windows and poses, which are many.
@lru_cache(maxsize=64)
def nodes_of(compliance: float, uncertain: float, every: int = 1) -> tuple[Hypothesis, ...]:
    """Each `every`-th node of a compliance with a median, m/N, and a deviation of its decimal logarithm.

    Each with each scale of `NOISES`.
    """
    weights = (-0.5 * (_DECADES / uncertain) ** 2).log_softmax(dim=0)[::every].tolist()
    nodes = (compliance * 10.0**_DECADES)[::every].tolist()
    return tuple(
        Hypothesis(weight + math.log(share), node, noise)
        for share, noise in NOISES
        for weight, node in zip(weights, nodes, strict=True)
    )


@lru_cache(maxsize=64)
def with_delays(hypotheses: tuple[Hypothesis, ...], bench: LinearErrors) -> tuple[Hypothesis, ...]:
    """Each of some hypotheses with each delay of the wrench."""
    return tuple(
        each._replace(log_weight=each.log_weight + math.log(probability), delay=interval)
        for interval, probability in bench.delays.items()
        for each in hypotheses
    )


@lru_cache(maxsize=64)
def prior_of(bench: LinearErrors, hypotheses: tuple[Hypothesis, ...], outlier: float, pose: int) -> Prior:
    """The prior of hypotheses with delays, with so many parameters of the pose before the shared errors'."""
    own, none, changes = np.zeros(pose), np.zeros(OF_CONTACT), bench.changes
    log_weight, compliance, _, scale, delay = np.array(hypotheses).T.copy()
    changed = np.array([np.concatenate([own, c.variances.numpy(), none]) for c in changes])
    return Prior(
        log_weight=log_weight,
        compliance=compliance,
        scale=scale,
        delay=np.searchsorted(list(bench.delays), delay),
        mean=np.concatenate([own, bench.means.numpy(), none]),
        variance=np.concatenate([WIDE.numpy()[:pose] ** 2, bench.variances.numpy(), none]),
        change_log_probability=np.array([math.log(c.probability) for c in changes]),
        change_variance=changed,
        outlier=outlier,
        farthest=FARTHEST,
    )
