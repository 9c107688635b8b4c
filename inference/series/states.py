"""States of a series, nested containers of tensors with the particle axis first: merged and compared."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from bcppl.traces.carried import Entry
from bcppl.traces.indexing import broadcast


def merged(mask: Tensor, first: Any, second: Any) -> Any:
    """The states (N, ...) of the first where `mask` (N,) is true, of the second elsewhere.

    Numbers, tensors without axes and None are the first's, for they are the same for all particles; anything
    else than tensors and their containers is merged by its own `where(mask, other)`.
    """
    if isinstance(first, Tensor):
        return first if first.ndim == 0 else torch.where(broadcast(mask, first), first, second)
    if isinstance(first, Mapping):
        return {key: merged(mask, value, second[key]) for key, value in first.items()}
    if isinstance(first, list | tuple):
        parts = [merged(mask, a, b) for a, b in zip(first, second, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else type(first)(parts)
    return first.where(mask, second) if hasattr(first, "where") else first


def merged_entries(mask: Tensor, first: Mapping[str, Entry], second: Mapping[str, Entry]) -> dict[str, Entry]:
    """The simulator states that both carry, merged likewise; one that cannot be is made again when needed."""
    both = {name: entry.where(mask, second[name]) for name, entry in first.items() if name in second}
    return {name: entry for name, entry in both.items() if entry is not None}


def same(first: Any, second: Any, particles: int) -> Tensor:
    """Where the states of two batches of particles are equal but for rounding, (N,).

    Only tensors are compared: a state that holds anything else counts as equal in that part.
    """
    equal = torch.ones(particles, dtype=torch.bool)
    if isinstance(first, Tensor):
        if first.ndim == 0 or first is second:
            return equal
        if first.is_floating_point():
            # A batch of another size may round the last digits in another way.
            tolerance = torch.finfo(first.dtype).eps ** 0.6
            close = torch.isclose(first, second, rtol=tolerance, atol=tolerance**2, equal_nan=True)
        else:
            close = first == second
        return close.reshape(particles, -1).all(dim=1)
    if isinstance(first, Mapping):
        parts = [same(value, second[key], particles) for key, value in first.items()]
    elif isinstance(first, list | tuple):
        parts = [same(a, b, particles) for a, b in zip(first, second, strict=True)]
    else:
        return equal
    return torch.stack([equal, *parts]).all(dim=0)
