"""The particles at an index, and masks of particles beside their values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl.errors import InputError

Index = Tensor | Sequence[int] | slice | int


def particles_at(key: Index, particles: int) -> Tensor:
    """The particles (K,) int64 at an index.

    Args:
        key: whole numbers, one or several, from -N to N - 1; one truth value for each particle; or a slice.
            An empty tensor of whole numbers means none.
        particles: N.

    Raises:
        InputError: it is none of these, out of range, or means no particle at all.
    """
    if isinstance(key, slice):
        index = torch.arange(particles)[key]
        return _refuse_none(index, key, particles)
    if not isinstance(key, Tensor):
        try:
            key = torch.as_tensor(np.asarray(key))
        except (TypeError, ValueError):
            raise InputError(
                f"particles are asked for by a {type(key).__name__}; give whole numbers, one truth value "
                "for each particle, a slice, or an address."
            ) from None
        if key.numel() == 0:
            return _refuse_none(key, [], particles)
    index = key.reshape(-1)
    if index.dtype == torch.bool:
        if len(index) != particles:
            raise InputError(
                f"particles are asked for by {len(index)} truth values, but there are {particles}; "
                "give one for each."
            )
        return _refuse_none(index.nonzero().flatten(), "a mask that is true nowhere", particles)
    if index.is_floating_point() or index.is_complex():
        raise InputError(f"particles are asked for by numbers of {index.dtype}; give whole numbers.")
    if len(index) == 0:
        return index.to(torch.int64)
    least, most = (int(bound) for bound in torch.aminmax(index))
    if least < -particles or most >= particles:
        raise InputError(
            f"particle {most if most >= particles else least} was asked for, but there are {particles}; "
            f"give indices from 0 to {particles - 1}."
        )
    index = index.to(torch.int64)
    return torch.where(index < 0, index + particles, index) if least < 0 else index


def beside(mask: Tensor, values: Tensor | npt.NDArray[Any]) -> Tensor:
    """A mask (N,) with as many axes as values (N, ...)."""
    return mask.reshape(-1, *[1] * (values.ndim - 1))


def _refuse_none(index: Tensor, key: object, particles: int) -> Tensor:
    if len(index) == 0:
        raise InputError(f"no particle of {particles} is meant by {key}; give an index that means some.")
    return index
