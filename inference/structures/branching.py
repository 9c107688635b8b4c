"""Strata given new observations: every particle goes on in each structure that they make possible.

    strata = generate_strata(touched, (0,), {}, particles=200)
    for count, y in enumerate(readings, start=1):
        strata = extend_strata(strata, Observed((count,), {f"y_{count}": y}))
        strata = resample_strata(strata, 200, least=10)

Here each reading may be the first after a slip, `structural(f"slips_{count}", ...)`, and all before it or
none: after T readings there are T + 1 structures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.filters.step import Observed
from bcppl.inference.population import Population
from bcppl.inference.structures.generation import structures_of
from bcppl.inference.structures.strata import Strata
from bcppl.traces import Structure, extend, update
from bcppl.traces.series import SeriesTrace


def branch_strata(strata: Strata, observed: Observed) -> tuple[Strata, dict[Structure, Tensor]]:
    """The strata extended by new sites, not yet weighted by the observations, and their log-likelihoods.

    New structural sites are enumerated: every particle has a copy in each of the structures that its own may
    become, weighted by the probability of the new structural values. Nothing is drawn but latent values.

    Returns:
        The strata, and log-likelihoods (N_s,) of the new observations by structure.

    Raises:
        InputError: as for `bcppl.traces.extend`; a new structural site has no list of values; or the program
            is a series.
    """
    parts: list[tuple[Structure, Population]] = []
    log_likelihoods: dict[Structure, Tensor] = {}
    for population in strata.populations.values():
        trace = population.trace
        if isinstance(trace, SeriesTrace):
            raise InputError(
                "strata of a series cannot be extended: its trace keeps the newest step only, not the "
                "structures of earlier ones; write the program with a loop over the steps."
            )

        def visit(given: Mapping[str, Tensor], first: Population = population[:1]) -> None:
            update(first.trace, args=observed.args, observations={**observed.observations, **given})

        for new in structures_of(visit):
            given = {**observed.observations, **new.observations}
            longer, log_weight = extend(trace, observed.args, given)
            log_prior = longer.log_prob(*new) if new else torch.zeros(len(longer), dtype=torch.float64)
            whole = longer.structure
            log_weights = population.log_weights + log_prior
            parts.append((whole, replace(population, trace=longer, log_weights=log_weights)))
            # A particle whose structure is impossible has no weight, whatever it explains.
            log_likelihoods[whole] = torch.where(log_prior == -torch.inf, 0.0, log_weight - log_prior)
    return Strata.of(parts, strata.log_evidence), log_likelihoods


def extend_strata(strata: Strata, observed: Observed) -> Strata:
    """The strata given new observations: branched, and weighted by the observations' likelihood.

    New latent values are sampled from the program. The number of particles grows with that of the new
    structures: go on with `resample_strata`. The estimate of the evidence stays unbiased.

    Args:
        strata: weighted for all earlier observations.
        observed: the program's arguments, and observations at new addresses.

    Raises:
        InputError: see `branch_strata`.
        NoWeightError: no particle has any weight left.
    """
    branched, log_likelihoods = branch_strata(strata, observed)
    return branched.reweighed(log_likelihoods)
