"""Log-probabilities that are -inf where a value lies outside a distribution's support."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import torch
from pyro.distributions import (
    DirichletMultinomial,
    MixtureSameFamily,
    Multinomial,
    SineBivariateVonMises,
    SineSkewed,
    VonMises,
)
from pyro.distributions.torch_distribution import ExpandedDistribution, MaskedDistribution
from torch import Tensor
from torch.distributions import (
    Bernoulli,
    Binomial,
    Categorical,
    Distribution,
    Geometric,
    Independent,
    OneHotCategorical,
    TransformedDistribution,
    constraints,
)
from torch.distributions.constraints import MixtureSameFamilyConstraint
from torch.distributions.utils import probs_to_logits

from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError
from bcppl.poses import Freedom

WRAPPERS = (Independent, ExpandedDistribution, MaskedDistribution)
# Of angles: the densities are periodic on what torch and Pyro state as the support, the whole line, and
# normalised on one turn, where the draws are.
ANGLES = (VonMises, SineBivariateVonMises, SineSkewed)
TURN = constraints.interval(-math.pi, math.pi)


def base(distribution: Any) -> Any:
    """The innermost of distributions that only change the shape of another or mask it."""
    return base(distribution.base_dist) if isinstance(distribution, WRAPPERS) else distribution


def masks(distribution: Any, depth: int = 10) -> bool:
    """Whether a distribution, or one that it is made of, leaves values out of its log-probability.

    That is what `.mask()` does. It may be made of others as their transformation, mixture or choice.
    """
    if isinstance(distribution, MaskedDistribution) and not torch.as_tensor(distribution._mask).all():
        return True
    # One that holds itself in a ring holds no more than at this depth.
    return depth > 0 and any(masks(each, depth - 1) for each in _components(vars(distribution).values()))


def _components(attributes: Iterable[Any]) -> Iterator[Any]:
    """The distributions among the attributes of one, also within lists, tuples and dictionaries."""
    for each in attributes:
        if isinstance(each, Distribution):
            yield each
        elif type(each) in (list, tuple):
            yield from _components(each)
        elif type(each) is dict:
            yield from _components(each.values())


def freedom_of(distribution: Any) -> Freedom | None:
    """The free axes of the poses at a site; None where its values are no poses."""
    freedom: Freedom | None = getattr(base(distribution), "freedom", None)
    return freedom


def refuse_several_poses(address: str, value: Tensor, freedom: Freedom | None) -> None:
    """Refuse a latent site whose values (N, ..., 7) are several poses for each particle."""
    if value.ndim != 2 and freedom is not None:
        raise InputError(
            f"site {address!r} samples poses of shape {tuple(value.shape[1:])} for each particle, in a plate "
            "or an event; sample each pose at its own address, `for k in range(...)`."
        )


def is_of_angles(distribution: Any) -> bool:
    """Whether the density of a distribution is periodic."""
    innermost = base(distribution)
    if isinstance(innermost, MixtureSameFamily):
        return is_of_angles(innermost.component_distribution)
    return isinstance(innermost, ANGLES)


def whole_support(distribution: Any) -> Any:
    """A distribution's support; of angles one turn, from -pi to pi, of a mixture that of all components."""
    support = _of_components(distribution.support)
    if not is_of_angles(distribution):
        return support
    return constraints.independent(TURN, support.event_dim) if support.event_dim else TURN


def _of_components(support: Any) -> Any:
    """Of a mixture's support that of its components, where it is the same for all."""
    if isinstance(support, constraints.independent):
        components = _of_components(support.base_constraint)
        if components is support.base_constraint:
            return support
        return constraints.independent(components, support.reinterpreted_batch_ndims)
    if isinstance(support, MixtureSameFamilyConstraint):
        components = innermost = _of_components(support.base_constraint)
        while isinstance(innermost, constraints.independent):
            innermost = innermost.base_constraint
        return support if any(isinstance(v, Tensor) for v in vars(innermost).values()) else components
    return support


class Support(NamedTuple):
    """Where the values at a site may lie.

    Attributes:
        freedom: the free axes of poses, None where values are none.
        constraint: torch's, with the event dimensions; None of a pose.
        plates: the number of batch dimensions besides that of the particles.
        is_fixed: whether it depends on no parameter of the distribution, such as the bounds of a uniform one.
    """

    freedom: Freedom | None
    constraint: Any
    plates: int
    is_fixed: bool

    @classmethod
    def of(cls, distribution: Any) -> Support:
        """That of a distribution; NotImplementedError where it states none."""
        plates, freedom = len(distribution.batch_shape) - 1, freedom_of(distribution)
        if freedom is not None:
            return cls(freedom, None, plates, True)
        stated = getattr(type(base(distribution)), "support", None)
        is_fixed = isinstance(stated, constraints.Constraint) and not constraints.is_dependent(stated)
        return cls(None, whole_support(distribution), plates, is_fixed)


def support_of(distribution: Any) -> Any:
    """A distribution's support without the event dimensions wrapped around it; of angles one turn."""
    support = whole_support(distribution)
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    return support


def log_prob_inside(distribution: Any, value: Tensor, *, any_turn: bool = True) -> Tensor:
    """`distribution.log_prob(value)`, -inf where the value lies outside the support.

    An observed angle may be given in any turn, a latent one is from -pi to pi: on the line it would have
    infinitely much mass.

    Pyro's densities continue beyond it without validation: an exponential's grows below 0. torch states as
    the support of a transformed distribution where the last transform may lead, so that of a shifted
    exponential is the whole line, and as that of a mixture what all components have in common: what is
    transformed is looked up where it comes from, and a mixture's density is the sum of its components', each
    inside its own. Pose distributions and lazy ones check their support themselves. NaN is no value, and is
    passed on.
    """
    value = density_argument(distribution, value)
    if isinstance(base(distribution), MixtureSameFamily):
        return _of_mixture(distribution, value, any_turn)
    if any_turn if is_of_angles(distribution) else not _is_bounded(distribution, any_turn):
        return distribution.log_prob(value)
    inside = _inside(distribution, value, any_turn, masked=True)
    if not bool(inside.all()):
        inside = inside | _any_entry(torch.isnan(value), len(distribution.event_shape))
    if support_of(distribution).is_discrete:
        safe = _inside(distribution, value, any_turn, masked=False)
        if not bool(safe.all()):
            # A whole number may be an index: one out of range raises before its density could be masked.
            with torch.random.fork_rng(devices=[]):
                drawn = distribution.sample()
            safe = safe.reshape(safe.shape + (1,) * len(distribution.event_shape))
            value = torch.where(safe, value, drawn)
    return torch.where(inside, distribution.log_prob(value), -torch.inf)


def _of_mixture(distribution: Any, value: Tensor, any_turn: bool) -> Tensor:
    """`log_prob_inside` of a mixture, in whatever changes its shape or masks it."""
    if isinstance(distribution, MixtureSameFamily):
        each = log_prob_inside(
            distribution.component_distribution, distribution._pad(value), any_turn=any_turn
        )
        return torch.logsumexp(each + distribution.mixture_distribution.logits.log_softmax(dim=-1), dim=-1)
    log_prob = _of_mixture(distribution.base_dist, value, any_turn)
    if isinstance(distribution, MaskedDistribution):
        kept = torch.as_tensor(distribution._mask, device=value.device)
        return torch.where(kept, log_prob, torch.zeros_like(log_prob))
    if isinstance(distribution, Independent):
        summed = distribution.reinterpreted_batch_ndims
        return log_prob.flatten(-summed).sum(dim=-1) if summed else log_prob
    batch = value.shape[: value.ndim - len(distribution.event_shape)]
    return log_prob.expand(torch.broadcast_shapes(distribution.batch_shape, batch))


def density_argument(distribution: Any, value: Tensor) -> Tensor:
    """A value as the density of torch or Pyro takes it: whole numbers and truth values as float64.

    In their own type a Bernoulli refuses them, a geometric distribution negates 2 of uint8 to 254, and a
    Poisson's gamma function is in single precision. A class of a user gets what its own draws may be.
    """
    if value.is_floating_point() or value.is_complex() or not _is_of_torch_or_pyro(distribution):
        return value
    return value.to(torch.float64)


def _is_of_torch_or_pyro(distribution: Any) -> bool:
    innermost = base(distribution)
    return type(innermost).__module__.startswith(("torch.", "pyro.")) and all(
        map(_is_of_torch_or_pyro, _components(vars(innermost).values()))
    )


def has_probability(distribution: Any, value: Tensor) -> Tensor:
    """Whether values have a probability above 0, over the batch; torch rounds a stated 0 up to e^-36."""
    innermost = base(distribution)
    if isinstance(innermost, OneHotCategorical):
        return has_probability(innermost._categorical, value.argmax(dim=-1))
    if "probs" not in vars(innermost):
        return torch.tensor(True)
    if isinstance(innermost, Categorical):
        zero = _stated(innermost, innermost.probs == 0.0, is_binary=False)
        index = value.long().clamp(0, zero.shape[-1] - 1)
        shape = torch.broadcast_shapes(index.shape, zero.shape[:-1])
        index = index.expand(shape).unsqueeze(-1)
        return torch.as_tensor(~zero.expand(*shape, -1).gather(-1, index).squeeze(-1))
    if isinstance(innermost, Bernoulli | Binomial | Geometric):
        never, always = (_stated(innermost, innermost.probs == each, is_binary=True) for each in (0.0, 1.0))
        if isinstance(innermost, Geometric):
            return torch.as_tensor((value == 0) | ~always)
        most = innermost.total_count if isinstance(innermost, Binomial) else 1
        return torch.as_tensor(((value == 0) | ~never) & ((value == most) | ~always))
    return torch.tensor(True)


def _stated(distribution: Any, rounded: Tensor, *, is_binary: bool) -> Tensor:
    """Where a probability of 0 or 1 was given, and not rounded from logits."""
    if not bool(rounded.any()):
        return rounded
    return rounded & (distribution.logits == probs_to_logits(distribution.probs, is_binary=is_binary))


def _is_bounded(distribution: Any, any_turn: bool) -> bool:
    """Whether a value may lie outside the support, and the log-probability does not check it."""
    if getattr(type(distribution), "support", None) in (constraints.real, constraints.real_vector):
        return False
    innermost = base(distribution)
    if isinstance(innermost, LazyDistribution) or freedom_of(innermost) is not None:
        return False
    if _comes_from_within(innermost, any_turn):
        return True
    try:
        support = support_of(innermost)
    except NotImplementedError:
        return False
    # The real line and its vectors contain all numbers; a dependent support cannot be checked.
    return isinstance(support, constraints.Constraint) and not (
        support is constraints.real or constraints.is_dependent(support)
    )


def _comes_from_within(distribution: Any, any_turn: bool) -> bool:
    """Whether it is transformed of values within bounds, and states as its support where any would lead."""
    if getattr(type(distribution), "support", None) is not TransformedDistribution.support:
        return False
    within = distribution.base_dist
    return not any_turn if is_of_angles(within) else _is_bounded(within, any_turn)


def _inside(distribution: Any, value: Tensor, any_turn: bool, masked: bool) -> Tensor:
    """Whether values lie in the support, over the batch; a masked entry counts as inside if `masked`."""
    if isinstance(distribution, MaskedDistribution):
        inside = _inside(distribution.base_dist, value, any_turn, masked)
        return inside | ~torch.as_tensor(distribution._mask, device=value.device) if masked else inside
    if isinstance(distribution, Independent):
        inside = _inside(distribution.base_dist, value, any_turn, masked)
        return ~_any_entry(~inside, distribution.reinterpreted_batch_ndims)
    if isinstance(distribution, ExpandedDistribution):
        return _inside(distribution.base_dist, value, any_turn, masked)
    support = whole_support(distribution)
    inside = ~_any_entry(~support.check(value), len(distribution.event_shape) - support.event_dim)
    if _comes_from_within(distribution, any_turn):
        for transform in reversed(distribution.transforms):
            value = transform.inv(value)
        return inside & _inside(distribution.base_dist, value, any_turn, masked)
    if masked and isinstance(distribution, Multinomial | DirichletMultinomial):
        # Their densities are those given the counts' own total, their supports hold smaller ones too.
        inside = inside & (value.sum(dim=-1) == distribution.total_count)
    return inside & has_probability(distribution, value) if support.is_discrete else inside


def _any_entry(true: Tensor, dimensions: int) -> Tensor:
    return true.flatten(-dimensions).any(dim=-1) if dimensions > 0 else true
