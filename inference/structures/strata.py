"""Strata: a posterior over programs' structures, one population of particles for each."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NoReturn

import torch
from torch import Tensor

from bcppl.beliefs import Belief, effective_sample_size, normalised
from bcppl.cached import cached_property
from bcppl.distributions.support import freedom_of, is_of_angles
from bcppl.errors import InputError, OtherKindError
from bcppl.inference.population import FIELDS, Population
from bcppl.inference.summaries import Probabilities
from bcppl.traces import Structure, Trace
from bcppl.traces.concatenation import concatenated


@dataclass(frozen=True, eq=False, repr=False)
class Strata:
    """Weighted particles of several structures: a population for each, their weights on one scale.

    The weight of a particle is comparable with that of any other, of whatever structure: the posterior
    probability of a structure is the share of its particles in the sum of all weights. The log evidence of
    each population is that of the observations and its structure together. `strata["x"]` are the values
    (N, *event) of all particles at an address, stratum after stratum.

    Attributes:
        populations: by structure; each with some weight.
        log_evidence: log of the estimated evidence of all observations, summed over structures.
    """

    populations: Mapping[Structure, Population]
    log_evidence: float

    @classmethod
    def of(cls, populations: Iterable[tuple[Structure, Population]], log_evidence: float) -> Strata:
        """The strata of populations, by structure in order, without those that have no weight.

        Populations of the same structure are joined.

        Raises:
            NoWeightError: no particle has any weight.
            NotANumberError: a weight is NaN.
        """
        parts: dict[Structure, list[Population]] = {}
        for structure, each in populations:
            if len(each):
                parts.setdefault(structure, []).append(each)
        whole = {
            each: concatenated_population(parts[each])
            for each in sorted(parts, key=lambda s: tuple(s.items()))
        }
        log_total = _log_total(whole.values())
        return cls(
            {
                structure: replace(each, log_evidence=log_evidence + each.log_total - log_total)
                for structure, each in whole.items()
                if each.log_total > -math.inf
            },
            log_evidence,
        )

    def __len__(self) -> int:
        return sum(len(population) for population in self.populations.values())

    @property
    def structures(self) -> list[Structure]:
        """The structures, in order."""
        return list(self.populations)

    @cached_property
    def log_weights(self) -> Tensor:
        """(N,) of all particles, stratum after stratum."""
        return torch.cat([each.log_weights for each in self.populations.values()])

    @cached_property
    def log_total(self) -> float:
        """Log of the sum of all weights."""
        return _log_total(self.populations.values())

    @cached_property
    def effective_sample_size(self) -> float:
        """1 / sum of squared normalised weights, of all particles together."""
        return effective_sample_size(self.log_weights)

    @cached_property
    def shares(self) -> dict[Structure, float]:
        """The posterior probability of each structure; one without particles is left out."""
        return {s: math.exp(each.log_total - self.log_total) for s, each in self.populations.items()}

    def reweighed(self, log_factors: Mapping[Structure, Tensor]) -> Strata:
        """Every weight times exp(log_factor), and the evidence times the weighted mean of the factors.

        Args:
            log_factors: by structure, one (N_s,) for each of its particles.

        Raises:
            NoWeightError: no particle has any weight left.
            NotANumberError: a weight is NaN or +inf.
        """

        def later(each: Population, log_factor: Tensor) -> Population:
            # A particle without weight stays without, whatever has become possible with it.
            possible = each.log_weights > -torch.inf
            # `replace` keeps nothing that was computed from the old weights.
            return replace(each, log_weights=each.log_weights + log_factor.where(possible, 0.0))

        return self._among((s, later(each, log_factors[s])) for s, each in self.populations.items())

    def _among(self, parts: Iterable[tuple[Structure, Population]]) -> Strata:
        """The strata of some populations; the evidence changes as the sum of the weights does."""
        parts = list(parts)
        total = _log_total(each for _, each in parts)
        return Strata.of(parts, self.log_evidence + (total - self.log_total))

    def given(self, values: Mapping[str, int]) -> Strata:
        """The strata whose structural sites have some values; the evidence is that of these values too.

        Raises:
            InputError: there are none.
        """
        chosen = [
            (s, each) for s, each in self.populations.items() if all(s.get(a) == v for a, v in values.items())
        ]
        if not chosen:
            raise InputError(f"no stratum has {dict(values)}; there are {_listed(self.structures)}.")
        return self._among(chosen)

    def visiting(self, address: str) -> Strata:
        """The strata whose programs visit an address; the evidence is that of its being visited too.

        Raises:
            InputError: none does.
        """
        chosen = [(s, each) for s, each in self.populations.items() if _has(each.trace, address)]
        if not chosen:
            raise InputError(f"no stratum has a value at {address!r}; there are {_listed(self.structures)}.")
        return self._among(chosen)

    def __getitem__(self, address: str) -> Tensor:
        missing = [s for s, each in self.populations.items() if not _has(each.trace, address)]
        if missing:
            raise InputError(
                f"{_listed(missing)} of the strata have no value at {address!r}; "
                f"use visiting({address!r}) for the others."
            )
        values = [_of_each(each.trace, address) for each in self.populations.values()]
        apart = {tuple(v.shape[1:]): s for s, v in zip(self.populations, values, strict=True)}
        if len(apart) > 1:
            shapes_of = ", ".join(f"{shape} in {s}" for shape, s in apart.items())
            raise InputError(
                f"values at {address!r} have other shapes in some strata than in others ({shapes_of}); "
                "choose strata with given(...)."
            )
        return torch.cat(values)

    if not TYPE_CHECKING:  # the type checker would take any attribute to be there

        def __getattr__(self, name: str) -> NoReturn:
            if name in FIELDS or hasattr(Population, name):
                raise OtherKindError(
                    "strata are given where one population is wanted; choose one of strata.populations, or "
                    "use the function of that purpose in bcppl.inference.structures."
                )
            raise AttributeError(f"Strata has no attribute {name!r}")

    def belief(self, address: str) -> Belief:
        """The particles of all strata read as a posterior over the pose at an address.

        Raises:
            InputError: a structure has no latent site with that address, or no pose is there.
        """
        freedom = {each.belief(address).freedom for each in self.populations.values()}
        if len(freedom) > 1:
            raise InputError(f"the pose at {address!r} has other free axes in some strata than in others.")
        return Belief(self[address], self.log_weights, freedom.pop())

    def __repr__(self) -> str:
        shares = ", ".join(
            f"{s!r}: {share:.3f} ({len(self.populations[s])} particles)" for s, share in self.shares.items()
        )
        return (
            f"Strata(effective sample size {self.effective_sample_size:.1f}, "
            f"log evidence {self.log_evidence:.4f}, {shares})"
        )


def probabilities(strata: Strata, address: str) -> Probabilities:
    """The posterior probability of each value of a structural site.

    They sum to less than 1 where some structures do not visit the site: to the probability that it is
    visited.

    Raises:
        InputError: no structure visits a structural site at the address.
    """
    summed: dict[int, float] = {}
    for structure, share in strata.shares.items():
        if address in structure:
            summed[structure[address]] = summed.get(structure[address], 0.0) + share
    if not summed:
        raise InputError(f"{address!r} is no structural site of {_listed(strata.structures)}.")
    values = sorted(summed)
    return Probabilities(torch.tensor(values), torch.tensor([summed[v] for v in values], dtype=torch.float64))


def mean(strata: Strata, address: str) -> Tensor:
    """The weighted mean (*event) over the particles of all structures, of poses the mean pose (7,).

    Of angles it is the direction of the mean vector.

    Raises:
        InputError: a structure does not visit the address, or the values' shapes differ.
    """
    weights, values = normalised(strata.log_weights), strata[address].to(torch.float64)
    distribution = next(iter(strata.populations.values())).trace.distributions.get(address)
    if freedom_of(distribution) is not None:
        return strata.belief(address).mean
    if distribution is None or not is_of_angles(distribution):
        return torch.einsum("n,n...->...", weights, values)
    sine, cosine = (torch.einsum("n,n...->...", weights, each) for each in (values.sin(), values.cos()))
    return torch.atan2(sine, cosine)


def concatenated_population(populations: Iterable[Population]) -> Population:
    """One population of the particles of several of one structure, in their order, with their weights.

    A particle stays in its half (`bcppl.inference.kernels.halving`), so that it is in that of its copies. The
    log evidence and the approximation are those of the first.
    """
    populations = list(populations)
    first = populations[0]
    if len(populations) == 1:
        return first
    halved = all(len(each.sides) for each in populations)
    return replace(
        first,
        trace=concatenated([each.trace for each in populations]),
        log_weights=torch.cat([each.log_weights for each in populations]),
        founders=torch.cat([each.founders for each in populations]),
        # Numbers of families that are equal by chance make groups larger than they have to be.
        families=torch.cat([each.families[:, :1] for each in populations]) if halved else first.families[:0],
        sides=torch.cat([each.sides for each in populations]) if halved else first.sides[:0],
    )


def _has(trace: Trace, address: str) -> bool:
    return address in trace or address in trace.determined


def _of_each(trace: Trace, address: str) -> Tensor:
    """Values (N, *event) also of an observed address."""
    value: Tensor = trace[address]
    return value.expand(len(trace), *value.shape) if address in trace.observations else value


def _log_total(populations: Iterable[Population]) -> float:
    """Log of the sum of the weights of some populations.

    Raises:
        NoWeightError: none has any.
        NotANumberError: a weight is NaN.
    """
    populations = list(populations)
    totals = torch.tensor([each.log_total for each in populations], dtype=torch.float64)
    if not bool(torch.isfinite(totals.max())):
        together = torch.cat([each.log_weights for each in populations])
        normalised(together, [*dict.fromkeys(a for each in populations for a in each.trace.impossible())])
    return float(torch.logsumexp(totals, 0))


def _listed(structures: Iterable[Structure]) -> str:
    return ", ".join(map(str, structures))
