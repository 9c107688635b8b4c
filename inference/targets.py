"""Targets: the densities that kernels leave invariant.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling
    from bcppl.inference.targets import POSTERIOR, Target

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    population = importance_sampling(weighed, (), {"reading": torch.tensor(2.4).double()}, 1000)
    half = Target({"reading": 0.5})  # the prior times the square root of the likelihood
    print(POSTERIOR(population.trace) - half(population.trace))

A target is a function of a trace: log-probabilities (N,), up to a constant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.traces import Trace

PHYSICS = 2  # the cost of a site that simulates contact


def cost_of(site: Any) -> int:
    """The cost of evaluating a site: 0 arithmetic, 1 rendering, 2 physics (`bcppl.distributions.lazy`)."""
    return int(getattr(site, "cost", 0))


def runs_physics(trace: Trace) -> bool:
    """Whether a site of a trace simulates contact."""
    return any(cost_of(site) >= PHYSICS for site in trace.distributions.values())


@dataclass(frozen=True)
class Target:
    """The unnormalised log-density of a trace, with some sites tempered.

    Attributes:
        exponents: by address; a site that is not named has 1, one with exponent 0 is not evaluated.
    """

    exponents: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for address, exponent in self.exponents.items():
            number_within(f"site {address!r} is given the exponent {{}}", exponent, least=0.0)

    def exponent(self, address: str) -> float:
        """The exponent of a site."""
        return self.exponents.get(address, 1.0)

    def __call__(self, trace: Trace) -> Tensor:
        """The log-density (N,)."""
        self._refuse_unvisited(trace)
        return self.part(trace, trace.addresses)

    def _refuse_unvisited(self, trace: Trace) -> None:
        if self.exponents and not self.exponents.keys() <= set(trace.addresses):
            address = next(a for a in self.exponents if a not in trace.addresses)
            raise InputError(
                f"a target gives site {address!r} an exponent, but the program never visits it; "
                f"it visits {', '.join(trace.addresses) or 'none'}."
            )

    def part(self, trace: Trace, addresses: Sequence[str]) -> Tensor:
        """The contribution (N,) of some sites to the log-density."""
        total = torch.zeros(trace.particles, dtype=torch.float64)
        for address in addresses:
            if self.exponent(address) > 0.0:
                total = total + self.exponent(address) * trace.log_prob(address)
        return total

    def above(
        self, trace: Trace, needed: Tensor, addresses: Sequence[str] | None = None
    ) -> tuple[Tensor, Trace]:
        """The particles whose log-density exceeds a threshold (N,), for as few evaluations as possible.

        Sites are evaluated in the order of their cost and then of the program. A particle that could not
        reach its threshold even if every remaining site had its upper bound is dropped, so that physics is
        run for the remaining particles only. The result is that of evaluating everything, to the bit.

        Returns:
            Their indices (K,) in increasing order, and the trace of these K particles.
        """
        self._refuse_unvisited(trace)
        counted = trace.distributions if addresses is None else set(addresses)
        sites = [(a, s) for a, s in trace.distributions.items() if a in counted and self.exponent(a) > 0.0]
        sites.sort(key=lambda site: cost_of(site[1]))
        bounds = [self.exponent(a) * float(getattr(s, "log_prob_bound", torch.inf)) for a, s in sites]
        index = torch.arange(trace.particles)
        total = torch.zeros(trace.particles, dtype=torch.float64)
        if not sites:
            index = (needed < 0.0).nonzero().flatten()
            return index, trace[index]
        for k, (address, _) in enumerate(sites):
            total = total + self.exponent(address) * trace.log_prob(address)
            last = k + 1 == len(sites)
            # Rounding in another order of summation must not drop a particle that would just pass.
            reach = 0.0 if last else sum(bounds[k + 1 :]) + 1e-6
            alive = total + reach > needed
            expensive = not last and cost_of(sites[k + 1][1]) > 0
            if (last or expensive) and not bool(alive.all()):
                kept = alive.nonzero().flatten()
                index, trace, total, needed = index[kept], trace[kept], total[kept], needed[kept]
            if len(index) == 0:
                break
        return index, trace

    def accept(self, old: Trace, new: Trace, log_ratio: Tensor) -> tuple[Tensor, Trace]:
        """The indices (K,) of the particles that accept their proposals, and the trace of these.

        Metropolis-Hastings: the log-ratio (N,) is the log-density of the reverse proposal minus that of the
        proposal, Jacobian included.
        """
        # With the uniform number drawn first, the log-density that a proposal must exceed is known.
        chance = torch.log(torch.rand(old.particles, dtype=torch.float64))
        return self.above(new, chance + self(old) - log_ratio)

    def within(self, trace: Trace) -> Target:
        """The target on the sites that a trace visits: of several structures, others may visit others."""
        return Target({a: e for a, e in self.exponents.items() if a in trace.distributions})

    def visible(self, trace: Trace) -> Trace:
        """The part of a proposed trace that the reverse proposal may read: here all of it."""
        return trace


POSTERIOR = Target()


@dataclass(frozen=True, kw_only=True)
class FunctionTarget(Target):
    """A target that is any function of the whole trace: it has no stages, and sites have no exponents.

    Attributes:
        log_density: (N,) of a trace, up to a constant.
    """

    log_density: Callable[[Trace], Tensor]

    def exponent(self, address: str) -> float:
        """Refused."""
        raise InputError(
            f"the exponent of site {address!r} is asked of a target that is a function of the trace; "
            "give a `Target`, of which each site's exponent is known."
        )

    def __call__(self, trace: Trace) -> Tensor:
        """The log-density (N,)."""
        return self.log_density(trace)

    def above(
        self, trace: Trace, needed: Tensor, addresses: Sequence[str] | None = None
    ) -> tuple[Tensor, Trace]:
        """See `Target.above`: everything is evaluated, for all particles."""
        index = (self(trace) > needed).nonzero().flatten()
        return index, trace[index]

    def within(self, trace: Trace) -> Target:
        """The function itself."""
        return self


def as_target(target: Callable[[Trace], Tensor]) -> Target:
    """A target as kernels know it: a plain function of the trace as a `FunctionTarget`."""
    return target if isinstance(target, Target) else FunctionTarget(log_density=target)
