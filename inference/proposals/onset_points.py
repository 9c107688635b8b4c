"""Onset alignment: a part moved so that its surface meets the places where a finger began to touch it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.support import freedom_of
from bcppl.distributions.touch import OnsetLocation
from bcppl.inference.proposals.contact_points import robust_equations
from bcppl.inference.proposals.least_squares import Alignment, aligned
from bcppl.poses import FREE
from bcppl.traces import Trace

RIGID = 1e-6  # m and rad: two poses differ by the same motion for all particles, up to rounding


def onsets(trace: Trace, address: str) -> list[str]:
    """The addresses of the onsets (`OnsetLocation`) of the part at an address, or of one held to it."""
    sites = {a: site for a, site in trace.distributions.items() if isinstance(site, OnsetLocation)}
    part = poses.inverse(trace[address])
    # All onsets of one finger have the same pose tensor.
    each = {id(site.pose): site.pose for site in sites.values()}
    between = {key: poses.compose(part, pose) for key, pose in each.items()}
    held = {k for k, p in between.items() if bool((poses.local(p[:1], p).abs() <= RIGID).all())}
    return [a for a, site in sites.items() if id(site.pose) in held]


def onsets_aligned(trace: Trace, address: str, damping: Tensor, steps: int = 1) -> Alignment:
    """The pose of each particle after Gauss-Newton steps on the signed distances at all onsets.

    Every onset is moved to the surface's nearest point: the iterated closest points of Besl and McKay (IEEE
    PAMI 14, 1992) with the planes of Chen and Medioni, large residuals downweighted, their scale the
    particle's own. It goes to a local optimum, so there have to be many starts. No simulator is run.

    Args:
        trace: of a program with onsets.
        address: of the part's pose.
        damping: (d, d) precision over the free axes of the normal prior at the start of a step.
        steps: how many.
    """
    pose, freedom = trace[address], freedom_of(trace.distributions[address]) or FREE
    addresses = onsets(trace, address)
    sites: list[Any] = [trace.distributions[a] for a in addresses]
    places = torch.stack([trace[a].to(torch.float64).expand(len(pose), 3) for a in addresses], 1)
    known = torch.isfinite(places).all(dim=-1)
    places = torch.nan_to_num(places)
    first = sites[0]
    # The part may stand at another pose than the one that is moved, such as a registration farther.
    site_from_part = poses.compose(poses.inverse(first.pose), pose)
    offset = torch.stack([torch.as_tensor(site.offset).double().expand(len(pose)) for site in sites], 1)
    spread = torch.stack([torch.as_tensor(site.spread).double().expand(len(pose)) for site in sites], 1)
    precision = torch.where(known, spread**-2, 0.0)
    distance: Any = getattr(first.distance, "distance", first.distance)  # of a part that is `Placed`
    part_from_site = poses.inverse(site_from_part)
    turn = poses.rotation_matrix(part_from_site)
    for _ in range(steps):
        near = distance(poses.transform(poses.inverse(poses.compose(pose, part_from_site)), places))
        point, normal = poses.transform(part_from_site, near.closest), near.normal @ turn.mT
        equations, information = robust_equations(pose, point, normal, near.distance + offset, precision)
        alignment = aligned(pose, equations, damping, freedom, information)
        pose = alignment.pose
    return alignment
