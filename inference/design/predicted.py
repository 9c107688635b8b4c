"""Predicted observations of candidates at outer samples, whose likelihoods are then approximated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.manifold import Quadratic
from bcppl.errors import InputError
from bcppl.inference.design.observations import Arguments, observed_addresses
from bcppl.inference.resampling import seeded
from bcppl.traces import Trace
from bcppl.traces.update import undrawn

# The information (S, 6, 6) that a candidate adds about the pose at particles of a trace; None to take it from
# the quadratic approximations of the candidate's sites.
Information = Callable[[Any, Trace], Tensor | None]


@dataclass(frozen=True, eq=False)
class PredictedObservations:
    """A candidate's predicted observations at S outer samples."""

    args: tuple[Any, ...]  # the program's arguments once it is measured
    known: Tensor | None = None  # (S, 6, 6) its information; None to take it from the sites
    # those that would be observed, at the outer samples, by address
    sites: Mapping[str, Any] = field(default_factory=dict)
    # (S, *event) a sample of each, one for each outer sample
    values: dict[str, Tensor] = field(default_factory=dict)

    def information(self, shared: int = 0) -> Tensor:
        """(S, 6 + M, 6 + M) at the outer samples, about the pose and M errors that touches share."""
        if self.known is not None:
            return pad(self.known, (0, shared, 0, shared))
        sites = [(site, self.values[a]) for a, site in self.sites.items()]
        none = torch.zeros(len(sites[0][1]), shared, dtype=torch.float64)
        return sum_quadratics(sites, none).information

    def with_shared_errors(self, errors: Tensor) -> PredictedObservations:
        """The observations as they are measured under errors (S, M) that touches share."""
        if not errors.shape[-1]:
            return self
        values = {
            a: site.with_shared_errors(self.values[a], errors)
            for a, site in self.sites.items()
            if hasattr(site, "with_shared_errors")
        }
        return replace(self, values=self.values | values)

    def at(self, trace: Trace) -> list[tuple[Any, Tensor]]:
        """The sites at other particles (S) of a trace, each with the outer samples' observations."""
        longer = undrawn(trace, self.args)
        return [(longer.distributions[a], value) for a, value in self.values.items()]


def sum_log_probs(sites: Sequence[tuple[Any, Tensor]], errors: Tensor) -> Tensor:
    """The summed log-likelihood (S,) of sites, at errors (S, M) that touches share."""
    joint = errors.shape[-1] > 0
    each = [
        site.joint_log_prob(value, errors)
        if joint and hasattr(site, "joint_log_prob")
        else site.log_prob(value)
        for site, value in sites
    ]
    return torch.stack(each).sum(dim=0)


def sum_quadratics(sites: Sequence[tuple[Any, Tensor]], errors: Tensor) -> Quadratic:
    """Sites' quadratic approximations, summed, about pose and errors: (S, 6 + M) and (S, 6 + M, 6 + M)."""
    shared, each = errors.shape[-1], []
    for site, value in sites:
        if shared and hasattr(site, "joint_quadratic"):
            each.append(site.joint_quadratic(value, errors))
        else:
            gradient, information = site.quadratic(value)
            each.append(Quadratic(pad(gradient, (0, shared)), pad(information, (0, shared, 0, shared))))
    return Quadratic(*(torch.stack(parts).sum(dim=0) for parts in zip(*each, strict=True)))


def predict_observations(
    trace: Trace,
    candidates: Sequence[Any],
    arguments: Arguments,
    information: Information | None,
    seed: int,
) -> list[PredictedObservations]:
    """Each candidate's predicted observations at a trace's particles; alike sites are drawn in a batch."""
    predicted: list[PredictedObservations] = []
    for k, candidate in enumerate(candidates):
        args = arguments(candidate)
        known = None if information is None else information(candidate, trace)
        if known is not None:
            predicted.append(PredictedObservations(args, _checked(k, known, trace.particles)))
            continue
        with seeded(seed):
            longer = undrawn(trace, args)
        added = observed_addresses(k, longer, trace)
        sites = {a: longer.distributions[a] for a in added}
        for address, site in sites.items():
            if not hasattr(site, "quadratic"):
                raise InputError(
                    f"candidate {k} is observed at {address!r}, whose {type(site).__name__} has no "
                    "`quadratic`; give `information` for it, or use expected_information_gain."
                )
        predicted.append(PredictedObservations(args, None, sites, {a: longer[a] for a in added}))
    _draw(predicted, seed)
    return predicted


def _draw(predicted: Sequence[PredictedObservations], seed: int) -> None:
    """Draw at the lazy sites: those of one type that can be simulated together in one batch."""
    batches: dict[type, list[tuple[PredictedObservations, str, Any]]] = {}
    for each in predicted:
        for address, site in each.sites.items():
            if hasattr(type(site), "samples"):
                batches.setdefault(type(site), []).append((each, address, site))
            elif isinstance(site, LazyDistribution):
                with seeded(seed):
                    each.values[address] = site.sample()
    for kind, batch in batches.items():
        with seeded(seed):
            samples = kind.samples([site for *_, site in batch])  # type: ignore[attr-defined]
        for (each, address, _), value in zip(batch, samples, strict=True):
            each.values[address] = value


def _checked(number: int, information: Tensor, count: int) -> Tensor:
    """The information (S, 6, 6) that is given for a candidate."""
    known = torch.as_tensor(information, dtype=torch.float64).expand(count, 6, 6)
    finite = known[torch.isfinite(known).all(dim=2).all(dim=1)]
    if len(finite):
        # Below one to the square metre or radian the sign is rounding.
        scale = finite.diagonal(dim1=1, dim2=2).abs().clamp(min=1.0).sqrt()
        unitless = finite / (scale[:, :, None] * scale[:, None, :])
        symmetric = bool((unitless - unitless.mT).abs().max() < 1e-3)
        if not (symmetric and float(torch.linalg.eigvalsh(unitless).min()) > -0.1):
            raise InputError(
                f"the information of candidate {number} has matrices that are not symmetric or are negative; "
                "check the sign."
            )
    return known
