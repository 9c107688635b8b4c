"""The columns of a probe's rows."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

# Of a row: the peg's pose, then these; WRENCH is that on the peg, in its frame. EARLIER are the twists in it
# that lead to where the peg was so many SECONDS before, m and rad: the wrench may be late by as much. WITHIN
# is the twist by which that differs within an interval of the delay (`late`), 0 for none. TURN is the
# rotation vector (rad, in its frame) that a torque which no single contact exerts stands against, 0 for none.
# CONTINUES is 1 for rows of an episode whose contact is that of the episode before.
FELT, NOISE, FORCE, TIME, EPISODE, GIVEN = range(7, 13)
WRENCH, WITHIN, TURN = slice(13, 19), slice(19, 25), slice(25, 28)
CONTINUES = 28
SECONDS = (0.006, 0.024, 0.048, 0.096)  # clocks that agree are common
EARLIER = slice(29, 29 + 6 * len(SECONDS))
COLUMNS = EARLIER.stop
_TOGETHER = 4  # rows of which the gaps are linear over the same


def padded(rows: Tensor, stamps: int) -> Tensor:
    """Rows (..., S, C) as (..., T, COLUMNS); those that are added repeat the first pose and are not used."""
    full = torch.full((*rows.shape[:-2], stamps, COLUMNS), torch.nan, dtype=torch.float64)
    if rows.shape[-2]:
        full[..., :7] = rows[..., :1, :7]
    full[..., : rows.shape[-2], : rows.shape[-1]] = rows
    return full


def is_predicted(value: Tensor) -> bool:
    """Whether a value holds rows that a `motion` predicts, which have no times."""
    rows = value.numpy()
    return rows.shape[-1] <= TIME or bool((np.isnan(rows[..., TIME]) & ~np.isnan(rows[..., FELT])).any())


def late(rows: Tensor, interval: int) -> tuple[Tensor, Tensor]:
    """Rows (R, COLUMNS) as they are if the wrench is late by no time (0), or by one in the k-th interval.

    It ends at `SECONDS[k - 1]`, and begins where the one before ends, the first at 0.

    Returns:
        The rows, with `WITHIN` from the middle of the interval to its end, and the twists (R, 6) from where
        the peg was measured to where it was in the middle.
    """
    if interval == 0:
        return rows, rows.new_zeros(len(rows), 6)
    twists = torch.nan_to_num(rows[:, EARLIER]).unflatten(1, (len(SECONDS), 6))
    end = twists[:, interval - 1]
    begin = twists[:, interval - 2] if interval > 1 else torch.zeros_like(end)
    rows = rows.clone()
    rows[:, WITHIN] = 0.5 * (end - begin)
    return rows, 0.5 * (begin + end)


def new_rows(value: Tensor) -> Tensor:
    """The rows (R, COLUMNS) of a value that no earlier window has used."""
    rows = value.numpy()
    return torch.from_numpy(rows[~np.isnan(rows[:, FELT]) & (rows[:, GIVEN] != 1.0)])


def given_and_all(value: Tensor) -> tuple[Tensor, Tensor]:
    """The rows that are given, and these and the new ones; both are marked as new."""
    rows = value.numpy()
    rows = rows[~np.isnan(rows[:, FELT])]
    count = int((rows[:, GIVEN] == 1.0).sum())
    rows[:, GIVEN] = 0.0
    rows[:1, CONTINUES] = 0.0  # what was before the first of all is not known
    return torch.from_numpy(rows[:count]), torch.from_numpy(rows)


def is_cut(rows: Tensor, place: int) -> bool:
    """Whether rows before and from a place on are of one episode."""
    both = rows[place - 1 : place + 1]
    return (
        len(both) == 2 and bool((both[:, FELT] == 1.0).all()) and bool(both[0, EPISODE] == both[1, EPISODE])
    )


def last_end(rows: Tensor) -> int:
    """The last place before the end of rows until where gaps are linear over what was known earlier.

    Such are where no episode goes on, so many rows (`_TOGETHER`) from one another; 0 for none.
    """
    felt, episode = rows[:, FELT].numpy(), rows[:, EPISODE].numpy()
    cut = (felt[1:] == 1.0) & (felt[:-1] == 1.0) & (episode[1:] == episode[:-1])
    end = 0
    for place in (np.flatnonzero(~cut) + 1).tolist():
        if place - end >= _TOGETHER:
            end = place
    return end
