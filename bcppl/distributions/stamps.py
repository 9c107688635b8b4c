"""Checks that the distributions over a probe's stamps share."""

from __future__ import annotations

from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError


def checked_stamps(name: str, first: int, last: int) -> tuple[int, int]:
    """The stamps `first` to `last` (exclusive) of a distribution, as ints.

    Raises:
        InputError: one is no whole number, or there are none between.
    """
    first = whole_number(f"{name} is given first stamp {{}}", first, least=0)
    last = whole_number(f"{name} is given last stamp {{}}", last, least=0)
    if not first < last:
        raise InputError(f"{name} is given stamps {first} to {last}; the first must come before the last.")
    return first, last


def checked_event(name: str, value: Tensor, stamps: int, numbers: int) -> Tensor:
    """An observation (stamps, numbers), one for each particle (N, ...), or several for all (H, 1, ...).

    Raises:
        InputError: its last two dimensions are not these.
    """
    if value.ndim not in (2, 3, 4) or tuple(value.shape[-2:]) != (stamps, numbers):
        raise InputError(
            f"{name} looks at {stamps} stamps but its observation has shape {tuple(value.shape)}; "
            f"give ({stamps}, {numbers}), a row for each stamp."
        )
    return value
