"""Posterior predictive checks: the result of one, and the capability of sites that have their own."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from scipy.special import chdtrc
from torch import Tensor

from bcppl.devices import numbers

# p values below it are worth a warning. On the accuracy bench none of 318 measurements of 23 scenes that are
# as stated came below it, and one of 60 images before any touch; all of 8 occluders came below 1e-38.
THRESHOLD = 1e-3


class Check(NamedTuple):
    """A posterior predictive check of one address.

    Attributes:
        probability: the p value, from 0 to 1, averaged over particles.
        kind: "image", "contacts", ... or "normal" for a value with a normal distribution.
        excess: of the discrepancy over its mean under the model, in standard deviations.
    """

    probability: float
    kind: str
    excess: float

    @property
    def surprising(self) -> bool:
        """Whether it is worth a warning: below `THRESHOLD`."""
        return self.probability < THRESHOLD


@runtime_checkable
class Checked(Protocol):
    """A site that can be checked against its predictive distribution."""

    def predictive_check(self, value: Tensor, replicas: Callable[[], Any]) -> Check | None:
        """The check of an observed value at P particles; None where the value cannot be checked.

        Args:
            value: what was observed.
            replicas: the same site at R copies of each particle, (P * R,), for replicated data.
        """


def chi_square(squared: Tensor, degrees: int, kind: str = "normal") -> Check:
    """The check of sums (P,) of squares of as many standard normal numbers."""
    probability = float(chdtrc(degrees, numbers(squared)).mean())
    return Check(probability, kind, float((squared.double().mean() - degrees) / math.sqrt(2.0 * degrees)))
