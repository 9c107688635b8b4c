"""A mixture of normals over poses, with one density."""

from __future__ import annotations

from typing import Any

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from bcppl.distributions.poses.normal import NormalPose
from bcppl.errors import InputError
from bcppl.poses import FREE, Freedom


class MixturePose(TorchDistribution):
    """A mixture of K normals over poses (`NormalPose`), all with the same free axes.

    Args:
        log_weights: (K,) or (N, K), unnormalised; -inf for a component without weight.
        centers: (K, 7) or (N, K, 7).
        covariance: over the free coordinates, (d, d), (K, d, d) or (N, K, d, d), as `NormalPose` takes it, or
            standard deviations (d,).
        freedom: which axes are free.

    Raises:
        InputError: the shapes do not fit, no component has any weight, or a covariance is not positive
            definite.
    """

    arg_constraints: dict[str, Any] = {}
    support = constraints.real_vector

    def __init__(
        self, log_weights: Tensor, centers: Tensor, covariance: Tensor, freedom: Freedom = FREE
    ) -> None:
        components = log_weights.shape[-1]
        if centers.ndim < 2 or centers.shape[-2:] != (components, 7):
            raise InputError(
                f"MixturePose has {components} weights and centres of shape {tuple(centers.shape)}; "
                "give one pose of seven numbers for each weight."
            )
        if not bool((log_weights > -torch.inf).any(dim=-1).all()):
            raise InputError("MixturePose has no component with any weight; give one or more.")
        batch = torch.broadcast_shapes(log_weights.shape[:-1], centers.shape[:-2])
        self.log_weights = torch.log_softmax(log_weights.to(torch.float64), dim=-1)
        self.components = NormalPose(centers, covariance, freedom)
        self.freedom = freedom
        super().__init__(torch.Size(batch), torch.Size([7]), validate_args=False)

    def expand(self, batch_shape: Any, _instance: Any = None) -> MixturePose:
        """The same mixture for a batch of draws, one for each particle of a plate."""
        new = type(self).__new__(type(self))
        new.__dict__.update(self.__dict__)
        new.log_weights = self.log_weights.expand(*batch_shape, -1)
        TorchDistribution.__init__(new, torch.Size(batch_shape), self.event_shape, validate_args=False)
        return new

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (*sample_shape, *batch_shape, 7)."""
        shape = torch.Size(sample_shape) + self.batch_shape
        chances = self.log_weights.exp().expand(*shape, -1)
        drawn = torch.multinomial(chances.reshape(-1, chances.shape[-1]), 1).reshape(*shape, 1, 1)
        each = self.components.expand(torch.Size([*shape, chances.shape[-1]])).sample()
        return each.gather(-2, drawn.expand(*shape, 1, 7))[..., 0, :]

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (...,) with respect to the base measure; -inf where a held axis differs."""
        each = self.components.log_prob(value[..., None, :])
        return torch.logsumexp(self.log_weights + each, dim=-1)
