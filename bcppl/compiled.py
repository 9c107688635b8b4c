"""Loops over many particles, compiled with numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile on first use, to run without Python's lock; the code is kept where a folder can be written."""
    # In numpy's error model a division by zero is infinite.
    try:
        return cast(F, njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError:  # no such folder
        return cast(F, njit(nogil=True, error_model="numpy")(function))
