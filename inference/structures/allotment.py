"""Resampling of strata: particles pass from structures with little weight to those with much."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from bcppl.arguments import whole_number
from bcppl.inference.population import Population
from bcppl.inference.resampling import Scheme, systematic
from bcppl.inference.structures.generation import allotted
from bcppl.inference.structures.strata import Strata


def resample_strata(
    strata: Strata, particles: int | None = None, *, least: int = 0, scheme: Scheme = systematic
) -> Strata:
    """Particles drawn from all strata by weight; the estimates stay unbiased.

    Without `least` all particles are drawn together and have equal weights; a structure of which none is
    drawn disappears. With it the numbers of particles are fixed first, in proportion to the structures'
    probabilities beyond the least number, and particles are drawn within each structure, whose weight they
    share: no structure disappears, and the draws vary less (Cochran, Sampling Techniques, 1977, section 5.5).

    Args:
        strata: of N particles.
        particles: how many are drawn; N by default.
        least: the number of particles of each structure, where there are so many for all; otherwise the
            largest number that there is.
        scheme: draws ancestors.
    """
    count = len(strata) if particles is None else whole_number("strata are resampled to {}", particles)
    least = whole_number("strata are to keep {} particles of each structure", least, least=0)
    if least == 0:
        return _together(strata, count, scheme)
    shares = list(strata.shares.values())
    if count < len(shares):
        return _together(strata, count, scheme)
    counts = allotted(shares, count, min(least, count // len(shares)))
    parts = [
        (structure, _drawn(each, scheme(each.log_weights, mine), each.log_total - math.log(mine)))
        for (structure, each), mine in zip(strata.populations.items(), counts, strict=True)
    ]
    return Strata.of(parts, strata.log_evidence)


def _together(strata: Strata, count: int, scheme: Scheme) -> Strata:
    ancestors, parts, start = scheme(strata.log_weights, count), [], 0
    for structure, each in strata.populations.items():
        mine = ancestors[(start <= ancestors) & (ancestors < start + len(each))] - start
        start += len(each)
        if len(mine):
            parts.append((structure, _drawn(each, mine, 0.0)))
    return Strata.of(parts, strata.log_evidence)


def _drawn(population: Population, ancestors: torch.Tensor, log_weight: float) -> Population:
    drawn = population.selected(ancestors)
    return replace(drawn, log_weights=torch.full_like(drawn.log_weights, log_weight))
