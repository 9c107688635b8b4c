"""Gaps of a peg that is not where it was measured: by a late clock, and by what all touches share."""

from __future__ import annotations

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.episodes.linear_errors import Effect, LinearErrors
from bcppl.distributions.episodes.rows import COLUMNS, WRENCH
from bcppl.distributions.manifold import Gaps, MeasuresGap


def displaced(gaps: Gaps, pose: Tensor, rows: Tensor, bench: LinearErrors) -> tuple[Tensor, Tensor]:
    """The gaps' changes (N, D, R) by each delay, m, and (N, D, R, M) by the shared errors' parameters.

    Args:
        gaps: (N, R), at the pegs as measured.
        pose: (N, 7) world_from_part.
        rows: (R, COLUMNS).
        bench: the errors that all touches share.
    """
    by_delay, effect = bench.late_effects(rows)
    if not bench.errors:
        return rows.new_zeros(len(pose), 1, len(rows)), effect.offset.expand(len(pose), *effect.offset.shape)
    slope = _by_twist_of_peg(gaps.gradient(pose), pose, rows[:, :7])
    by_errors = torch.einsum("nra,dram->ndrm", slope, effect.twist) + effect.offset
    return torch.einsum("nra,dra->ndr", slope, by_delay), by_errors


def relinearised(
    gap: MeasuresGap, pose: Tensor, rows: Tensor, bench: LinearErrors, errors: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gaps (N, D, R) without errors, as they seem from pegs displaced by some (N, M); and as of `displaced`.

    Where flat faces meet another corner of the peg may touch once it is turned: there the gap has a kink, and
    is linear about what the errors seem to be, not about none.

    Returns:
        the gaps with each delay, their changes (N, D, R, M) by the errors, and derivatives (N, R, 6) by the
        part's pose.
    """
    by_delay, effect = bench.late_effects(rows)
    twist = torch.einsum("ram,nm->nra", bench.effect(rows).twist, errors)
    turn = poses.rotation_matrix(rows[:, :7])
    moved = torch.einsum("rab,nrb->nra", turn, twist[..., :3])
    peg = rows[:, :7].expand(len(pose), len(rows), 7)
    peg = poses.retract(peg, torch.cat([moved, twist[..., 3:]], dim=-1))
    gaps = gap(pose, peg)
    gradient = gaps.gradient(pose)
    slope = _by_twist_of_peg(gradient, pose, peg)
    distance = gaps.distance[:, None] + torch.einsum("nra,ndra->ndr", slope, by_delay - twist[:, None])
    return distance, torch.einsum("nra,dram->ndrm", slope, effect.twist) + effect.offset, gradient


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
    rotation = poses.rotation_matrix(part)
    normal = -gradient[..., :3]
    # The moment of the normal at the witness point, about the peg's origin, along the world's axes.
    about_part = -(gradient[..., 3:] @ rotation.transpose(-1, -2))
    apart = part[:, None, :3] - peg[..., :3]
    moment = about_part + torch.linalg.cross(apart, normal)
    into_peg, pegs = poses.rotation_matrix(peg), "nr" if peg.ndim == 3 else "r"
    turned = [torch.einsum(f"nra,{pegs}ab->nrb", each, into_peg) for each in (normal, moment)]
    return torch.cat(turned, dim=-1)
