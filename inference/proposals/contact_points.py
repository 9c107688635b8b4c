"""Contact alignment: a part moved so that simulated contacts meet the measured ones."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import add
from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.distributions.contact import ChamferContacts, ContactsInTime, PegPose
from bcppl.distributions.touch import OnsetLocation
from bcppl.errors import InputError
from bcppl.inference.proposals.least_squares import (
    Alignment,
    Equations,
    aligned,
    alignment_proposal,
    check_pose,
    matching,
)
from bcppl.inference.proposals.proposal import Fittable
from bcppl.poses import Freedom
from bcppl.traces import Trace

SITES = ("contacts_*", "peg_*", "onset_*")


def contact_alignment(address: str, sites: Sequence[str] = SITES, *, reach: float = 1.0) -> Fittable:
    """A proposal about the pose at which simulated contacts meet the measured ones.

    The part is moved along its contact normals: by the distance of a measured contact from the simulated one
    at the same stamp, by that of the peg's measured pose from the simulated one, and by that of a finger's
    onset from the surface. Large residuals are downweighted (Geman and McClure's weights). After one
    Gauss-Newton step, the proposal is a mixture of normals about it, of the fit's covariance and multiples.

    The backward density uses the contacts at the new pose, so physics is run for every proposal:
    `delayed_acceptance` refuses it.

    Args:
        address: of the pose.
        sites: patterns of the addresses of contact likelihoods: `ChamferContacts`, `ContactsInTime`,
            `PegPose`, `OnsetLocation`.
        reach: the step is damped by a normal prior at the old pose, with the particles' covariance times this
            squared.

    Raises:
        InputError: the reach is not positive; when it is run: no site matches, or one is of another kind or
            of another pose than that at `address`.
    """
    reach = number_within("contact_alignment is given reach {}", reach, above=0.0)

    def align(trace: Trace, damping: Tensor, freedom: Freedom) -> Alignment:
        matched = matching(trace, "contact_alignment", sites)
        each, information = zip(*(_equations(trace, address, site) for site in matched), strict=True)
        return aligned(trace[address], reduce(add, each), damping, freedom, reduce(add, information))

    return alignment_proposal(address, reach, align)


def _equations(trace: Trace, address: str, measured: str) -> tuple[Equations, Tensor]:
    """The equations of one site for the poses (N, 7), and its information (N, 6, 6) about their solution."""
    site: Any = trace.distributions[measured]
    pose, value = trace[address], trace[measured].to(torch.float64)
    if isinstance(site, OnsetLocation):
        check_pose("contact_alignment", address, measured, torch.equal(site.pose, pose))
        place = value.expand(len(pose), 3)[:, None]
        known = torch.isfinite(place).all(dim=-1)
        inside = poses.transform(poses.inverse(pose), torch.nan_to_num(place))
        distance: Any = getattr(site.distance, "distance", site.distance)  # of a part that is `Placed`
        near = distance(inside)
        gap = near.distance + torch.as_tensor(site.offset, dtype=torch.float64).reshape(-1, 1)
        spread = torch.as_tensor(site.spread, dtype=torch.float64).reshape(-1, 1)
        precision = torch.where(known, 1.0 / spread**2, 0.0)
        return robust_equations(pose, near.closest, near.normal, gap, precision)
    if not isinstance(site, ChamferContacts | ContactsInTime | PegPose):
        raise InputError(
            f"contact_alignment is given the site {measured!r}, which is a {type(site).__name__}; "
            "give contacts, peg poses or onsets as `sites`."
        )
    track: Any = site.track
    check_pose("contact_alignment", address, measured, torch.equal(track.inputs[0], pose))
    contacts, world_from_peg = track.window(site.first, site.last)
    contacts, world_from_peg = contacts[:, site.thinned], world_from_peg[:, site.thinned]
    push = track.contact_normals(site.first, site.last)[:, site.thinned]
    value = value[..., site.thinned, :]
    known = torch.isfinite(torch.cat([contacts, push, value.expand(len(pose), -1, -1)], dim=-1)).all(dim=-1)
    contacts, push, value = (torch.nan_to_num(x) for x in (contacts, push, value))
    world_from_peg = torch.where(known[..., None], world_from_peg, poses.identity())
    here = _moved(world_from_peg, contacts)
    if isinstance(site, PegPose):
        there = _moved(value, contacts)
        precision = torch.full_like(known, 1.0 / site.translation_scale**2, dtype=torch.float64)
    else:
        there = _moved(world_from_peg, value)
        # The Chamfer distance takes means over both sets, so that a window counts as two contacts.
        share = (
            2.0 / known.sum(dim=1, keepdim=True).clamp(min=1) if isinstance(site, ChamferContacts) else 1.0
        )
        precision = (share / site.scale**2) * torch.ones_like(known, dtype=torch.float64)
    part_from_world = poses.inverse(pose)
    point = poses.transform(part_from_world, here)
    normal = push @ poses.rotation_matrix(part_from_world).mT
    return robust_equations(
        pose, point, normal, ((there - here) * push).sum(dim=-1), torch.where(known, precision, 0.0)
    )


def _moved(world_from_peg: Tensor, points: Tensor) -> Tensor:
    """One point for each pose: (..., 7) and (..., 3)."""
    return poses.transform(world_from_peg, points[..., None, :])[..., 0, :]


def robust_equations(
    pose: Tensor, point: Tensor, normal: Tensor, gap: Tensor, precision: Tensor
) -> tuple[Equations, Tensor]:
    """The equations of T points (N, T, 3) of each particle, large residuals downweighted.

    The step uses the noise of the measurement; the information (N, 6, 6) the scale of the residuals.
    """
    counted = precision > 0.0
    middle = torch.where(counted, gap.abs(), torch.nan).nanmedian(dim=1, keepdim=True).values
    scale = torch.maximum(precision.rsqrt(), 1.483 * torch.nan_to_num(middle))
    weight = torch.where(counted, (1.0 + (0.5 * gap / scale) ** 2) ** -2, 0.0)
    particle, stamp = counted.nonzero().unbind(dim=1)

    def of(precision: Tensor) -> Equations:
        rows = (x[particle, stamp] for x in (point, normal, gap, weight * precision))
        return Equations.of_planes(pose, particle, *rows)

    return of(precision), of(scale**-2).precision
