"""How values are shown: by address and shape, never number by number."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor


def shapes(values: Mapping[str, Tensor]) -> str:
    """Addresses and the shapes of their values, `x (3,), y (3, 7)`, or `none`."""
    return ", ".join(f"{address} {tuple(value.shape)}" for address, value in values.items()) or "none"
