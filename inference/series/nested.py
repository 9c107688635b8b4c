"""M particle filters of N particles each for one series, run as one batch of M x N particles.

Gordon, Salmond and Smith, Novel approach to nonlinear/non-Gaussian Bayesian state estimation, IEE Proc. F
140, 1993 (the bootstrap filter). The estimate of the likelihood is unbiased, also where each filter resamples
when its own effective sample size falls (Del Moral, Feynman-Kac formulae, 2004, section 7.4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.series import groups
from bcppl.inference.series.states import merged, merged_entries
from bcppl.traces import Series, Trace, extend, generate
from bcppl.traces.carried import Entry
from bcppl.traces.dependence.equality import comparison, equal
from bcppl.traces.indexing import indexed
from bcppl.traces.series import SeriesTrace, resumed


@dataclass(frozen=True, eq=False)
class Shared:
    """Arguments that all particles share, whatever their sizes."""

    args: tuple[Any, ...]


@dataclass(eq=False)
class Filters:
    """M filters after T steps: indexed and merged by filter, and run on when a later step is asked for.

    What was estimated once stays: the estimates belong to a filter's particles, so that a step that is asked
    for again has the same numbers, and a proposal that is refused leaves the old ones. Each trace runs a
    branch of its own on (`branched`): two that come from one estimate their later steps independently.

    Attributes:
        series: what is run.
        args: the arguments of its `init`.
        static: values (M, *event) of the static parameters, by the addresses at which `init` samples them.
        count: N, of each filter.
        threshold: a filter resamples when its effective sample size is below this share of N.
        log_weights: (M, N), normalised in each filter.
        increments: (T, M), log p(y_t | y_1, ..., y_t-1) as estimated; what `init` conditions on counts with
            the first.
        state: what the newest step returned for the M x N particles, those of a filter side by side; None
            before the first step.
        seen: the address, the arguments and the observation of each step.
        carried: simulator states of the M x N particles.
        identity: two filters are the same if they share it.
    """

    series: Series
    args: tuple[Any, ...]
    static: Mapping[str, Tensor]
    count: int
    threshold: float
    log_weights: Tensor
    increments: Tensor
    state: Any = None
    seen: list[tuple[str, tuple[Any, ...], Tensor]] = field(default_factory=list)
    carried: dict[str, Entry] = field(default_factory=dict)
    identity: object = field(default_factory=object)
    __caches__ = ("log_weights", "increments", "state", "seen", "carried")

    @classmethod
    def before(
        cls,
        series: Series,
        shared: Shared,
        count: int,
        threshold: float,
        addresses: tuple[str, ...],
        *values: Tensor,
    ) -> Filters:
        """Filters before the first step, at values (M, *event) of static parameters."""
        weights = torch.full((len(values[0]), count), groups.equal(count), dtype=torch.float64)
        static = dict(zip(addresses, values, strict=True))
        none = weights.new_empty(0, len(weights))
        return cls(series, shared.args, static, count, threshold, weights, none)

    def branched(self) -> Filters:
        """The same filters, which run on without these."""
        return replace(self, seen=list(self.seen))

    def restart_where_changed(self, steps: Sequence[tuple[Any, ...]]) -> None:
        """Forget all that was estimated, if a step was run that `steps` lacks or has with other arguments.

        The estimate of a step is one given the filter's own past: those before the changed one go with it.
        """
        are_same, ran = comparison(), len(self.seen)
        if ran <= len(steps) and all(map(are_same, [then[1] for then in self.seen], steps[:ran])):
            return
        addresses, values = tuple(self.static), self.static.values()
        start = self.before(self.series, Shared(self.args), self.count, self.threshold, addresses, *values)
        vars(self).update(vars(start))

    def log_increment(self, number: int, address: str, args: tuple[Any, ...], value: Tensor) -> Tensor:
        """Estimate (M,) of the log-likelihood of the observation of a step given those before it.

        Raises:
            InputError: a step before it was not asked for, or a step is asked for with another observation.
        """
        if number > len(self.seen) + 1:
            raise InputError(
                f"the likelihood of step {number} of a series is asked for, whose filters have run "
                f"{len(self.seen)}; ask for the steps in order, `trace.log_prob()`."
            )
        if number == len(self.seen) + 1:
            self._advance(address, args, value)
        elif self.seen[number - 1][0] != address or not equal(self.seen[number - 1][2], value):
            raise InputError(
                f"the observation of step {number} of a series is another than the filters have assimilated; "
                "generate a trace for other observations."
            )
        return self.increments[number - 1]

    def _advance(self, address: str, args: tuple[Any, ...], value: Tensor) -> None:
        trace, log_weights = self._resampled() if self.seen else self._begun()
        longer, log_likelihood = extend(trace, args, {address: value})
        assert isinstance(longer, SeriesTrace)
        self.log_weights, increment = groups.reweighed(log_weights, log_likelihood)
        self.increments = torch.cat([self.increments, increment[None]])
        self.state, self.carried = longer.state, dict(longer.carried)
        self.seen.append((address, args, value))

    def _begun(self) -> tuple[Trace, Tensor]:
        """The particles of `init`, and their log weights (M, N): what it conditions on itself counts."""
        given = {a: value.repeat_interleave(self.count, dim=0) for a, value in self.static.items()}
        series = replace(self.series, history=False)
        trace, _ = generate(series, self.args, {}, self.log_weights.numel(), given)
        for address in self.static:
            density = trace.log_prob(address).reshape(self.log_weights.shape)
            if not bool(torch.isclose(density, density[:, :1]).all()):
                others = [each for each in trace.choices if each not in self.static]
                raise InputError(
                    f"the distribution of the static parameter {address!r} depends on others that `init` "
                    f"samples ({', '.join(others)}) and that are integrated out; name them as static too."
                )
        fixed = [address for address in trace.addresses if address not in trace.choices]
        if not fixed:
            return trace, self.log_weights
        return trace, self.log_weights + trace.log_prob(*fixed).reshape(self.log_weights.shape)

    def _resampled(self) -> tuple[Trace, Tensor]:
        """The particles from which the next step begins, and their log weights (M, N)."""
        trace = resumed(self.series, self.state, len(self.seen), self.log_weights.numel(), self.carried)
        low = groups.effective_sample_sizes(self.log_weights) < self.threshold * self.count
        if not bool(low.any()):
            return trace, self.log_weights
        ancestors = torch.arange(self.count).repeat(len(low), 1)
        ancestors[low] = groups.systematic(self.log_weights[low])
        log_weights = torch.where(low[:, None], groups.equal(self.count), self.log_weights)
        return trace.chosen(groups.rows(ancestors, self.count)), log_weights

    def __getitem__(self, index: Tensor) -> Filters:
        """The filters at `index` (K,)."""
        every = torch.arange(self.count).repeat(len(index), 1)
        particles = (index[:, None] * self.count + every).flatten()
        return replace(
            self,
            static={address: value[index] for address, value in self.static.items()},
            log_weights=self.log_weights[index],
            increments=self.increments[:, index],
            state=indexed(self.state, particles, self.log_weights.numel()) if self.seen else None,
            seen=list(self.seen),
            carried={name: entry.take(particles) for name, entry in self.carried.items()},
            identity=object(),
        )

    def where(self, mask: Tensor, other: Filters) -> Filters:
        """These filters where `mask` (M,) is true, the other's elsewhere; those that are behind catch up."""
        for each, ahead in ((self, other), (other, self)):
            for step in ahead.seen[len(each.seen) :]:
                each._advance(*step)
        particles = mask.repeat_interleave(self.count)
        return replace(
            self,
            static=merged(mask, self.static, other.static),
            log_weights=torch.where(mask[:, None], self.log_weights, other.log_weights),
            increments=torch.where(mask, self.increments, other.increments),
            state=merged(particles, self.state, other.state) if self.seen else None,
            seen=list(self.seen),
            carried=merged_entries(particles, self.carried, other.carried),
            identity=object(),
        )
