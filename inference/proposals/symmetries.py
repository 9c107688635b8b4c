"""Symmetry proposals: jumps between poses that are equivalent, or nearly so, under a symmetry of the part."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within, whole_number
from bcppl.distributions.poses import HELD, MixturePose
from bcppl.distributions.support import freedom_of
from bcppl.errors import InputError
from bcppl.poses import FREE
from bcppl.traces import Trace


@dataclass(frozen=True)
class Continuous:
    """A one-parameter family of motions: turns about an axis of the part, shifts along it, or screws.

    Attributes:
        axis: (3,) direction, of any length.
        point: (3,) a point on the axis, metres.
        turn: the largest angle to either side, radians, at most pi.
        slide: the largest shift to either side, metres.

    Raises:
        InputError: the axis is no direction, the turn not from 0 to pi, or the slide negative.
    """

    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: float = math.pi
    slide: float = 0.0

    def __post_init__(self) -> None:
        number_within("a continuous symmetry turns up to {} rad", self.turn, least=0.0, most=math.pi)
        number_within("a continuous symmetry slides up to {} m", self.slide, least=0.0)
        if not (math.isfinite(sum(self.axis)) and any(self.axis)):
            raise InputError(f"a continuous symmetry has the axis {self.axis}; give a direction.")

    def at(self, share: Tensor) -> Tensor:
        """The motions (..., 7) `part_from_part` by a share (...,) of the largest amount, in [-1, 1]."""
        axis = torch.tensor(self.axis, dtype=torch.float64)
        axis = axis / axis.norm()
        tangent = torch.cat([self.slide * axis, self.turn * axis])
        turned = poses.retract(poses.identity(*share.shape), share[..., None] * tangent)
        point = torch.tensor(self.point, dtype=torch.float64)
        around = point - (poses.rotation_matrix(turned) @ point[:, None])[..., 0]
        return torch.cat([turned[..., :3] + around, turned[..., 3:]], dim=-1)


def rotations(
    order: int,
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
    point: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Tensor:
    """The turns (order - 1, 7) of an `order`-fold symmetry about an axis, without the identity.

    Raises:
        InputError: the order is below 2.
    """
    order = whole_number("a rotational symmetry is of order {}", order, least=2)
    shares = 2.0 * torch.arange(1, order, dtype=torch.float64) / order
    return Continuous(axis, point).at(shares)


def symmetry(
    address: str, transforms: Any, *, spread: tuple[float, float] = (0.0005, 0.005)
) -> Callable[[Trace], None]:
    """A proposal that jumps by one of the motions that leave the part invariant, or nearly so, with noise.

    The pose `world_from_part` is composed with `part_from_part`. Every motion has the probability of its
    inverse, and the density is that of the mixture over all of them.

    Args:
        address: of the pose.
        transforms: motions (K, 7) `part_from_part`, such as `rotations(4)`; missing inverses are added. Or a
            `Continuous` family.
        spread: standard deviations of the noise, metres and radians: about those of a mode.

    Raises:
        InputError: the motions are no poses, or the spread is not positive; when it is run: the address is
            no latent pose, or a motion leaves the pose's free axes.
    """
    metres, radians = spread
    metres = number_within("symmetry is given a spread of {} m", metres, above=0.0)
    radians = number_within("symmetry is given a spread of {} rad", radians, above=0.0)
    family = transforms if isinstance(transforms, Continuous) else None
    listed = poses.identity(1) if family is not None else _with_inverses(transforms)

    def alike(trace: Trace) -> None:
        pose = trace[address]
        freedom = freedom_of(trace.distributions[address]) or FREE
        if pose.ndim != 2 or pose.shape[-1] != 7 or address not in trace.choices:
            raise InputError(f"symmetry moves {address!r}, which is no latent pose; give one that is.")
        motions = listed
        if family is not None:
            amount = pyro.sample("amount", dist.Uniform(*torch.tensor([0.0, 1.0], dtype=torch.float64)))
            motions = family.at(torch.stack([amount, -amount], dim=-1))
        ends = poses.compose(pose[:, None], motions)
        if bool((freedom.off_axis(poses.local(pose[:, None], ends)) > HELD).any()):
            raise InputError(
                f"a symmetry moves the pose at {address!r} along an axis that is held; "
                "omit that motion, or free the axis."
            )
        deviations = torch.tensor([metres] * 3 + [radians] * 3, dtype=torch.float64)
        equal = torch.zeros(ends.shape[:-1], dtype=torch.float64)
        pyro.sample(address, MixturePose(equal, ends, freedom.coordinates(deviations), freedom))

    return alike


def _with_inverses(transforms: Any) -> Tensor:
    """Motions (K, 7) and those inverses that are not among them."""
    motions = poses.as_pose(transforms, "a symmetry").reshape(-1, 7)
    if len(motions) == 0:
        raise InputError("symmetry is given no motion; give one or more, such as rotations(2).")
    back = poses.inverse(motions)
    apart = poses.local(back[:, None], motions).abs().amax(dim=-1)
    return torch.cat([motions, back[apart.amin(dim=1) > 1e-9]])
