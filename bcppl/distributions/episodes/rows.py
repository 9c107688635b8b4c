"""The columns of a probe's rows."""

from __future__ import annotations

import torch
from torch import Tensor

# Of a row: the peg's pose, then these; WRENCH is that on the peg, in its frame, VELOCITY the peg's, in the
# world's.
FELT, NOISE, FORCE, TIME, EPISODE, GIVEN = range(7, 13)
WRENCH, VELOCITY = slice(13, 19), slice(19, 22)
COLUMNS = 22


def padded(rows: Tensor, stamps: int) -> Tensor:
    """Rows (..., S, C) as (..., T, 22); those that are added repeat the first pose and are not used."""
    full = torch.full((*rows.shape[:-2], stamps, COLUMNS), torch.nan, dtype=torch.float64)
    if rows.shape[-2]:
        full[..., :7] = rows[..., :1, :7]
    full[..., : rows.shape[-2], : rows.shape[-1]] = rows
    return full


def is_predicted(value: Tensor) -> bool:
    """Whether a value holds rows that a `motion` predicts, which have no times."""
    return value.ndim == 3 or bool((torch.isnan(value[:, TIME]) & ~torch.isnan(value[:, FELT])).any())


def new_rows(value: Tensor) -> Tensor:
    """The rows (R, 22) of a value that no earlier window has used."""
    return value[~torch.isnan(value[:, FELT]) & (value[:, GIVEN] != 1.0)]
