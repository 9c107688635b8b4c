"""The densities and draws of Pyro at less cost, for many particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Independent

from bcppl.distributions.support import base

# Below this many entries nothing is gained.
MANY = 1000


def unvalidated() -> AbstractContextManager[None]:
    """Pyro's and torch's validation switched off, at no cost where it is off already."""
    on = dist.is_validation_enabled() or pyro.infer.is_validation_enabled()
    return pyro.validation_enabled(False) if on or pyro.poutine.is_validation_enabled() else nullcontext()


def narrowed(distribution: Any) -> Any:
    """The same densities: a scale that all particles share is squared and logged once, not once for each."""
    kind = type(distribution)
    if kind in (dist.Independent, Independent):
        base = narrowed(distribution.base_dist)
        return distribution if base is distribution.base_dist else _with(distribution, base_dist=base)
    if kind not in (dist.Normal, dist.Laplace):
        return distribution
    scale = distribution.scale
    if scale.numel() < MANY or 0 not in scale.stride():
        return distribution
    return _with(distribution, scale=_once(scale))


def _with(distribution: Any, **attributes: Any) -> Any:
    other = object.__new__(type(distribution))
    other.__dict__.update(distribution.__dict__, **attributes)
    return other


def _once(scale: Tensor) -> Tensor:
    """One entry along the axes along which all are the same."""
    for axis, step in enumerate(scale.stride()):
        if step == 0:
            scale = scale.narrow(axis, 0, 1)
    return scale


def drawn(distribution: Any) -> Tensor | None:
    """A draw of many normals (`centred_normals`) or an LKJ prior; None leaves it to the distribution."""
    innermost = base(distribution)
    if isinstance(innermost, dist.LKJCholesky):
        return _onion(innermost).sample()
    if type(distribution) is not dist.Normal:
        return None
    mean = distribution.loc
    if mean.numel() < MANY or mean.dtype != torch.float64 or mean.device.type != "cpu":
        return None
    if mean.requires_grad or distribution.scale.requires_grad:
        return None
    return centred_normals(distribution.batch_shape, _once(distribution.scale)).add_(mean)


def _onion(distribution: Any) -> Any:
    """An LKJ prior whose draws have its density.

    Torch's have another one from the third row on: row i of the onion method has a squared length of
    Beta(i / 2, .), and torch has Beta(i - 1 / 2, .) (Lewandowski, Kurowicka and Joe, Journal of Multivariate
    Analysis 100, 2009, section 3.2).
    """
    first, second = distribution._beta.concentration1, distribution._beta.concentration0
    return _with(distribution, _beta=torch.distributions.Beta(0.5 * (first + 0.5), second))


def centred_normals(shape: Sequence[int], deviation: Tensor | float = 1.0) -> Tensor:
    """Draws of a normal about 0 in double precision, many of them by inversion.

    Torch draws these one by one (Box and Muller), which takes twice as long. The uniform numbers are odd
    multiples of 2^-53 between -1 and 1, so the draws are symmetric and finite, up to 8.2 deviations.
    """
    if math.prod(shape) < MANY:
        return torch.randn(shape, dtype=torch.float64).mul_(deviation)
    uniform = torch.rand(shape, dtype=torch.float64).mul_(2.0).sub_(1.0 - 2.0**-53)
    return uniform.erfinv_().mul_(deviation * math.sqrt(2.0))
