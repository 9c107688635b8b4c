"""Compilation with numba of loops over particles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """The function compiled on first use, without Python's lock; cached where a folder is writable."""
    return _compiled(function)


def summed(function: F) -> F:
    """The same with sums in the order that is fastest: the result is that of another order, to rounding."""
    return _compiled(function, fastmath={"reassoc", "contract"})


def _compiled(function: F, **options: Any) -> F:
    # In numpy's error model a division by zero is infinite.
    options.update(nogil=True, error_model="numpy")
    try:
        return cast(F, njit(cache=True, **options)(function))
    except RuntimeError:  # no writable folder
        return cast(F, njit(**options)(function))
