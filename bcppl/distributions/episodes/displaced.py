"""Gaps of a peg that is not where it was measured: by a late clock, and by what all touches share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.compiled import compiled
from bcppl.devices import numbers, on_device_of, to_device
from bcppl.distributions.episodes.linear_errors import Effect, LinearErrors
from bcppl.distributions.episodes.rows import COLUMNS, WRENCH
from bcppl.distributions.manifold import Gaps


class Lines(NamedTuple):
    """Gaps of N parts to pegs at R rows as linear functions of M shared errors, for each of D delays.

    With delay d and errors x the gap is `distance + slope @ (late[d] + twist[d] @ x) + offset[d] @ x`: what
    differs from part to part has six columns, not M for each delay.

    Attributes:
        distance: (N, R) without errors, m.
        slope: (N, R, 6) by a twist of the peg in its frame.
        gradient: (N, R, 6) by the part's pose.
        late: (D, R, 6) twists of the peg by each delay.
        twist, offset: (D, R, 6, M) and (D, R, M), as of `Effect`.
        residual: (N, R, K) m; sums of their products are covariances of what the lines leave over.
    """

    distance: Tensor
    slope: Tensor
    gradient: Tensor
    late: Tensor
    twist: Tensor
    offset: Tensor
    residual: Tensor

    @property
    def moved(self) -> Tensor:
        """The gaps' changes (N, D, R) by each delay, m."""
        return torch.einsum("nra,dra->ndr", self.slope, self.late)

    @property
    def columns(self) -> Tensor:
        """The gaps' changes (N, D, R, M) by the shared errors, m."""
        return torch.einsum("nra,dram->ndrm", self.slope, self.twist) + self.offset


def lines_at(gaps: Gaps, pose: Tensor, rows: Tensor, bench: LinearErrors) -> Lines:
    """About no error, by the gap's derivative.

    Args:
        gaps: (N, R), at the pegs as measured.
        pose: (N, 7) world_from_part.
        rows: (R, COLUMNS).
        bench: the errors that all touches share.
    """
    late, effect = bench.late_effects(rows)
    late, effect = to_device((late, effect), gaps.distance.device)
    gradient = gaps.gradient(pose)
    # Without errors nothing reads the slope.
    slope = _by_twist_of_peg(gradient, pose, rows[:, :7]) if bench.errors else torch.zeros_like(gradient)
    none = gaps.distance.new_zeros(*gaps.distance.shape, 0)
    return Lines(gaps.distance, slope, gradient, late, *effect, none)


def by_shared_errors(gaps: Gaps, pose: Tensor, peg: Tensor, force: Tensor, bench: LinearErrors) -> Tensor:
    """The gaps' changes (N, R, M), m, by the shared errors, at pegs (N, R, 7) that are not yet measured.

    Each is pressed onto the part by a force (N, R), in N, along the contact's normal; clocks agree.
    """
    slope, effect = _pressed(gaps, pose, peg, force, bench)
    return (slope[..., None, :] @ effect.twist)[..., 0, :] + effect.offset


def mismeasured(
    gaps: Gaps, pose: Tensor, peg: Tensor, force: Tensor, bench: LinearErrors, errors: Tensor
) -> Tensor:
    """Where pegs (N, R, 7) would be measured under shared errors (N, M), as of `by_shared_errors`.

    What an error adds to the gap besides displacing the peg is a displacement along the contact's normal.
    """
    slope, effect = _pressed(gaps, pose, peg, force, bench)
    twist, offset = (
        (each @ errors[:, None, :, None])[..., 0] for each in (effect.twist, effect.offset[..., None, :])
    )
    moved = twist[..., :3] + offset * slope[..., :3]
    moved = (poses.rotation_matrix(peg) @ moved[..., None])[..., 0]
    return poses.retract(peg, -torch.cat([moved, twist[..., 3:]], dim=-1))


def _pressed(
    gaps: Gaps, pose: Tensor, peg: Tensor, force: Tensor, bench: LinearErrors
) -> tuple[Tensor, Effect]:
    """Derivatives (N, R, 6) of gaps by the peg's twist, and effects (N, R, ...) of the shared errors."""
    slope = _by_twist_of_peg(gaps.gradient(pose), pose, peg)
    rows = peg.new_full((*peg.shape[:-1], COLUMNS), torch.nan)
    rows[..., :7], rows[..., WRENCH] = peg, force[..., None] * slope
    effect = bench.effect(rows.flatten(0, 1))
    return slope, Effect(*(each.unflatten(0, peg.shape[:-1]) for each in effect))


def _by_twist_of_peg(gradient: Tensor, part: Tensor, peg: Tensor) -> Tensor:
    """Derivatives (N, R, 6) of gaps by the peg's displacement along its axes and rotation about them.

    Args:
        gradient: (N, R, 6) by those of the part, as of `Gap.gradient`.
        part: (N, 7) world_from_part.
        peg: (R, 7) world_from_peg, or (N, R, 7).
    """
    pegs = peg if peg.ndim == 3 else peg[None]
    tensors = (gradient, poses.rotation_matrix(part), part, poses.rotation_matrix(pegs), pegs)
    given, part_turn, frame, peg_turn, peg_frame = (np.ascontiguousarray(numbers(each)) for each in tensors)
    slope = np.empty(tuple(gradient.shape))
    _turned(given, part_turn, frame, peg_turn, peg_frame, slope)
    return on_device_of(slope, gradient)


@compiled
def _turned(
    gradient: Array, part_turn: Array, part: Array, peg_turn: Array, peg: Array, slope: Array
) -> None:
    moment = np.empty(3)
    for n in range(gradient.shape[0]):
        own = n if len(peg) > 1 else 0
        for r in range(gradient.shape[1]):
            for i in range(3):
                # The moment of the normal at the witness point, about the peg's origin, in the world's axes.
                j, k = (i + 1) % 3, (i + 2) % 3
                moment[i] = gradient[n, r, j] * (peg[own, r, k] - part[n, k])
                moment[i] -= gradient[n, r, k] * (peg[own, r, j] - part[n, j])
                moment[i] *= -1.0
                for a in range(3):
                    moment[i] -= part_turn[n, i, a] * gradient[n, r, 3 + a]
            for i in range(3):
                slope[n, r, i] = slope[n, r, 3 + i] = 0.0
                for a in range(3):
                    slope[n, r, i] -= peg_turn[own, r, a, i] * gradient[n, r, a]
                    slope[n, r, 3 + i] += peg_turn[own, r, a, i] * moment[a]
