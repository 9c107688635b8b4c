"""Delayed acceptance: cheap sites decide first, and physics is run for the survivors only.

Christen and Fox, Markov chain Monte Carlo using an approximation, Journal of Computational and Graphical
Statistics 14, 2005; Banterle, Grazian, Lee and Robert, Accelerating Metropolis-Hastings algorithms by delayed
acceptance, Foundations of Data Science 1, 2019.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise

import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.errors import InputError
from bcppl.inference.kernels.kernel import (
    Kernel,
    Move,
    fitted,
    is_reversible,
    learns,
    marked,
    refuse_no_kernel,
    scattered,
)
from bcppl.inference.population import Population
from bcppl.inference.proposals import spread_of
from bcppl.inference.proposals.coordinates import coordinates_of
from bcppl.inference.proposals.spread import weighted_places
from bcppl.inference.targets import PHYSICS, POSTERIOR, FunctionTarget, Target, cost_of
from bcppl.traces import Trace


@dataclass(frozen=True)
class Staged(Target):
    """A target that accepts in stages: a proposal passes each with probability min(1, ratio of its sites).

    The product of the stages' ratios is the ratio of Metropolis-Hastings, and each of them is inverted when
    the old and the new trace change places: so detailed balance holds (Banterle et al., eq. 4 and lemma 1).

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
        # Sites with exponent 0 are in no stage: a stage of them would decide nothing.
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
        """The proposed trace with the sites of later stages hidden: they would be evaluated for all."""
        return trace.hiding([a for stage in self.stages(trace)[1:] for a in stage])


Surrogate = Callable[[Population], Callable[[Trace], Tensor]]


@dataclass(frozen=True, kw_only=True)
class Screened(Target):
    """A target that accepts in two stages, the first decided by a surrogate of its log-density.

    Christen and Fox, section 2: the surrogate and the proposal's ratio decide which proposals are evaluated;
    the second stage divides the surrogate's ratio out. It is a log-density (N,) of a trace, up to a constant.
    """

    surrogate: Callable[[Trace], Tensor]

    def accept(self, old: Trace, new: Trace, log_ratio: Tensor) -> tuple[Tensor, Trace]:
        """Which particles take their proposals: see `Target.accept`."""
        before, surrogate_ratio = self(old), self.surrogate(new) - self.surrogate(old)
        possible = self.part(new, list(new.choices)) > -torch.inf
        chance = torch.log(torch.rand(old.particles, dtype=torch.float64))
        index = ((surrogate_ratio + log_ratio > chance) & possible).nonzero().flatten()
        if len(index) == 0:
            return index, new[index]
        chance = torch.log(torch.rand(len(index), dtype=torch.float64))
        passed, survivors = self.above(new[index], chance + before[index] + surrogate_ratio[index])
        return index[passed], survivors

    def visible(self, trace: Trace) -> Trace:
        """The proposed trace with the sites that run physics hidden: they would be evaluated for all."""
        sites = trace.distributions
        return trace.hiding([a for a in sites if a not in trace.choices and cost_of(sites[a]) >= PHYSICS])


def student_t(address: str, degrees: float = 5.0, width: float = 1.3) -> Surrogate:
    """A surrogate: the multivariate t about the particles' weighted mean at a latent address.

    Its tails are heavy: a particle where the surrogate is far too low would hardly ever move. As of
    `independent`, D (D + 3) / 2 numbers are learnt: from 1,000 particles at D = 50 too many, and log evidence
    is off by +2.9 +- 1.2 (`benchmarks/exact.py`).

    Args:
        address: of a pose or of another continuous value, in the coordinates in which proposals move it
            (`bcppl.inference.proposals.coordinates`).
        degrees: of freedom.
        width: of its scale matrix, times the particles' weighted covariance.

    Raises:
        InputError: the degrees of freedom or the width are not greater than 0.
    """
    degrees = number_within("student_t is given {} degrees of freedom", degrees, above=0.0)
    width = number_within("student_t is given a width of {}", width, above=0.0)

    def fit(population: Population) -> Callable[[Trace], Tensor]:
        coordinates, places, weights, *_ = weighted_places(population, address)
        center = coordinates.mean(places, weights)
        factor = torch.linalg.cholesky(width * spread_of(address)(population))

        def log_density(trace: Trace) -> Tensor:
            steps = coordinates.steps(center, coordinates_of(trace, address).places(trace[address]))
            scaled = torch.linalg.solve_triangular(factor, steps.T, upper=False)
            squared = scaled.square().sum(dim=0)
            return -0.5 * (degrees + len(factor)) * torch.log1p(squared / degrees)

        return log_density

    return fit


def delayed_acceptance(
    kernel: Kernel,
    first: Sequence[str] | str | None = None,
    *,
    stages: int = 2,
    surrogate: Surrogate | None = None,
) -> Kernel:
    """A kernel whose proposals are decided by cheap sites first; the target stays exact.

    It accepts less often than the kernel by itself, and runs physics only where the cheap sites accept: so
    longer steps and more of them are worth while, `repeat(delayed_acceptance(...), 4)`.

    Args:
        kernel: one whose decisions go through `Target.accept`, such as `metropolis_hastings(...)`.
        first: patterns of the addresses that decide first, together with the latent sites and the proposal's
            ratio: "depth_*". By default all sites that cost less than physics.
        stages: how many, the first one included. The other sites are divided among the later ones evenly, in
            the order of cost and of the program, which for windows of a probe is that of time.
        surrogate: decides first in place of any site, such as `student_t("hole")`; like a proposal, it is
            fitted to other particles than those that are moved. Two stages then.

    Raises:
        InputError: what is given is no kernel, fewer than two stages, or sites and a surrogate that are both
            to decide first. When the kernel moves: a pattern fits no address, or the reverse move of a
            proposal reads a site of a later stage.
    """
    refuse_no_kernel("delayed_acceptance", kernel)
    stages = whole_number("delayed acceptance is asked for {} stages", stages, least=2)
    if surrogate is not None and (first is not None or stages != 2):
        raise InputError(
            "delayed acceptance is given a surrogate and sites or stages besides; "
            "a surrogate decides first by itself, and all sites after it."
        )
    patterns = (first,) if isinstance(first, str) else None if first is None else tuple(first)

    def staged(population: Population) -> Move:
        move = fitted(kernel, population)
        screen = surrogate(population) if surrogate is not None else None

        def in_stages(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            if isinstance(target, FunctionTarget):
                return move(trace, target)  # a function of the whole trace has no stages
            if screen is not None:
                return move(trace, Screened(exponents=target.exponents, surrogate=screen))
            return move(trace, Staged(target.exponents, patterns, stages - 1))

        return in_stages

    return marked(
        staged, reversible=False, learns=learns(kernel) or (surrogate is not None and learns(surrogate))
    )


def surrogate_transition(kernel: Kernel, surrogate: Surrogate) -> Kernel:
    """Moves that leave a surrogate of the target invariant, then one decision about where they have led.

    Liu, Monte Carlo Strategies in Scientific Computing, Springer, 2001, section 9.4.3: the last decision is
    on the ratio of the target to the surrogate, so that costly sites are evaluated once, however many moves
    come before. The moves are to be reversible together, as one Metropolis-Hastings move is, and as several
    in random order are (`cycle`); a `sequence` of different ones is not, and kernels that decide in stages
    ask the target itself.

    Args:
        kernel: of these moves. A particle is moved as often as `repeat` asks for.
        surrogate: of the target's log-density; like a proposal, it is fitted to other particles than those
            that are moved.

    Raises:
        InputError: what is given is no kernel, or none that is known to be reversible.
    """
    refuse_no_kernel("surrogate_transition", kernel)
    if not is_reversible(kernel):
        raise InputError(
            "surrogate_transition is given a kernel that is not known to be reversible with respect to a "
            "surrogate, so that the decision about where it led would be biased; give "
            "metropolis_hastings(...), hmc(...), involutive(...), or a cycle, mixture or repetition of them."
        )

    def fit(population: Population) -> Move:
        move, log_density = fitted(kernel, population), surrogate(population)

        def transition(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            if isinstance(target, FunctionTarget):
                return move(trace, target)  # a function of the whole trace has no costly sites
            begun = trace.without_states()
            walked, _ = move(begun, SurrogateTarget(log_density=log_density))
            index = _displaced(begun, walked)
            accepted = torch.zeros(trace.particles, dtype=torch.float64)
            if len(index) == 0:
                return trace, accepted
            chance = torch.log(torch.rand(len(index), dtype=torch.float64))
            gained = (log_density(walked) - log_density(begun))[index]
            passed, survivors = target.above(walked.chosen(index), chance + target(trace)[index] + gained)
            accepted[index[passed]] = 1.0
            return scattered(trace, index[passed], survivors), accepted

        return transition

    return marked(fit, reversible=False, learns=learns(kernel) or learns(surrogate))


def _displaced(old: Trace, new: Trace) -> Tensor:
    """The particles (K,) whose value at some latent address is another."""
    other = torch.zeros(old.particles, dtype=torch.bool)
    for address, value in new.choices.items():
        other |= (value != old[address]).reshape(old.particles, -1).any(dim=1)
    return other.nonzero().flatten()


class SurrogateTarget(FunctionTarget):
    """A surrogate of a log-density, zero where the latent sites are impossible, as the target of moves."""

    def __call__(self, trace: Trace) -> Tensor:
        """The log-density (N,)."""
        possible = POSTERIOR.part(trace, list(trace.choices)) > -torch.inf
        return torch.where(possible, self.log_density(trace), -torch.inf)
