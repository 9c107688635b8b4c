"""Particles at an index, in values and in the states of programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor

from bcppl.errors import InputError

Index = Tensor | Sequence[int] | slice | int


def particles_at(key: Index, particles: int) -> Tensor:
    """The particles (K,) int64 at an index of a tensor's first axis, negative ones counted from the end."""
    return torch.arange(particles)[list(key) if isinstance(key, tuple) else key].reshape(-1)


def broadcast(mask: Tensor, values: Tensor | npt.NDArray[Any]) -> Tensor:
    """A mask (N,) with as many axes as values (N, ...)."""
    return mask.reshape(-1, *[1] * (values.ndim - 1))


def aligned(index: Tensor, particles: int) -> tuple[Tensor, Tensor]:
    """Where in `index` (K,) each particle is, 0 for those that are not, and a mask of those that are (N,)."""
    rows, mask = torch.zeros(particles, dtype=torch.int64), torch.zeros(particles, dtype=torch.bool)
    rows[index], mask[index] = torch.arange(len(index)), True
    return rows, mask


def composed(first: Tensor | None, then: Tensor | None) -> Tensor | None:
    """Choosing by `first`, then by `then`, in one; None chooses all."""
    return then if first is None else first if then is None else first.index_select(0, then)


def indexed(state: Any, index: Tensor | None, particles: int) -> Any:
    """The states of the particles at `index` (K,), all of them if it is None."""
    if isinstance(state, Tensor):
        if state.ndim == 0:
            return state
        if len(state) != particles:
            raise InputError(
                f"a series' state holds a tensor of shape {tuple(state.shape)} for {particles} particles; "
                "put the particle axis first (sample a vector with `.to_event(1)`, or return "
                "`.movedim(-1, 0)` of what lies in a plate), and what is the same for all into the arguments."
            )
        return state if index is None else state.index_select(0, index)
    if isinstance(state, Mapping):
        return {key: indexed(value, index, particles) for key, value in state.items()}
    if isinstance(state, list | tuple):
        parts = [indexed(value, index, particles) for value in state]
        return type(state)(*parts) if hasattr(state, "_fields") else type(state)(parts)
    if index is None or state is None or isinstance(state, str | int | float):
        return state
    return state[index]
