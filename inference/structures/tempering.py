"""Tempering of strata: all structures' likelihoods raised to common powers, with resampling across them.

    temper = tempered_strata(in_turn(within(means), jump(birth)), least=20)
    strata, info = temper.generate(mixture, (x,), {"y": y}, particles=1000)
    print(probabilities(strata, "count"), strata.log_evidence, info.exponents)

The SMC sampler of Del Moral, Doucet and Jasra, Sequential Monte Carlo samplers, JRSS B 68, 2006, on the union
of the structures' spaces, as in their section 4.2 and in Jasra, Stephens and Holmes, On population-based
simulation for static inference, Statistics and Computing 17, 2007, section 5. With fixed exponents and fixed
moves the estimate of the evidence is unbiased, otherwise it is consistent only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.inference.exponents import fixed_exponents, next_exponent, resampled_below
from bcppl.inference.filters.step import Observed
from bcppl.inference.filters.tempering import kept_share, ratio_of_old_sites
from bcppl.inference.resampling import Scheme, systematic
from bcppl.inference.structures.allotment import resample_strata
from bcppl.inference.structures.branching import branch_strata
from bcppl.inference.structures.generation import drawn, enumerated, likelihood_sites
from bcppl.inference.structures.moves import StrataMove, refuse_no_move
from bcppl.inference.structures.strata import Strata
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Series, Structure, Trace, update
from bcppl.traces.run import Program


class StrataInfo(NamedTuple):
    """A record of tempering.

    Attributes:
        exponents: increasing, the last 1.
        resampled: how many times.
        acceptance: of each kind of move, averaged over the exponents; empty without moves.
        effective_sample_size: at the end.
    """

    exponents: tuple[float, ...]
    resampled: int
    acceptance: tuple[float, ...]
    effective_sample_size: float


class SteppedStrata(NamedTuple):
    """Strata that have assimilated observations, and the record of it."""

    strata: Strata
    info: StrataInfo


@dataclass(frozen=True)
class _TemperedLikelihood(Target):
    """The target whose likelihood is raised to a power in every structure, one that a jump reaches first too.

    Attributes:
        power: the exponent.
        sites: gives the addresses that are tempered.
    """

    power: float = 1.0
    sites: Callable[[Trace], list[str]] = likelihood_sites

    def within(self, trace: Trace) -> Target:
        return Target(dict.fromkeys(self.sites(trace), self.power))

    def part(self, trace: Trace, addresses: Sequence[str]) -> Tensor:
        return self.within(trace).part(trace, addresses)

    def above(
        self, trace: Trace, needed: Tensor, addresses: Sequence[str] | None = None
    ) -> tuple[Tensor, Trace]:
        return self.within(trace).above(trace, needed, addresses)


def _new_sites(args: tuple[Any, ...]) -> Callable[[Trace], list[str]]:
    """Gives the likelihood's sites that a program does not visit with earlier arguments.

    They are a matter of the structure alone. One that no particle had before a jump has old sites too.
    """
    known: dict[Structure, list[str]] = {}

    def sites(trace: Trace) -> list[str]:
        if trace.structure not in known:
            earlier = update(trace[:1], args=args).trace
            known[trace.structure] = likelihood_sites(trace, earlier.addresses)
        return known[trace.structure]

    return sites


@dataclass(frozen=True, eq=False)
class TemperedStrata:
    """Strata by tempering: see `tempered_strata`, which makes it."""

    move: StrataMove | None
    share: float
    exponents: tuple[float, ...] | None
    least: int
    threshold: float
    scheme: Scheme

    def generate(
        self,
        program: Program | Series,
        args: tuple[Any, ...],
        observations: Mapping[str, Tensor],
        particles: int,
        *,
        shares: Callable[[Structure], float] | None = None,
    ) -> SteppedStrata:
        """Strata of every structure of a program, as by `generate_strata`, the likelihood tempered."""
        return self._temper(enumerated(program, args, observations, particles, shares), particles)

    def sample(
        self,
        program: Program | Series,
        args: tuple[Any, ...],
        observations: Mapping[str, Tensor],
        particles: int,
    ) -> SteppedStrata:
        """Strata of structures drawn from a program, as by `sample_strata`, the likelihood tempered."""
        return self._temper(drawn(program, args, observations, particles), particles)

    def extend(self, strata: Strata, observed: Observed, particles: int | None = None) -> SteppedStrata:
        """Strata given new observations, as by `extend_strata`, the likelihood tempered.

        Args:
            strata: weighted for all earlier observations.
            observed: the program's arguments, and observations at new addresses.
            particles: how many there are after a resampling; as many as before by default.
        """
        sites = _new_sites(next(iter(strata.populations.values())).trace.args)
        branched, log_likelihoods = branch_strata(strata, observed)
        changed = {
            s: ratio_of_old_sites(each.trace, sites(each.trace), log_likelihoods[s])
            for s, each in branched.populations.items()
        }
        counted = branched.reweighed(changed)
        return self._temper(counted, len(strata) if particles is None else particles, sites)

    def _temper(
        self, strata: Strata, particles: int, likelihood: Callable[[Trace], list[str]] = likelihood_sites
    ) -> SteppedStrata:
        """Temper the likelihood's sites, which the weights do not yet count."""
        exponent, done, resampled = 0.0, [], 0
        acceptances: list[tuple[float, ...]] = []
        while exponent < 1.0:
            log_likelihoods = {
                s: POSTERIOR.part(each.trace, likelihood(each.trace))
                for s, each in strata.populations.items()
            }
            reached, exponent = exponent, self._after(exponent, strata, log_likelihoods)
            done.append(exponent)
            # 0 times -inf is no number, so a particle that cannot be loses its weight here, once.
            strata = strata.reweighed({s: (exponent - reached) * v for s, v in log_likelihoods.items()})
            if len(strata) > particles or strata.effective_sample_size < self.threshold * len(strata):
                strata = resample_strata(strata, particles, least=self.least, scheme=self.scheme)
                resampled += 1
            if self.move is not None:
                target = (
                    _TemperedLikelihood(power=exponent, sites=likelihood) if exponent < 1.0 else POSTERIOR
                )
                strata, acceptance = self.move(strata, target)
                acceptances.append(acceptance)
        accepted = (
            torch.tensor(acceptances, dtype=torch.float64).nanmean(dim=0).tolist() if acceptances else ()
        )
        info = StrataInfo(tuple(done), resampled, tuple(accepted), strata.effective_sample_size)
        return SteppedStrata(strata, info)

    def _after(self, reached: float, strata: Strata, log_likelihoods: Mapping[Structure, Tensor]) -> float:
        """The exponent that follows `reached`."""
        if self.exponents is not None:
            return next(e for e in self.exponents if e > reached)
        together = torch.cat([log_likelihoods[s] for s in strata.populations])
        return next_exponent(strata.log_weights, together, reached, self.share)


def tempered_strata(
    move: StrataMove | None = None,
    *,
    share: float = 0.5,
    exponents: Sequence[float] | None = None,
    least: int = 10,
    threshold: float | None = None,
    scheme: Scheme = systematic,
) -> TemperedStrata:
    """A way to assimilate observations that tempers all structures' likelihoods together.

    Args:
        move: of all particles after each exponent (`within`, `jump`, `in_turn`); None leaves them in place.
        share: tempering keeps the conditional effective sample size above this share of the particles; with
            0 there is one exponent, 1.
        exponents: fixed ones, increasing, the last 1; then `share` does not matter.
        least: particles that each structure keeps when strata are resampled (`resample_strata`), so that one
            with little weight early on is not lost.
        threshold: resample when the effective sample size is below this share of the particles; by default
            wherever the exponent leaves no more than `share` (half, where exponents are fixed).
        scheme: of resampling.

    Raises:
        InputError: what is given is no move, a share is not in [0, 1), or the exponents do not increase to 1.
    """
    if move is not None:
        refuse_no_move("tempered_strata", move)
    fixed = None if exponents is None else fixed_exponents(exponents)
    kept = kept_share(share)
    return TemperedStrata(
        move,
        kept,
        fixed,
        whole_number("strata are to keep {} particles of each structure", least, least=0),
        resampled_below(0.0 if fixed is not None else kept)
        if threshold is None
        else number_within("strata are resampled below a share of {}", threshold, least=0.0, most=1.0),
        scheme,
    )
