"""Values as the verbs take them: tensors, numpy arrays or numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl.errors import InputError

Value = Tensor | npt.NDArray[Any] | float
Values = Mapping[str, Tensor]  # by address


def tensors(given: Mapping[str, Value]) -> dict[str, Tensor]:
    """Values by address as tensors.

    A float becomes float64, as do True and False, 1 and 0; a whole number int64; an array keeps its type.

    Raises:
        InputError: they are no mapping, or a value is none of these or an array of no numbers; names its
            address.
    """
    if not isinstance(given, Mapping):
        raise InputError(
            f"values by address are given as a {type(given).__name__}; give a mapping, such as {{'y': 1.2}}."
        )
    return {address: _tensor(address, value) for address, value in given.items()}


def held(value: Any) -> Any:
    """Arguments as a trace keeps them: lists and dictionaries are copied, for they may grow later."""
    if type(value) is dict:
        return {key: held(each) for key, each in value.items()}
    if type(value) not in (list, tuple):
        return value
    parts = [held(each) for each in value]
    if type(value) is list:
        return parts
    return value if all(a is b for a, b in zip(value, parts, strict=True)) else tuple(parts)


def _tensor(address: str, value: Any) -> Tensor:
    if isinstance(value, Tensor):
        return value
    if isinstance(value, float | bool):
        return torch.tensor(value, dtype=torch.float64)
    if isinstance(value, int) or (isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf"):
        return torch.as_tensor(np.asarray(value).copy())
    kind = f"{value.dtype} array" if isinstance(value, np.ndarray) else type(value).__name__
    raise InputError(
        f"the value given for address {address!r} is a {kind}; give a tensor, a numpy array or a number."
    )


def shapes(values: Mapping[str, Tensor]) -> str:
    """Addresses and the shapes of their values, `x (3,), y (3, 7)`, or `none`."""
    return ", ".join(f"{address} {tuple(value.shape)}" for address, value in values.items()) or "none"
