"""Compilation with numba of loops over particles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """The function compiled on first use, without Python's lock; cached where a folder is writable."""
    # In numpy's error model a division by zero is infinite.
    try:
        return cast(F, njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError:  # no writable folder
        return cast(F, njit(nogil=True, error_model="numpy")(function))
