"""Delayed acceptance: cheap sites decide first, and only for the survivors is physics run.

Christen and Fox, Markov chain Monte Carlo using an approximation, Journal of Computational and Graphical
Statistics 14, 2005; Banterle, Grazian, Lee and Robert, Accelerating Metropolis-Hastings algorithms by delayed
acceptance, Foundations of Data Science 1, 2019.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.kernels.kernel import Kernel, Move
from bcppl.inference.population import Population
from bcppl.inference.targets import Target, cost_of
from bcppl.traces import Trace

PHYSICS = 2  # the cost of a site that simulates contact (`bcppl.distributions.lazy`)


@dataclass(frozen=True)
class Staged(Target):
    """A target that accepts in stages: a proposal must pass each with chance min(1, ratio of its sites).

    The product of the stages' ratios is the ratio of Metropolis-Hastings, and each of them is inverted when
    the old and the new trace change places: so the balance is kept in detail (Banterle et al., eq. 4 and
    lemma 1).

    Attributes:
        first: patterns of the addresses that decide first, together with the latent sites and the proposal's
            ratio; None for all sites that cost less than physics.
        later: into how many stages the other sites are divided.
    """

    first: tuple[str, ...] | None = None
    later: int = 1

    def stages(self, trace: Trace) -> list[list[str]]:
        """Addresses by stage; the later ones in the order of cost, then of the program.

        Raises:
            InputError: a pattern fits no address.
        """
        sites = trace.distributions
        for pattern in self.first or ():
            if not any(fnmatchcase(address, pattern) for address in sites):
                raise InputError(
                    f"delayed acceptance is to decide first by {pattern!r}, which fits no address; "
                    f"the program visits {', '.join(sites) or 'none'}."
                )
        early = [a for a in sites if a in trace.choices or self._first(a, cost_of(sites[a]))]
        # Sites that count for nothing are in no stage: a stage of them would decide nothing.
        late = [a for a in sites if a not in early and self.exponent(a) > 0.0]
        late.sort(key=lambda address: cost_of(sites[address]))
        count = min(self.later, len(late))
        cuts = [round(k * len(late) / count) for k in range(count + 1)] if count else []
        return [early, *[late[a:b] for a, b in pairwise(cuts)]]

    def _first(self, address: str, cost: int) -> bool:
        if self.first is None:
            return cost < PHYSICS
        return any(fnmatchcase(address, pattern) for pattern in self.first)

    def accept(self, old: Trace, new: Trace, log_ratio: Tensor) -> tuple[Tensor, Trace]:
        """Which particles take their proposals: see `Target.accept`; each stage sees the survivors only."""
        index = torch.arange(old.particles)
        for addresses in self.stages(new):
            chance = torch.log(torch.rand(len(index), dtype=torch.float64))
            needed = chance + self.part(old, addresses)[index] - log_ratio[index]
            passed, new = self.above(new, needed, addresses)
            index = index[passed]
            # The proposal's ratio counts once, in the first stage.
            log_ratio = torch.zeros_like(log_ratio)
            if len(index) == 0:
                break
        return index, new

    def visible(self, trace: Trace) -> Trace:
        """The proposed trace without the sites of later stages, which would be evaluated for all."""
        return trace.hiding([a for stage in self.stages(trace)[1:] for a in stage])


def delayed_acceptance(
    kernel: Kernel, first: Sequence[str] | str | None = None, *, stages: int = 2
) -> Kernel:
    """A kernel whose proposals are decided by cheap sites first; the target it leaves invariant is the same.

    It accepts less often than the kernel by itself, and pays for physics only where the cheap sites agree.

    Args:
        kernel: one whose decisions go through `Target.accept`, such as `metropolis_hastings(...)`.
        first: patterns of the addresses that decide first, together with the latent sites and the proposal's
            ratio: "depth_*". By default all sites that cost less than physics.
        stages: how many, the first one included. The other sites are divided among the later ones evenly, in
            the order of cost and of the program, which for windows of a probe is that of time.

    Raises:
        InputError: fewer than two stages. When the kernel moves: a pattern fits no address, the target is a
            plain function, or the way back of a proposal reads a site of a later stage.
    """
    if stages < 2:
        raise InputError(f"delayed acceptance is asked for {stages} stages; give 2 or more.")
    patterns = (first,) if isinstance(first, str) else None if first is None else tuple(first)

    def staged(population: Population) -> Move:
        move = kernel(population)

        def in_stages(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            if not isinstance(target, Target):
                raise InputError(
                    "delayed acceptance cannot divide a target that is a plain function; give a Target."
                )
            return move(trace, Staged(target.exponents, patterns, stages - 1))

        return in_stages

    return staged
