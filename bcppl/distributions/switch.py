"""A distribution chosen for each particle by the value of a discrete site."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch.distributions import constraints

from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.support import freedom_of, log_prob_inside, support_of
from bcppl.errors import InputError
from bcppl.poses import Freedom


class Switch(LazyDistribution):
    """One of several distributions, chosen by a discrete value of each particle.

    Only the chosen one is evaluated for a particle, so a renderer or a physics engine runs no more often than
    without a choice.

        which = pyro.sample("which", Categorical(torch.ones(2)))
        depth = Switch(which, lambda k, rows: LaplaceDepth(renderers[k], camera, pose[rows], 0.003))
        pyro.sample("depth", depth)

    Args:
        which: (N,) whole numbers.
        build: `build(k, rows)` returns the distribution of the particles at `rows` (K,) int64, all of which
            chose k; its batch shape is (K,). Event shape, kind of support (real, positive, ...) and free
            axes of poses are the same for every k, and so is `cost` where none is given.
        cost: of a log-probability (see `LazyDistribution`), whatever was chosen. Give it where the choices'
            costs differ, since a choice may be absent from a batch: kernels that sort sites by cost leave
            their target invariant only if the cost is the same at every value.

    Attributes:
        freedom: which axes are free where the choices are over poses, else None.

    Raises:
        InputError: `which` is no vector of whole numbers, a distribution has another shape, or the choices
            differ in their support, their free axes, or their costs while no cost is given.
    """

    def __init__(
        self, which: Tensor, build: Callable[[int, Tensor], Any], *, cost: int | None = None
    ) -> None:
        if which.ndim != 1 or not bool((which == which.round()).all()):
            raise InputError(
                f"Switch has choices of shape {tuple(which.shape)}; "
                "give one whole number for each particle, such as a draw of Categorical."
            )
        self.groups: list[tuple[Tensor, Any]] = []
        for choice in torch.unique(which).tolist():
            rows = (which == choice).nonzero().flatten()
            built = build(int(choice), rows)
            if tuple(built.batch_shape) != (len(rows),):
                raise InputError(
                    f"choice {int(choice)} of Switch has batch shape {tuple(built.batch_shape)} for "
                    f"{len(rows)} particles; build it from values at the given rows, `pose[rows]`."
                )
            self.groups.append((rows, built))
        built = [distribution for _, distribution in self.groups]
        shape = _common("events of different shapes", {tuple(each.event_shape) for each in built})
        costs = sorted({int(getattr(each, "cost", 0)) for each in built})
        if cost is None and len(costs) > 1:
            raise InputError(
                f"the choices of Switch have costs {', '.join(map(str, costs))}; "
                "give the largest as cost=, which is the cost whatever is chosen."
            )
        self.cost = costs[0] if cost is None else cost
        self.support = _common_support(self.groups)
        self.freedom: Freedom | None = _common("different free axes", {freedom_of(each) for each in built})
        super().__init__(len(which), shape)

    @property
    def log_prob_bound(self) -> float:
        """The largest of the chosen distributions' bounds."""
        return max(float(getattr(each, "log_prob_bound", torch.inf)) for _, each in self.groups)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of one value (*event_shape), or of one for each particle."""
        own = value.ndim > len(self.event_shape)
        total = torch.empty(self.batch_shape[0], dtype=torch.float64)
        for rows, distribution in self.groups:
            total[rows] = log_prob_inside(distribution, value[rows] if own else value).to(torch.float64)
        return total

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One value for each particle, (N, *event_shape)."""
        drawn = [(rows, distribution.sample()) for rows, distribution in self.groups]
        kind = reduce(torch.promote_types, (value.dtype for _, value in drawn))
        values = drawn[0][1].new_empty(self.batch_shape + self.event_shape, dtype=kind)
        for rows, value in drawn:
            values[rows] = value.to(kind)
        return values


def _common(what: str, values: set[Any]) -> Any:
    """The one value that all choices have."""
    if len(values) > 1:
        raise InputError(
            f"the choices of Switch have {what}: {', '.join(sorted(map(str, values)))}; "
            "give all the same, or their densities cannot be compared."
        )
    return values.pop()


# Closed and half open supports have the same unbounded coordinates.
_KINDS = {"GreaterThanEq": "GreaterThan", "HalfOpenInterval": "Interval"}


def _kind(support: Any) -> str:
    name = type(support).__name__.strip("_")
    return "discrete" if support.is_discrete else _KINDS.get(name, name)


def _common_support(groups: list[tuple[Tensor, Any]]) -> Any:
    """The support of all choices; bounds that differ are spread over the particles."""
    whole = groups[0][1].support
    innermost = [support_of(distribution) for _, distribution in groups]
    if _common("supports of different kinds", set(map(_kind, innermost))) == "discrete":
        return whole
    common = copy(innermost[0])
    for name, value in vars(innermost[0]).items():
        if isinstance(value, int | float | Tensor):
            bounds = [(rows, vars(each)[name]) for (rows, _), each in zip(groups, innermost, strict=True)]
            setattr(common, name, _spread(bounds))
    wrapped = whole.event_dim - common.event_dim
    return constraints.independent(common, wrapped) if wrapped else common


def _spread(bounds: list[tuple[Tensor, Any]]) -> Any:
    """One bound for each particle, from bounds (K, ...) or () at rows (K,); the bound itself if all agree."""
    first = bounds[0][1]
    if not any(isinstance(bound, Tensor) for _, bound in bounds) and all(b == first for _, b in bounds):
        return first
    each = [(rows, torch.as_tensor(bound, dtype=torch.float64)) for rows, bound in bounds]
    tail = max((bound.shape[1:] for _, bound in each), key=len)
    spread = torch.empty((sum(len(rows) for rows, _ in each), *tail), dtype=torch.float64)
    for rows, bound in each:
        missing = len(tail) + 1 - bound.ndim if bound.ndim else 0
        spread[rows] = bound.reshape(bound.shape + (1,) * missing)
    return spread
