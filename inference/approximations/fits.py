"""The pose of a part given what is fitted to the images of several instruments."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.pose_normals import (
    GaussianMixture,
    PoseFactor,
    log_overlap,
    moments_within,
    normal_like,
    product_of_factors,
    truncated,
    widened_mixture,
)
from bcppl.inference.approximations.laplace import QuadraticApproximation

_MODES, _FAINT = 8, 10.0  # that views leave: at most so many, within so many nats of the most probable


@dataclass(frozen=True, eq=False)
class ViewpointFit:
    """The action of a viewpoint's first measurement, and the Gaussian fitted to that."""

    action: Any
    fit: Any


def by_instrument(scene: Any, fits: Sequence[ViewpointFit]) -> list[list[int]]:
    """The places of each instrument's own among the fits."""
    groups: dict[str, list[int]] = {}
    for k, each in enumerate(fits):
        groups.setdefault(scene.sensor(each.action).instrument(each.action), []).append(k)
    return list(groups.values())


def given_fits(scene: Any, fits: Sequence[ViewpointFit]) -> GaussianMixture:
    """The part's pose given the fits, the nuisance parameters integrated out; the prior where there is none.

    It has one component for each combination of the instruments' own, as far as they agree.
    """
    prior = scene.prior
    if not fits:
        normal = normal_like(prior)
        alone = torch.zeros(1, dtype=torch.float64)
        return GaussianMixture(normal.center[None], normal.covariance[None], alone)
    each = torch.cartesian_prod(*(torch.arange(len(f.fit.log_weights)) for f in fits)).reshape(-1, len(fits))
    chosen = [f.fit.chosen(index) for f, index in zip(fits, each.T, strict=True)]
    factors = []
    for own in by_instrument(scene, fits):
        actions, sensor = [fits[k].action for k in own], scene.sensor(fits[own[0]].action)
        factors.append(sensor.marginal_factor(actions, [chosen[k] for k in own]))
    normal = product_of_factors(prior, factors)
    log_weights = torch.stack([fit.log_weights for fit in chosen]).sum(dim=0)
    kept = torch.zeros(1, dtype=torch.int64)
    if len(each) > 1:
        log_weights = log_weights + log_overlap(normal, factors)
        order = log_weights.argsort(descending=True)[:_MODES]
        kept = order[log_weights[order] > log_weights[order[0]] - _FAINT]
    whole = moments_within(prior, normal)
    return GaussianMixture(whole.center[kept], whole.covariance[kept], log_weights[kept].log_softmax(dim=0))


def conditional(
    scene: Any,
    fits: Sequence[ViewpointFit],
    contacts: QuadraticApproximation | None,
    trace: Any,
    values: Mapping[str, Tensor],
) -> Any:
    """The distribution of the pose given each particle's nuisance parameters: see `GaussianApproximation`."""
    looked_up: Any = ChainMap(dict(values), trace)
    factors: list[PoseFactor] = [
        scene.sensor(fits[own[0]].action).factor([fits[k].action for k in own], looked_up)
        for own in by_instrument(scene, fits)
    ]
    prior = scene.prior
    given = product_of_factors(prior, factors) if factors else None
    if contacts is None:
        return prior if given is None else truncated(prior, given)
    if given is None:
        expected = normal_like(prior)
        center = expected.center.expand(trace.particles, 7)
        precision = torch.linalg.inv(expected.covariance).expand(trace.particles, 6, 6)
    else:
        given = moments_within(prior, given)
        center, precision = given.center, torch.linalg.inv(given.covariance)
    return widened_mixture(contacts.posterior(center, precision))
