"""A population: a trace with its log weights, what SMC passes from step to step."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field, fields
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn, overload

import torch
from torch import Tensor

from bcppl.arguments import address_list, latent_address
from bcppl.beliefs import Belief, normalised
from bcppl.beliefs.belief import ApparentPose, SeesPart
from bcppl.cached import cached_property
from bcppl.devices import HOST, to_device
from bcppl.distributions.support import refuse_several_poses
from bcppl.errors import InferenceError, InputError, OtherKindError
from bcppl.inference.ancestry import inherited
from bcppl.poses import FREE
from bcppl.traces import Trace
from bcppl.traces.indexing import Index, particles_at
from bcppl.traces.verbs import trace_to_device

EQUAL = torch.empty(0, dtype=torch.float64)  # in place of log weights: all are equal


@dataclass(frozen=True, eq=False)
class Population:
    """Weighted particles.

    `population["x"]` is a value (N, *event) of the trace, `population[index]` the particles at an index, with
    their weights.

    Raises:
        InputError: the log weights are not N numbers below +inf.

    Attributes:
        trace: of N particles.
        log_weights: (N,) unnormalised, float64 (made so, if they are of another type); -inf is no weight. By
            default all are equal.
        log_evidence: log of the estimated evidence of all measurements so far; by default the log of the mean
            weight, which is right for what `generate` returns.
        founders: (N,) int64, the particle of the first population that each descends from; by default
            its own. What `bcppl.inference.summaries` reads.
        log_pairs: sum over the first population and every resampling since of log M / (M - 1), M the
            particles that were then drawn independently of one another.
        families: (N, G) int64, the ancestor of each particle at G resamplings, the oldest first, since the
            population was split into halves (`bcppl.inference.ancestry`); empty before.
        sides: (N,) bool, the half to which each particle's oldest family belongs; empty before.
        approximation: the filter's approximation of the posterior, an immutable value that guides proposals
            and that the target never depends on (`bcppl.inference.approximations`); None where there is none.
    """

    trace: Trace
    log_weights: Tensor = EQUAL
    log_evidence: float = math.nan
    founders: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int64), repr=False)
    log_pairs: float = math.nan
    families: Tensor = field(default_factory=lambda: torch.empty(0, 1, dtype=torch.int64), repr=False)
    sides: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.bool), repr=False)
    approximation: Any = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.log_weights is EQUAL:
            object.__setattr__(self, "log_weights", torch.zeros(self.trace.particles, dtype=torch.float64))
        object.__setattr__(self, "log_weights", _checked(self.trace, self.log_weights))
        if math.isnan(self.log_evidence):
            object.__setattr__(self, "log_evidence", _log_mean(self.log_weights))
        if len(self.founders) == 0:
            object.__setattr__(self, "founders", torch.arange(len(self.log_weights)))
        if math.isnan(self.log_pairs):
            object.__setattr__(self, "log_pairs", log_pair(len(self.log_weights)))

    def __len__(self) -> int:
        return self.trace.particles

    @cached_property
    def effective_sample_size(self) -> float:
        """1 / sum of squared normalised weights (Kong, Liu and Wong, JASA 89, 1994).

        Raises:
            NoWeightError: no particle has any weight.
            NotANumberError: a weight is NaN or +inf.
        """
        if not math.isfinite(self.log_total):
            normalised(self.log_weights, self.trace.impossible())
        return float(1.0 / torch.softmax(self.log_weights, 0).square_().sum())

    @cached_property
    def distinct(self) -> int:
        """How many particles with weight differ in some latent value; 1 of a program without any."""
        return self.distinct_in(self.trace.choices)

    def distinct_in(self, addresses: str | Collection[str]) -> int:
        """The same of one or some latent addresses."""
        asked = address_list(addresses)
        alive = self.log_weights > -torch.inf
        count = int(alive.sum())
        values = [value for address, value in self.trace.choices.items() if address in asked]
        columns = [value[alive].reshape(count, value[0].numel()).double() for value in values]
        columns = [column for column in columns if column.shape[1]]
        # Where one number tells all apart, as a continuous one does unless particles are copies: rows take
        # ten times as long to sort.
        if any(len(torch.unique(column[:, 0])) == count for column in columns):
            return count
        return len(torch.unique(torch.cat(columns, dim=1), dim=0)) if columns else min(count, 1)

    @cached_property
    def log_total(self) -> float:
        """Log of the sum of the weights."""
        # By the operations of `reweighed`, so that a resumed run has the same bits.
        highest = float(self.log_weights.max())
        if not math.isfinite(highest):
            return highest
        return highest + math.log(float((self.log_weights - highest).exp_().sum()))

    def with_trace(self, trace: Trace) -> Population:
        """The same weights for another trace of as many particles: extended, or moved."""
        if trace.particles != len(self):
            raise InputError(
                f"a population of {len(self)} particles is given a trace of {trace.particles}; "
                "give one of as many."
            )
        later = self._with(trace=trace)
        for computed in ("log_total", "effective_sample_size"):
            if computed in self.__dict__:
                later.__dict__[computed] = self.__dict__[computed]
        return later

    def on(self, device: torch.device) -> Population:
        """The same particles on a device; their approximation is on the host wherever they are."""
        own = {name: self.__dict__[name] for name in ("log_weights", "founders", "families", "sides")}
        if self.log_weights.device == device:
            return self
        return self._with(trace=trace_to_device(self.trace, device), **to_device(own, device))

    def with_approximation(self, approximation: Any) -> Population:
        """The same particles with another approximation of their posterior."""
        later = self.with_trace(self.trace)
        later.__dict__["approximation"] = approximation
        return later

    def reweighed(self, log_factor: Tensor) -> Population:
        """Every weight times exp(log_factor) (N,), and the evidence times the weighted mean of the factors.

        The evidence's factor is a difference of two logsumexps, so it is right whether or not the
        population was resampled before.

        Raises:
            NoWeightError: no particle has any weight left.
            NotANumberError: a weight is NaN or +inf.
        """
        log_weights = self.log_weights + log_factor
        highest = float(log_weights.max())
        if math.isnan(highest):
            # A particle without weight stays without, whatever has become possible with it.
            log_weights = torch.where(self.log_weights == -torch.inf, -torch.inf, log_weights)
            highest = float(log_weights.max())
        if not math.isfinite(highest):
            normalised(log_weights, self.trace.impossible())
        # One exponential serves the evidence and the effective sample size: it is what a step costs.
        weights = (log_weights - highest).exp_()
        mass = float(weights.sum())
        total = highest + math.log(mass)
        later = self._with(log_weights=log_weights, log_evidence=self.log_evidence + (total - self.log_total))
        later.__dict__["log_total"] = total
        later.__dict__["effective_sample_size"] = mass * mass / float(weights.dot(weights))
        return later

    def selected(self, ancestors: Tensor) -> Population:
        """The particles at `ancestors` (M,), equally weighted.

        Raises:
            InputError: an ancestor is no particle.
        """
        try:
            founders = self.founders.index_select(0, ancestors)
        except (IndexError, RuntimeError, TypeError):
            return self.selected(self._numbered(ancestors))
        count = len(ancestors)
        if count == 0:
            raise InputError("a population is to go on with no particle; give the ancestors of 1 or more.")
        drawn = self._with(
            trace=self.trace.chosen(ancestors),
            log_weights=torch.zeros(count, dtype=torch.float64),
            founders=founders,
            log_pairs=self.log_pairs + log_pair(count),
            **(inherited(ancestors, **self._split()) if len(self.sides) else {}),
        )
        drawn.__dict__["log_total"] = math.log(count)
        return drawn

    def _numbered(self, ancestors: Tensor) -> Tensor:
        try:
            return particles_at(ancestors, len(self))
        except (IndexError, TypeError) as error:
            raise InputError(
                f"a population is to go on with ancestors that are no particles ({error}); give numbers from "
                f"0 to {len(self) - 1}."
            ) from error

    @overload
    def __getitem__(self, index: str) -> Tensor: ...

    @overload
    def __getitem__(self, index: Index) -> Population: ...

    def __getitem__(self, index: str | Index) -> Any:
        if isinstance(index, str):
            return self.trace[index]
        particles = particles_at(index, len(self))
        return self._with(
            trace=self.trace.chosen(particles),
            log_weights=self.log_weights[particles],
            founders=self.founders[particles],
            **{name: of[particles] for name, of in self._split().items()},
        )

    def _split(self) -> dict[str, Tensor]:
        """Families and sides, once the population was split into halves."""
        return {"families": self.families, "sides": self.sides} if len(self.sides) else {}

    def _with(self, **changed: Any) -> Population:
        """The same population with other fields, which are known to be right: a step makes several."""
        other = object.__new__(type(self))
        other.__dict__.update({name: self.__dict__[name] for name in FIELDS}, **changed)
        return other

    def belief(self, address: str) -> Belief:
        """The particles read as a posterior over the pose at an address.

        Raises:
            InputError: no latent site has that address, or no pose is there.
        """
        latent_address("a belief over {} was asked for", address, self.trace.choices)
        poses, freedom = self.trace[address], self.trace.support(address).freedom
        refuse_several_poses(address, poses, freedom)
        if poses.shape != (len(self), 7):
            raise InputError(
                f"a belief over {address!r} was asked for, which is no pose: its values have shape "
                f"{tuple(poses.shape[1:])}; use bcppl.inference.summaries."
            )
        # What people read is on the host, wherever the particles are.
        poses, log_weights = to_device((poses, self.log_weights), HOST)
        return Belief(poses, log_weights, freedom or FREE, self.apparent_pose(address))

    def apparent_pose(self, address: str) -> ApparentPose | None:
        """The pose at an address as seen from a held peg; None where its measured pose is its true one."""
        touched = self._touched(self.trace[address])
        return None if touched is None else partial(touched[0].apparent_poses, touched[1])

    def shared_errors(self, address: str) -> tuple[Tensor, Tensor] | None:
        """Errors that all touches share, given each particle's pose at an address and what was observed.

        Returns:
            Mean (N, M) and covariance (N, M, M), in prior standard deviations; None where no touch was
            observed, or touches share none.
        """
        touched = self._touched(self.trace[address])
        return None if touched is None else touched[0].shared_posterior(touched[1])

    def _touched(self, poses: Tensor) -> tuple[SeesPart, Tensor] | None:
        """The last of the observed sites that know the part as seen from a held peg, and its value."""
        for address in reversed(list(self.trace.observations)):
            site = self.trace.distributions[address]
            if isinstance(site, SeesPart) and site.is_displaced and torch.equal(site.pose, poses):
                return site, self.trace[address]
        return None

    if not TYPE_CHECKING:  # the type checker would take any attribute to be there

        def __getattr__(self, name: str) -> NoReturn:
            if name in ("populations", "shares", "structures"):
                raise OtherKindError(
                    "one population is given where strata are wanted; make these with generate_strata of "
                    "bcppl.inference.structures."
                )
            raise AttributeError(f"Population has no attribute {name!r}")

    def __repr__(self) -> str:
        try:
            size = f"{self.effective_sample_size:.1f}"
        except InferenceError:
            size = "none"
        copies = f"{self.distinct} distinct, " if self.distinct < len(self) else ""
        return (
            f"Population({len(self)} particles, {copies}effective sample size {size}, "
            f"log evidence {self.log_evidence:.4f}, latent: {', '.join(self.trace.choices) or 'none'}, "
            f"observed: {', '.join(self.trace.observations) or 'none'})"
        )


FIELDS = tuple(each.name for each in fields(Population))


def _checked(trace: Trace, log_weights: Tensor) -> Tensor:
    """Log weights (N,) float64, such that only -inf is not finite."""
    if tuple(log_weights.shape) != (trace.particles,) or log_weights.is_complex():
        raise InputError(
            f"a population of {trace.particles} particles is given log weights of shape "
            f"{tuple(log_weights.shape)} and {log_weights.dtype}; give one real number for each."
        )
    log_weights = log_weights.to(torch.float64)
    # The maximum is NaN where any is.
    if not float(log_weights.max()) < math.inf:
        which = (~(log_weights < math.inf)).nonzero().flatten().tolist()
        raise InputError(
            f"a population is given the log weight {float(log_weights[which[0]])} for {len(which)} of "
            f"{len(log_weights)} particles (first: {', '.join(map(str, which[:5]))}); "
            "give numbers, -inf for a particle without weight."
        )
    return log_weights


def log_pair(count: int) -> float:
    """Log of count / (count - 1): of all pairs over those of two different particles; 0 for one particle."""
    return math.log(count / (count - 1)) if count > 1 else 0.0


def _log_mean(log_weights: Tensor) -> float:
    """Log of the mean weight; 0 to the bit for weights of 1."""
    highest = float(log_weights.max())
    if not math.isfinite(highest):
        return highest
    return highest + float(torch.log(torch.exp(log_weights - highest).mean()))


def refuse_no_population(where: str, given: Any) -> None:
    """Refuse what is no population."""
    if isinstance(given, Population):
        return
    hint = "make it one, Population(trace, log_weights)"
    if isinstance(given, tuple):
        hint = "make it one, Population(*...)"
    elif isinstance(given, Trace):
        hint += ", or use a verb of bcppl.traces"
    elif hasattr(given, "populations"):
        hint = "choose one of its populations, or use bcppl.inference.structures"
    raise InputError(f"{where} is given a {type(given).__name__} in place of a population; {hint}.")
