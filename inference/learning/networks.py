"""Small networks that read measurements and give a mixture of normals over poses, for amortised proposals.

    encoder = DepthEncoder(background, spread=0.02)          # or SetEncoder(3) for a set of points
    head = PoseHead(encoder.features, prior_center, deviations=[0.01] * 3 + [0.1] * 3)

    def guess(observed, *args):
        pyro.sample("part", head(encoder(observed["depth_0"])))

Networks compute in single precision; distributions are in double precision.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from bcppl import poses
from bcppl.arguments import number_within, whole_number
from bcppl.distributions.poses import MixturePose
from bcppl.errors import InputError
from bcppl.poses import FREE, Freedom

# The logarithm of the largest scale of a component, in units of the deviations that are given.
LARGEST = 1.0


class DepthEncoder(nn.Module):
    """Features (B, features) of depth images (B, H, W): four convolutions, and a layer that sees where.

    A pixel enters as its depth less the background's, in units of `spread`, clipped at 4, and as whether it
    was measured: 0 and NaN are missing.

    Args:
        background: (H, W) metres, or one number: what the camera sees without the part; 0 and NaN count as
            its mean.
        spread: metres, about the extent of the part.
        features: how many.
        width: channels of the first convolution; each further one has twice as many, the last as its
            predecessor.
    """

    background: Tensor

    def __init__(self, background: Tensor, spread: float, *, features: int = 128, width: int = 16) -> None:
        super().__init__()
        behind = torch.as_tensor(background, dtype=torch.float64)
        if behind.ndim != 2:
            raise InputError(
                f"DepthEncoder has a background of shape {tuple(behind.shape)}; give one depth for each "
                "pixel, (H, W)."
            )
        known = torch.isfinite(behind) & (behind > 0.0)
        behind = torch.where(known, behind, behind[known].mean() if bool(known.any()) else 0.0)
        self.spread = number_within("DepthEncoder has spread {} m", spread, above=0.0)
        self.features = whole_number("DepthEncoder is to give {} features", features)
        channels = [2, width, 2 * width, 4 * width, 4 * width]
        layers: list[nn.Module] = []
        for before, after in pairwise(channels):
            layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.ReLU()]
        self.register_buffer("background", behind)
        self.convolutions = nn.Sequential(*layers, nn.Flatten())
        with torch.no_grad():
            seen = self.convolutions(torch.zeros(1, 2, *behind.shape)).shape[1]
        self.whole = nn.Sequential(nn.Linear(seen, features), nn.ReLU())

    def forward(self, images: Tensor) -> Tensor:
        """Features of depth images (B, H, W) in metres."""
        measured = torch.isfinite(images) & (images > 0.0)
        away = ((images - self.background) / self.spread).clamp(-4.0, 4.0)
        pixels = torch.stack([torch.where(measured, away, 0.0), measured.to(images.dtype)], dim=1)
        return self.whole(self.convolutions(pixels.to(_type_of(self.convolutions))))


class SetEncoder(nn.Module):
    """Features (B, features) of sets of vectors (B, K, inputs), whatever their order.

    Each vector is read by the same network; the mean and the largest of what it gives are read by another
    (Zaheer, Kottur, Ravanbakhsh, Poczos, Salakhutdinov and Smola, Deep sets, NeurIPS 2017). A vector with NaN
    is missing.

    Args:
        inputs: numbers in each vector.
        center, spread: of the vectors (inputs,): they are read less the centre and in units of the spread.
        features: how many.
        width: of the hidden layers.
    """

    center: Tensor
    spread: Tensor

    def __init__(
        self,
        inputs: int,
        *,
        center: Sequence[float] | Tensor | None = None,
        spread: Sequence[float] | Tensor | None = None,
        features: int = 64,
        width: int = 64,
    ) -> None:
        super().__init__()
        self.inputs = whole_number("SetEncoder reads vectors of {} numbers", inputs)
        self.features = whole_number("SetEncoder is to give {} features", features)
        for name, given, otherwise in (("center", center, 0.0), ("spread", spread, 1.0)):
            values = torch.full((inputs,), otherwise) if given is None else torch.as_tensor(given)
            self.register_buffer(name, values.to(torch.float64).expand(inputs).clone())
        self.each = nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.whole = nn.Sequential(nn.Linear(2 * width, features), nn.ReLU())

    def forward(self, vectors: Tensor) -> Tensor:
        """Features of sets of vectors (B, K, inputs)."""
        if vectors.shape[-2] == 0:  # an empty set is one of missing vectors
            vectors = vectors.new_full((*vectors.shape[:-2], 1, self.inputs), torch.nan)
        there = ~torch.isnan(vectors).any(dim=-1, keepdim=True)
        scaled = (vectors - self.center) / self.spread
        read = self.each(torch.where(there, scaled, 0.0).to(_type_of(self.each)))
        mean = torch.where(there, read, 0.0).sum(dim=-2) / there.sum(dim=-2).clamp(min=1)
        # What is read is 0 or more.
        return self.whole(torch.cat([mean, torch.where(there, read, 0.0).amax(dim=-2)], dim=-1))


class PoseHead(nn.Module):
    """A mixture of normals over poses (`MixturePose`) from features (B, features).

    Every component has a mean in the tangent space at one pose, and a covariance of its own. One more has
    that pose as its mean and the deviations given, whatever the features: it bounds the ratio of the
    posterior to the proposal (Hesterberg, Technometrics 37, 1995).

    Args:
        features: read.
        center: pose (7,), such as that of the prior.
        deviations: (d,) about those of the prior along the free axes, metres, then radians.
        components: that depend on the features.
        wide: the weight of the one that does not.
        freedom: which axes are free.
    """

    center: Tensor
    spread: Tensor

    def __init__(
        self,
        features: int,
        center: Tensor,
        deviations: Sequence[float] | Tensor,
        *,
        components: int = 2,
        wide: float = 0.02,
        freedom: Freedom = FREE,
    ) -> None:
        super().__init__()
        self.components = whole_number("PoseHead has {} components", components)
        self.wide = number_within(
            "the wide component of PoseHead has the weight {}", wide, above=0.0, below=1.0
        )
        self.freedom, size = freedom, freedom.dimension
        spread = torch.as_tensor(deviations, dtype=torch.float64)
        if spread.shape != (size,) or not bool((spread > 0.0).all()):
            raise InputError(
                f"PoseHead has the deviations {spread.tolist()}; give one above 0 for each of {size} free "
                "axes."
            )
        self.register_buffer("center", poses.as_pose(center, "the centre of PoseHead"))
        self.register_buffer("spread", spread)
        self.below = torch.tril_indices(size, size, -1)
        self.last = nn.Linear(features, components * (1 + 2 * size + self.below.shape[1]))

    def forward(self, features: Tensor) -> MixturePose:
        """The mixture for features (B, features); it has B entries."""
        size, count = self.freedom.dimension, self.components
        numbers = self.last(features.to(_type_of(self.last))).to(torch.float64).unflatten(-1, (count, -1))
        weight, mean, scale, below = numbers.split([1, size, size, self.below.shape[1]], dim=-1)
        sizes = self.spread * torch.exp(LARGEST - nn.functional.softplus(LARGEST - scale))
        factor = torch.eye(size, dtype=torch.float64).repeat(*sizes.shape[:-1], 1, 1)
        factor[..., self.below[0], self.below[1]] = below
        factor = sizes[..., None] * factor
        covariance = factor @ factor.mT + torch.diag((1e-3 * self.spread).square())
        centers = poses.retract(self.center, self.freedom.embed(self.spread * mean))
        batch = centers.shape[:-2]
        whole = torch.diag(self.spread.square()).expand(*batch, 1, size, size)
        shares = torch.log_softmax(weight[..., 0], dim=-1) + math.log1p(-self.wide)
        return MixturePose(
            torch.cat([shares, shares.new_full((*batch, 1), math.log(self.wide))], dim=-1),
            torch.cat([centers, self.center.expand(*batch, 1, 7)], dim=-2),
            torch.cat([covariance, whole], dim=-3),
            self.freedom,
        )


def _type_of(module: nn.Module) -> torch.dtype:
    """The type of a module's parameters: torch's default when it was made, or what it was converted to."""
    return next(module.parameters()).dtype
