"""Predicted observations of candidates at outer samples, whose likelihoods are then approximated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from bcppl.distributions.lazy import LazyDistribution
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
        return sum_information([(site, self.values[a]) for a, site in self.sites.items()], shared)

    def at(self, trace: Trace) -> list[tuple[Any, Tensor]]:
        """The sites at other particles (S) of a trace, each with the outer samples' observations."""
        longer = undrawn(trace, self.args)
        return [(longer.distributions[a], value) for a, value in self.values.items()]


def sum_quadratics(sites: Sequence[tuple[Any, Tensor]]) -> tuple[Tensor, Tensor]:
    """The summed gradient (S, 6) and information (S, 6, 6) of sites' quadratic approximations."""
    quadratics = [site.quadratic(value) for site, value in sites]
    return (
        torch.stack([each.gradient for each in quadratics]).sum(dim=0),
        torch.stack([each.information for each in quadratics]).sum(dim=0),
    )


def sum_information(sites: Sequence[tuple[Any, Tensor]], shared: int) -> Tensor:
    """The summed information (S, 6 + M, 6 + M) of sites about the pose and M errors that touches share."""
    if not shared:
        return sum_quadratics(sites)[1]
    each = [
        site.joint_information(value)
        if hasattr(site, "joint_information")
        else pad(site.quadratic(value).information, (0, shared, 0, shared))
        for site, value in sites
    ]
    return torch.stack(each).sum(dim=0)


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
