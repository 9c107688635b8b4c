"""The base of the distributions over poses: a centre, and its free axes."""

from __future__ import annotations

from typing import Any, Self

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from bcppl.devices import to_device
from bcppl.poses import Freedom

# A held axis may stray by rounding over thousands of moves, never by a nanometre.
HELD = 1e-9
# How far the length of a quaternion may lie from 1.
UNIT = 1e-6


class PoseDistribution(TorchDistribution):
    """A distribution over poses (..., 7), centred at one pose or at one for each particle."""

    arg_constraints: dict[str, Any] = {}
    support = constraints.real_vector

    def __init__(self, center: Tensor, freedom: Freedom) -> None:
        self.center = center
        self.freedom = freedom
        super().__init__(torch.Size(center.shape[:-1]), torch.Size([7]), validate_args=False)

    def on(self, device: torch.device) -> Self:
        """The same distribution with its numbers on a device."""
        if self.center.device == device:
            return self
        new = type(self).__new__(type(self))
        new.__dict__.update(
            {
                name: to_device(value, device) if isinstance(value, Tensor) else value
                for name, value in self.__dict__.items()
            }
        )
        return new

    def expand(self, batch_shape: Any, _instance: Any = None) -> PoseDistribution:
        """The same distribution for a batch of draws, one for each particle of a plate."""
        if torch.Size(batch_shape) == self.batch_shape:
            return self
        new = type(self).__new__(type(self))
        new.__dict__.update(self.__dict__)
        new.center = self.center.expand(*batch_shape, 7)
        TorchDistribution.__init__(new, torch.Size(batch_shape), self.event_shape, validate_args=False)
        return new


def is_unit(pose: Tensor) -> Tensor:
    """Whether poses (..., 7) have unit quaternions: other seven numbers are no pose."""
    return (pose[..., 3:].square().sum(dim=-1) - 1.0).abs() <= 2.0 * UNIT
