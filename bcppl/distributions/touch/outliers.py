"""Predictive checks of touches that may be outliers: one at a time, and how many there are of a session."""

from __future__ import annotations

import math

import torch
from scipy.special import bdtrc, ndtri
from torch import Tensor

from bcppl.distributions.checks import Check

KIND = "touch"
FAR = 0.05  # a touch with a larger tail is as it should be, whatever the others are
# The tail beyond four standard deviations: farther off, one touch is as much an outlier as another.
FARTHEST = 6.3e-5


def touch_check(tail: Tensor, outlier: float, others: Tensor | None = None) -> Check:
    """The check of one touch at P particles.

    One outlier is no surprise, for the model expects a share of them; several are. So a touch of a session is
    checked by how many touches are as far off as it: of K p values, the probability that as many are as
    small (the higher criticism of Donoho and Jin, Annals of Statistics 32, 2004, with the exact binomial of
    Berk and Jones, 1979).

    Args:
        tail: (P,) the probability, given that it is no outlier, of a touch farther off.
        outlier: the probability of an outlier.
        others: (P, K - 1) the tails of the session's other touches.
    """
    own = outlier + (1.0 - outlier) * tail
    probability = own
    if others is not None:
        count = 1 + (others <= tail[:, None]).sum(dim=1)
        total = 1 + others.shape[1]
        together = torch.as_tensor(bdtrc(count.numpy() - 1, total, own.numpy()))
        probability = torch.where(tail < FAR, together, own)
    squared = torch.from_numpy(ndtri(0.5 * tail.clamp(min=FARTHEST).numpy())).square()
    return Check(float(probability.mean()), KIND, float((squared.mean() - 1.0) / math.sqrt(2.0)))
