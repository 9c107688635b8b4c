"""Importance sampling, plain, tempered or stratified: the first step of SMC, or an estimate by itself.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling, tempered, tempered_importance_sampling
    from bcppl.inference.kernels import metropolis_hastings
    from bcppl.inference.proposals import drift

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.01))

    population = importance_sampling(weighed, (), {"reading": 2.4}, 1000)
    step = tempered(metropolis_hastings(drift("mass")))
    moved = tempered_importance_sampling(weighed, (), {"reading": 2.4}, 1000, step).population
    print(population.effective_sample_size, moved.effective_sample_size)

Robert and Casella, Monte Carlo Statistical Methods, 2004, section 3.3; strata: Cochran, Sampling Techniques,
1977, chapter 5, as in GenParticleFilters.jl's `pf_initialize`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.filters.step import Stepped
from bcppl.inference.filters.tempering import Tempered
from bcppl.inference.population import Population
from bcppl.traces import Program, Series, Trace, generate, propose
from bcppl.traces.values import Value

GIVE_STRATA = "give strata as a function that maps a value to its stratum."


def importance_sampling(
    program: Program | Series,
    args: tuple[Any, ...],
    observations: Mapping[str, Value],
    particles: int,
    proposal: Program | None = None,
) -> Population:
    """Weighted particles from a program with observations; the estimate of the evidence is unbiased.

    Args:
        program: a Pyro program.
        args: its arguments.
        observations: values by address, of the shape of the sites' events.
        particles: N.
        proposal: a Pyro program `proposal(*args)` that samples values at latent addresses of `program`, with
            heavier tails than the posterior; other addresses are drawn from `program`. By default all are.

    Raises:
        InputError: an observed or proposed address is never visited, or the proposal samples no address or
            an observed one.
    """
    if proposal is None:
        return Population(*generate(program, args, observations, particles))
    proposed = propose(proposal, args, particles)
    if not proposed.choices:
        raise InputError("a proposal for importance sampling samples no address; give none.")
    trace, log_weights = generate(program, args, observations, particles, proposed.choices)
    return Population(trace, log_weights - proposed.log_prob)


def tempered_importance_sampling(
    program: Program | Series,
    args: tuple[Any, ...],
    observations: Mapping[str, Value],
    particles: int,
    step: Tempered,
) -> Stepped:
    """Weighted particles of the posterior, by tempering the likelihood of all observations together.

    The SMC sampler of Del Moral, Doucet and Jasra, JRSS B 68, 2006, section 3.3.2. For sequential data, start
    with `importance_sampling` and continue with `bcppl.inference.filters.step.steps`.

    Args:
        program: a Pyro program.
        args: its arguments.
        observations: values by address, of the shape of the sites' plates and events.
        particles: N.
        step: `tempered(kernel)`; it also tempers what the program itself conditions on (`obs=`,
            `pyro.factor`).

    Returns:
        The population, with the evidence of all observations, and a record of the steps.

    Raises:
        InputError: an observed address is never visited, or the step does not temper.
        InferenceError: no particle is left with any weight.
    """
    if not isinstance(step, Tempered):
        name = getattr(step, "__name__", type(step).__name__)
        raise InputError(f"{name} is given in place of a step that tempers; give tempered(kernel).")
    trace, _ = generate(program, args, observations, particles)
    return step.temper(Population(trace), [a for a in trace.addresses if a not in trace.choices])


def generate_stratified(
    program: Program | Series,
    args: tuple[Any, ...],
    observations: Mapping[str, Value],
    particles: int,
    strata: int | Callable[[Tensor], Tensor] | None = None,
    *,
    candidates: int = 10,
) -> Population:
    """Generate, with the first latent choice of the program drawn by stratum.

    A discrete choice takes each of its values with equally many particles, weighted by the value's
    probability. A real one with an inverse distribution function is drawn within `strata` intervals of equal
    probability. For any other, such as a pose, `strata` maps a value to its stratum; then `candidates` times
    as many particles are drawn from the program, and equally many are kept from each stratum, weighted by its
    share of the candidates. The estimate of the evidence is unbiased in all three.

    Args:
        program: a Pyro program.
        args: its arguments.
        observations: values by address, as for `generate`.
        particles: N.
        strata: the number of intervals of a real choice, by default N; or a function of values (M, *event)
            that returns the number of each one's stratum, (M,) int64.
        candidates: the number for each particle, where `strata` is a function.

    Returns:
        The population. The variance of its evidence cannot be estimated from its founders.

    Raises:
        InputError: a count is no whole number, 1 or more, there is no latent choice, a number of strata is
            given for a discrete one, a function gives another shape than (M,), there are fewer particles than
            strata, or no inverse distribution function and no function given.
    """
    candidates = whole_number("generate_stratified is given {} candidates for each particle", candidates)
    if strata is not None and not callable(strata):
        strata = whole_number("generate_stratified is given {} strata", strata)
    trace, _ = generate(program, args, observations, particles)
    if not trace.choices:
        raise InputError("a program without latent choice cannot be stratified; use generate.")
    address = next(a for a in trace.addresses if a in trace.choices)
    if callable(strata):
        wide = generate(program, args, observations, particles * candidates)
        stratum: Any = strata(wide[0][address])
        if not isinstance(stratum, Tensor) or stratum.shape != (len(wide[0]),):
            given = tuple(stratum.shape) if isinstance(stratum, Tensor) else type(stratum).__name__
            raise InputError(
                f"strata gives {given} for {len(wide[0])} values of {address!r}; give a tensor with the "
                "number of each one's stratum."
            )
        return _selected(*wide, stratum, particles)

    def started(values: Tensor) -> tuple[Trace, Tensor]:
        return generate(program, args, observations, particles, {address: values})

    if trace.distributions[address].has_enumerate_support:
        if strata is not None:
            raise InputError(
                f"generate_stratified is given {strata} strata, and the first latent choice {address!r} is "
                "discrete: each of its values is one; leave strata out."
            )
        return _enumerated(started, trace, address)
    return _by_quantile(started, trace, address, particles if strata is None else strata)


# The trace whose first latent choice has values (N, *event), and its log weights (N,).
Started = Callable[[Tensor], tuple[Trace, Tensor]]


def _population(trace: Trace, log_weights: Tensor) -> Population:
    return Population(trace, log_weights, log_pairs=math.inf)


def _refuse_more(strata: int, particles: int) -> None:
    if not 0 < strata <= particles:
        raise InputError(
            f"{particles} particles cannot represent {strata} strata; give at least one for each stratum."
        )


def _enumerated(start: Started, trace: Trace, address: str) -> Population:
    site, particles = trace.distributions[address], trace.particles
    if len(site.batch_shape) > 1:
        raise InputError(f"the first latent choice {address!r} is in a plate; {GIVE_STRATA}")
    values = site.enumerate_support(expand=False)
    values = values.reshape(len(values), *site.event_shape)
    _refuse_more(len(values), particles)
    stratum = torch.arange(particles) % len(values)
    started, log_weights = start(values[stratum].to(trace[address]))
    share = torch.bincount(stratum).to(torch.float64) / particles
    return _population(started, log_weights - share.log()[stratum])


def _by_quantile(start: Started, trace: Trace, address: str, strata: int) -> Population:
    site, particles = trace.distributions[address], trace.particles
    _refuse_more(strata, particles)
    # Where the strata do not divide N, random ones get one more: each draw is then the program's own.
    stratum = (torch.arange(particles) + int(torch.randint(strata, ()))) % strata
    quantile = (stratum + torch.rand(particles, dtype=torch.float64)) / strata
    try:
        if site.event_shape or len(site.batch_shape) > 1:
            raise NotImplementedError
        chosen = site.icdf(quantile).to(trace[address])
    except NotImplementedError:
        what = f"the first latent choice {address!r} has no inverse distribution function"
        raise InputError(f"{what}; {GIVE_STRATA}") from None
    started, log_weights = start(chosen)
    # Each value is a draw of the program; only jointly are they more even than independent draws.
    return _population(started, log_weights - started.log_prob(address))


def _selected(trace: Trace, log_weights: Tensor, stratum: Tensor, particles: int) -> Population:
    _, stratum, counts = torch.unique(stratum, return_inverse=True, return_counts=True)
    _refuse_more(len(counts), particles)
    wanted = torch.full_like(counts, particles // len(counts))
    wanted[: particles % len(counts)] += 1
    # Candidates are exchangeable within a stratum, so the first of each are as good as any. A stratum with
    # fewer than are wanted repeats some of them, each with its share of the weight.
    kept, log_factors = [], []
    for number, (count, want) in enumerate(zip(counts.tolist(), wanted.tolist(), strict=True)):
        members = (stratum == number).nonzero().flatten()
        kept.append(members[torch.arange(want) % count])
        each = torch.bincount(torch.arange(want) % count).to(torch.float64)
        weight = count / len(stratum) * particles / min(count, want) / each
        log_factors.append(weight.log()[torch.arange(want) % count])
    index = torch.cat(kept)
    return _population(trace[index], log_weights[index] + torch.cat(log_factors))
