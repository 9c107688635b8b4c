"""Sudden changes that a likelihood integrates out, such as a slip of the peg, by their probability.

    for change in sudden_changes(population):
        print(change.name, change.time, change.probability)

The belief allows for them: it is of how peg and part are after the last one. They are named because a robot
that lets its peg slip needs another grip, and touches before a change tell less of what follows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.inference.population import Population

PROBABLE = 0.5


class SuddenChange(NamedTuple):
    """A change of what all touches share.

    Attributes:
        name: in words, as "the part slid".
        time: of the first touch after it, s of the probe.
        probability: given all measurements.
    """

    name: str
    time: float
    probability: float


@runtime_checkable
class AllowsForChanges(Protocol):
    """A distribution that integrates sudden changes out."""

    def changes(self, value: Tensor) -> Sequence[tuple[str, float, Tensor]]:
        """By name and time (s), the probabilities (N,) that each particle gives to a change."""


def sudden_changes(population: Population) -> list[SuddenChange]:
    """The changes that are more probable than not, in their order.

    The newest site that allows for them is asked, which is given what earlier ones have observed.
    """
    trace = population.trace
    sites = [a for a in trace.observations if isinstance(trace.distributions[a], AllowsForChanges)]
    if not sites:
        return []
    weights = normalised(population.log_weights)
    each = [
        SuddenChange(name, time, float(weights @ probabilities))
        for name, time, probabilities in trace.distributions[sites[-1]].changes(trace[sites[-1]])
    ]
    return [change for change in each if change.probability > PROBABLE]
