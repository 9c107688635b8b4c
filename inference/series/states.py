"""States of a series, nested containers of tensors with the particle axis first: merged and compared."""

from __future__ import annotations

import numbers
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.traces.carried import Entry
from bcppl.traces.indexing import broadcast

# What particles cannot differ in.
_SHARED = (bool, int, float, complex, str, bytes, type(None), np.generic)


def merged(mask: Tensor, first: Any, second: Any) -> Any:
    """The states (N, ...) of the first where `mask` (N,) is true, of the second elsewhere.

    Numbers, text, tensors without axes and None are the first's, for they are the same for all particles;
    anything else than tensors, arrays and their containers is merged by its own `where(mask, other)`.

    Raises:
        InputError: something else differs.
    """
    if isinstance(first, np.ndarray):
        return merged(mask, torch.from_numpy(first), torch.from_numpy(second)).numpy()
    if isinstance(first, Tensor):
        return first if first.ndim == 0 else torch.where(broadcast(mask, first), first, second)
    if isinstance(first, Mapping):
        return {key: merged(mask, value, second[key]) for key, value in first.items()}
    if isinstance(first, list | tuple):
        parts = [merged(mask, a, b) for a, b in zip(first, second, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else type(first)(parts)
    if first is second or first is None or isinstance(first, numbers.Number | str | np.generic):
        return first
    if not hasattr(first, "where"):
        raise InputError(
            f"a series' state holds a {type(first).__name__}, whose particles cannot be put together with "
            "those of another; give it `where(mask, other)`, or hold tensors."
        )
    return first.where(mask, second)


def merged_entries(mask: Tensor, first: Mapping[str, Entry], second: Mapping[str, Entry]) -> dict[str, Entry]:
    """The simulator states that both carry, merged likewise; one that cannot be is made again when needed."""
    both = {name: entry.where(mask, second[name]) for name, entry in first.items() if name in second}
    return {name: entry for name, entry in both.items() if entry is not None}


def same(first: Any, second: Any, particles: int) -> Tensor:
    """Where the states of two batches of particles are equal but for rounding, (N,).

    Tensors and arrays with an entry for each particle are compared, also those that objects hold as
    attributes; what all particles share counts as equal.

    Raises:
        InputError: a state holds an object whose attributes cannot be read.
    """
    if isinstance(first, np.ndarray):
        return same(torch.from_numpy(first), torch.from_numpy(second), particles)
    equal = torch.ones(particles, dtype=torch.bool)
    if isinstance(first, Tensor):
        if first.ndim == 0 or first is second or len(first) != particles:
            return equal
        if first.is_floating_point():
            # A batch of another size may round the last digits in another way. In single precision a few
            # more would be as much as noise.
            tolerance = max(16.0 * torch.finfo(first.dtype).eps, 4e-10)
            close = torch.isclose(first, second, rtol=tolerance, atol=tolerance**2, equal_nan=True)
        else:
            close = first == second
        return close.reshape(particles, -1).all(dim=1)
    if isinstance(first, Mapping):
        parts = [same(value, second[key], particles) for key, value in first.items()]
    elif isinstance(first, list | tuple):
        parts = [same(a, b, particles) for a, b in zip(first, second, strict=True)]
    elif first is second or isinstance(first, _SHARED):
        return equal
    elif hasattr(first, "__dict__"):
        parts = [same(value, vars(second)[name], particles) for name, value in vars(first).items()]
    elif not hasattr(first, "__getitem__"):
        return equal  # what cannot be indexed is of no particle
    else:
        raise InputError(
            f"a series' state holds a {type(first).__name__}, whose particles cannot be compared with those "
            "of another; let it hold tensors as attributes (no __slots__), or hold tensors."
        )
    return torch.stack([equal, *parts]).all(dim=0)
