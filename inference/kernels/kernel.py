"""What a kernel is, and how moved particles are put back.

A kernel is fitted to a weighted population, `kernel(population) -> move`, and a move is
`(trace, target) -> (trace, accepted (N,))` that leaves the target invariant. What a move learns from the
population is fixed before it runs. `accepted` is 1 where a particle took its proposal, 0 where it stayed, or
a share between the two for a move that is made of several.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from bcppl.inference.population import Population
from bcppl.inference.targets import Target
from bcppl.traces import Trace

Move = Callable[[Trace, Target], tuple[Trace, Tensor]]
Kernel = Callable[[Population], Move]


def replaced(population: Population, index: Tensor, moved: Trace) -> Population:
    """The population with the particles at `index` (K,) replaced by those of a trace of K particles."""
    trace = put(population.trace, index, moved)
    return replace(population, trace=trace)


def put(trace: Trace, index: Tensor, other: Trace) -> Trace:
    """A trace with the particles at `index` (K,) replaced by those of a trace of K particles."""
    if len(index) == 0:
        return trace
    source = torch.zeros(len(trace), dtype=torch.int64)
    source[index] = torch.arange(len(index))
    mask = torch.zeros(len(trace), dtype=torch.bool)
    mask[index] = True
    return other[source].where(mask, trace)
