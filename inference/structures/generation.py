"""Strata of a program: particles of each of its structures, enumerated or drawn.

    strata = generate_strata(mixture, (x,), {"y": y}, particles=3000)
    print(probabilities(strata, "count"), strata.log_evidence)

A program is run until it visits a structural site (`bcppl.traces.structural`) that has no value, and again
with each value that the site may have: structures are the leaves of that tree. Any number of particles of
each structure gives an unbiased estimate of the evidence, as in stratified sampling with any allotment
(Cochran, Sampling Techniques, 1977, section 5.3); GenParticleFilters.jl's `pf_initialize` with strata.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.structures.strata import Strata
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Series, Structure, Trace, generate
from bcppl.traces.run import Program
from bcppl.traces.series import runnable
from bcppl.traces.structural import UnchosenError
from bcppl.traces.verbs import constrained

MOST = 10_000  # structures that are enumerated


def generate_strata(
    program: Program | Series,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    particles: int,
    *,
    shares: Callable[[Structure], float] | None = None,
) -> Strata:
    """Particles of every structure of a program, weighted by the observations and the structures' priors.

    Args:
        program: a Pyro program with structural sites, each with finitely many values.
        args: its arguments.
        observations: values by address, as for `bcppl.traces.generate`; of a structural site too, which then
            has that value only.
        particles: N, of all structures together.
        shares: how many particles a structure is given, in proportion; by default as many as any other. Each
            is given at least one.

    Raises:
        InputError: there are fewer particles than structures, or as for `generate`; a structural site has no
            list of values (use `sample_strata`).
    """
    return weighed(enumerated(program, args, observations, particles, shares))


def sample_strata(
    program: Program | Series, args: tuple[Any, ...], observations: Mapping[str, Tensor], particles: int
) -> Strata:
    """Particles of structures that are drawn from the program, also where it has infinitely many.

    Args:
        program: a Pyro program with structural sites.
        args: its arguments.
        observations: values by address, as for `bcppl.traces.generate`.
        particles: N.

    Raises:
        InputError: as for `generate`.
    """
    return weighed(drawn(program, args, observations, particles))


def weighed(strata: Strata) -> Strata:
    """Strata of a prior weighted by the likelihood of the observations."""
    traces = {s: each.trace for s, each in strata.populations.items()}
    return strata.reweighed({s: POSTERIOR.part(t, likelihood_sites(t)) for s, t in traces.items()})


def likelihood_sites(trace: Trace, earlier: Collection[str] = ()) -> list[str]:
    """The addresses, other than `earlier` ones, that are neither latent nor structural."""
    structure = trace.structure
    return [a for a in trace.addresses if a not in trace.choices and a not in structure and a not in earlier]


def enumerated(
    program: Program | Series,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    particles: int,
    shares: Callable[[Structure], float] | None = None,
) -> Strata:
    """Strata of the prior of every structure, as for `generate_strata`."""
    particles = whole_number("strata are given {} particles", particles)

    def visit(given: Mapping[str, Tensor]) -> None:
        constrained(runnable(program), args, 1, {**observations, **given}, {})

    leaves = list(structures_of(visit))
    wanted = [1.0 if shares is None else float(shares(each)) for each in leaves]
    parts = []
    for leaf, count in zip(leaves, allotted(wanted, particles, least=1), strict=True):
        trace, _ = generate(program, args, {**observations, **leaf.observations}, count)
        log_prior = POSTERIOR.part(trace, list(trace.structure))
        # The sum over a stratum estimates the evidence of its structure, however many particles it has.
        parts.append((trace, log_prior + math.log(particles / count)))
    return _strata(parts, particles)


def drawn(
    program: Program | Series, args: tuple[Any, ...], observations: Mapping[str, Tensor], particles: int
) -> Strata:
    """Strata of the prior, their structures drawn from it as for `sample_strata`."""
    parts: list[tuple[Trace, Tensor]] = []

    def branch(structure: Structure, choices: Mapping[str, Tensor], count: int) -> None:
        given = {**observations, **structure.observations}
        try:
            trace, _ = generate(program, args, given, count, choices)
        except UnchosenError as unchosen:
            values = unchosen.distribution.sample()
            for value in values.unique().tolist():
                mine = (values == value).nonzero().flatten()
                earlier = {a: v[mine] for a, v in unchosen.values.items() if a not in given}
                branch(structure.with_values({unchosen.address: value}), earlier, len(mine))
            return
        # What was drawn has weight 1; a structural site that the caller observes counts.
        observed = [a for a in trace.structure if a not in structure]
        parts.append((trace, POSTERIOR.part(trace, observed).clone()))

    particles = whole_number("strata are given {} particles", particles)
    branch(Structure({}), {}, particles)
    return _strata(parts, particles)


def structures_of(visit: Callable[[Mapping[str, Tensor]], None]) -> Iterator[Structure]:
    """The values of the structural sites to which a program is given no value, one structure after another.

    Args:
        visit: runs the program with values of structural sites by address; no site need be evaluated.

    Raises:
        InputError: a site has no list of values, or there are more than ten thousand structures.
    """
    pending, leaves = [Structure({})], 0
    while pending:
        structure = pending.pop()
        try:
            visit(structure.observations)
        except UnchosenError as unchosen:
            values = _values(unchosen)
            pending += [structure.with_values({unchosen.address: v}) for v in reversed(values)]
            continue
        leaves += 1
        if leaves > MOST:
            raise InputError(
                f"a program has more than {MOST} structures; draw them from the program (`sample_strata`)."
            )
        yield structure


def _values(unchosen: UnchosenError) -> list[int]:
    # Also those that are impossible here: a site may depend on latent values, of which other particles have
    # others. Where no particle makes one possible, its stratum has no weight.
    site = unchosen.distribution
    if not site.has_enumerate_support:
        raise InputError(
            f"structural site {unchosen.address!r} has no finite list of values, so its structures cannot be "
            "enumerated; draw them from the program (`sample_strata`)."
        )
    return [int(v) for v in site.enumerate_support(expand=False).reshape(-1).tolist()]


def allotted(wanted: Sequence[float], count: int, least: int = 0) -> list[int]:
    """Whole numbers that sum to `count`, each at least `least`, the rest in proportion to `wanted`.

    The largest remainders are rounded up.

    Raises:
        InputError: the count is too small, or `wanted` are no numbers from 0 up, not all of them 0.
    """
    if len(wanted) * least > count:
        raise InputError(
            f"{count} particles are to be shared by {len(wanted)} structures, at least {least} each; give "
            "more particles."
        )
    total = sum(wanted)
    if not 0.0 < total < math.inf or min(wanted) < 0.0:
        raise InputError(
            f"particles are to be shared in proportion to {list(wanted)}; give numbers, 0 or more."
        )
    rest = count - least * len(wanted)
    exact = [rest * each / total for each in wanted]
    counts = [int(each) for each in exact]
    by_remainder = sorted(range(len(wanted)), key=lambda k: counts[k] - exact[k])
    for k in by_remainder[: rest - sum(counts)]:
        counts[k] += 1
    return [least + each for each in counts]


def _strata(parts: Sequence[tuple[Trace, Tensor]], particles: int) -> Strata:
    """Strata of traces and their log weights, whose sum over all particles estimates `particles` times Z."""
    populations, founded = [], 0
    for trace, log_weights in parts:
        founders = torch.arange(founded, founded + len(trace))
        # Strata are no independent draws: the variance of the evidence is not known from the founders.
        population = Population(trace, log_weights, founders=founders, log_pairs=math.inf)
        populations.append((trace.structure, population))
        founded += len(trace)
    total = torch.logsumexp(torch.cat([log_weights for _, log_weights in parts]), 0)
    return Strata.of(populations, float(total) - math.log(particles))
