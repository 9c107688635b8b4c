"""Whether densities are numbers, supports are those of the densities, and draws follow the densities.

Draws and a density p of one site are compared by the identity of bridge sampling (Meng and Wong, Statistica
Sinica 6, 1996, equation 2.3): for any density q and any function g,
E_p[g q / (p + q)] = E_q[g p / (p + q)]. Both integrands lie between 0 and 1 for g an indicator, so that the
bound of Maurer and Pontil (COLT 2009, theorem 4) on the difference of their means holds whatever the tails: a
right program is refused with a probability below 1e-8 for each site. q is a normal fitted to half of the
draws.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pyro
import torch
from pyro.distributions import Delta
from torch import Tensor
from torch.distributions import Distribution, biject_to
from torch.distributions.transforms import Transform

from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.support import freedom_of, log_prob_inside, support_of
from bcppl.errors import InputError
from bcppl.traces.checks.comparing import Start, log_probs, rerun
from bcppl.traces.faults import Fault, ProgramError
from bcppl.traces.run import inward
from bcppl.traces.trace import Trace

# Particles at values from the prior, where the program runs no simulator.
MANY = 1000
# Draws of one site; half of them are compared with as many of the fitted normal.
DRAWS = 200_000
# Numbers that all sites of that many particles may have together; fewer are drawn where they would have more.
NUMBERS = 20_000_000
FEWEST = 1000
# Of one comparison to fail where draws and density agree.
FALSE_ALARM = 1e-10
# Coordinates of a site beyond which no normal overlaps enough.
WIDEST = 10
# Fraction of values within the declared support at which the density may be zero by rounding.
ROUNDED = 0.01
TRUSTED = ("torch.", "pyro.", "bcppl.")

FITS = "make its draws and its density those of one distribution (its constants, and the Jacobian, too)"


def check_numbers(start: Start, particles: int) -> None:
    """Check that log-probabilities at values from the prior are numbers, and latent ones finite.

    Raises:
        ProgramError: one is NaN or +inf (NOT_A_NUMBER), or -inf at its own draws, or a draw lies outside the
            declared support (SUPPORT).
    """
    trace = start(particles)
    _refuse_impossible(trace)
    if not any(isinstance(each, LazyDistribution) for each in trace.distributions.values()):
        try:
            many = start(_affordable(trace, MANY))
        except ProgramError:
            raise
        except (InputError, RuntimeError, ValueError, IndexError, TypeError) as error:
            sentence = f"the program runs with {particles} particles and not with {MANY}: {error}"
            raise ProgramError(Fault.COUNT, None, sentence) from error
        _refuse_impossible(many)


def _refuse_impossible(trace: Trace) -> None:
    values = log_probs(trace)
    for address, value in values.items():
        bound = getattr(trace.distributions[address], "log_prob_bound", torch.inf)
        if float(value.max()) > bound + 1e-9 * (1.0 + abs(bound)):
            raise ProgramError(
                Fault.BOUND,
                address,
                f"site {address!r} has log-probability {float(value.max()):.6g}, above its distribution's "
                f"`log_prob_bound` of {bound:.6g}; give an upper bound at all values, or leave it out.",
            )
    for address, value in trace.choices.items():
        distribution = trace.distributions[address]
        outside = values[address] == -torch.inf
        if freedom_of(distribution) is None and not isinstance(distribution, LazyDistribution):
            outside = outside | ~_inside(distribution, value)
        if bool(outside.any()):
            particle = int(outside.nonzero()[0])
            raise ProgramError(
                Fault.SUPPORT,
                address,
                f"site {address!r} was sampled at a value that its {type(distribution).__name__} holds "
                f"impossible ({_short(value[particle])}): declare the support that its draws have, and give "
                "these a density.",
            )


def _inside(distribution: Any, value: Tensor) -> Tensor:
    """Whether values (N, ...) lie in the declared support, (N,) bool; true where that cannot be checked."""
    every = torch.ones(len(value), dtype=torch.bool)
    try:
        inside = support_of(distribution).check(inward(value, distribution))
    except (NotImplementedError, AttributeError, RuntimeError, ValueError):
        return every
    plates = len(distribution.batch_shape) - 1
    if inside.ndim <= plates or inside.shape[plates] != len(value):
        return every
    return inside.movedim(plates, 0).reshape(len(value), -1).all(dim=1)


def check_densities(trace: Trace) -> None:
    """Check that draws of each site at one particle's values follow the density of the site.

    Distributions of torch, Pyro and bcppl are taken to be right, unless they are made of others; torch's
    LKJCholesky is not. Those of a simulator (`cost` above 0) and of more than 10 coordinates are not
    compared.

    Raises:
        ProgramError: they do not (DENSITY), or the density is NaN or zero within the declared support
            (SUPPORT).
    """
    doubted = [a for a, each in trace.distributions.items() if _doubted(each)]
    if not doubted:
        return
    copies = rerun(trace[torch.zeros(_affordable(trace, DRAWS), dtype=torch.int64)])
    for address in doubted:
        try:
            draws = copies.distributions[address].sample()
        except NotImplementedError:
            continue
        _check_site(address, copies.distributions[address], draws)


def _affordable(trace: Trace, particles: int) -> int:
    """So many particles, or fewer where the sites have many numbers each; an even number."""
    each = sum(math.prod((*d.batch_shape[:-1], *d.event_shape)) for d in trace.distributions.values())
    return max(FEWEST, min(particles, NUMBERS // max(each, 1) // 2 * 2))


def _doubted(distribution: Any) -> bool:
    if freedom_of(distribution) is not None or getattr(distribution, "cost", 0) > 0:
        return False
    size = math.prod(distribution.event_shape)
    widest = 1 if isinstance(distribution, LazyDistribution) else WIDEST
    return size <= widest and not all(map(_trusted, _made_of(distribution)))


def _trusted(kind: type) -> bool:
    return kind is not Delta and kind.__module__.startswith(TRUSTED)


def _made_of(distribution: Any) -> Iterator[type]:
    """The classes of a distribution and of the distributions and transforms that it holds."""
    left, met = [distribution], {}
    while left:
        each = left.pop()
        if type(each) in (list, tuple):
            left += each
        elif isinstance(each, Distribution | Transform) and id(each) not in met:
            # A transform and its inverse hold one another.
            met[id(each)] = each
            left += vars(each).values()
            yield type(each)


def _check_site(address: str, distribution: Any, draws: Tensor) -> None:
    """Compare draws (*plates, K, *event) of one distribution with its density, at the first plates' entry."""
    if isinstance(distribution, Delta):
        return
    support = support_of(distribution)
    first = (0,) * (len(distribution.batch_shape) - 1)
    if support.is_discrete:
        _check_frequencies(address, draws[first], _log_prob(distribution, draws)[first])
        return
    try:
        bijection = biject_to(support)
    except NotImplementedError:
        return
    free = bijection.inv(draws.double())
    coordinates = free[first].reshape(len(free[first]), -1)
    half = len(coordinates) // 2
    _refuse_surface(address, distribution, coordinates)
    fit = _fitted(coordinates[:half])
    if fit is None:
        _refuse_constant(address, distribution, bijection, free)
        return
    proposed, mixed = fit.sample((half,)), free.clone()
    mixed[first] = torch.cat([coordinates[half:], proposed]).reshape(free[first].shape)
    value = bijection(mixed)
    log_p = _log_prob(distribution, value)[first]
    if bool(torch.isnan(log_p).any() | (log_p == torch.inf).any()):
        where = value[first][torch.isnan(log_p) | (log_p == torch.inf)][0]
        raise ProgramError(
            Fault.SUPPORT,
            address,
            f"site {address!r} has no number for its log-probability at {_short(where)}, which its "
            f"{type(distribution).__name__} declares to be in its support; declare the support that it has.",
        )
    void = log_p[half:] == -torch.inf
    if not isinstance(distribution, LazyDistribution) and float(void.double().mean()) > ROUNDED:
        raise ProgramError(
            Fault.SUPPORT,
            address,
            f"site {address!r} has density zero at {_short(value[first][half:][void][0])}, which its "
            f"{type(distribution).__name__} declares to be in its support, and where kernels would propose; "
            "declare the support that it has.",
        )
    jacobian = bijection.log_abs_det_jacobian(mixed, value)
    extra = len(distribution.event_shape) - support.event_dim
    jacobian = jacobian.flatten(-extra).sum(-1) if extra > 0 else jacobian
    _compare(address, fit, torch.cat([coordinates[half:], proposed]), log_p + jacobian[first], half)


def _log_prob(distribution: Any, value: Tensor) -> Tensor:
    with torch.no_grad(), pyro.validation_enabled(False):
        log_prob = log_prob_inside(distribution, value)
    return log_prob.double().expand(distribution.batch_shape)


def _fitted(coordinates: Tensor) -> Any:
    """A normal with the draws' mean and covariance; None where they are all the same in one direction."""
    if not bool(torch.isfinite(coordinates).all()):
        return None
    covariance = torch.atleast_2d(torch.cov(coordinates.T))
    factor, info = torch.linalg.cholesky_ex(covariance)
    if int(info) or not bool(torch.isfinite(factor).all()) or float(factor.diagonal().min()) <= 0.0:
        return None
    return torch.distributions.MultivariateNormal(coordinates.mean(0), scale_tril=factor, validate_args=False)


def _refuse_surface(address: str, distribution: Any, coordinates: Tensor) -> None:
    """Refuse draws (K, D) that are all of one length, such as unit vectors, or of one sum, such as shares."""
    if coordinates.shape[1] == 1:
        return
    for measure, what in ((coordinates.norm(dim=1), "length"), (coordinates.sum(1), "sum")):
        if float(measure.std()) <= 1e-9 * float(measure.mean().abs()):
            raise ProgramError(
                Fault.SUPPORT,
                address,
                f"all draws of site {address!r} have one {what}, but its {type(distribution).__name__} "
                "declares a support that contains others, to which kernels would move; declare the support "
                "that it has.",
            )


def _refuse_constant(address: str, distribution: Any, bijection: Any, free: Tensor) -> None:
    """Refuse draws that are all the same where other values have a density."""
    one = free.narrow(len(distribution.batch_shape) - 1, 0, 1)
    elsewhere = _log_prob(distribution, bijection(free + 1.0))
    if bool((free == one).all()) and bool((elsewhere > -torch.inf).any()):
        raise ProgramError(
            Fault.DENSITY,
            address,
            f"site {address!r} is sampled at one and the same value, while its density spreads; {FITS}.",
        )


def _compare(address: str, fit: Any, points: Tensor, log_p: Tensor, half: int) -> None:
    """Compare the means of the identity; `points` are `half` draws of the site, then as many of the fit."""
    difference = torch.sigmoid(
        torch.where(torch.arange(len(points)) < half, 1.0, -1.0) * (fit.log_prob(points) - log_p)
    )
    centre = points[:half].median(0).values
    spread = (points[:half] - centre).abs().median(0).values
    sides = torch.cat([points > centre, (points - centre).abs() > spread], dim=1).T
    for side in (torch.ones(len(points), dtype=torch.bool), *sides):
        part = difference * side
        if _apart(part[:half], part[half:]):
            drawn, proposed = float(part[:half].mean()), float(part[half:].mean())
            raise ProgramError(
                Fault.DENSITY,
                address,
                f"site {address!r} is not sampled from its density: two estimates that must agree are "
                f"{drawn:.3f} by its draws and {proposed:.3f} by its density; {FITS}.",
            )


def _apart(first: Tensor, second: Tensor) -> bool:
    """Whether the means of two samples (K,) of values from 0 to 1 differ (empirical Bernstein bound)."""
    log, count = math.log(2.0 / FALSE_ALARM), len(first)
    bound = math.sqrt(2.0 * float(first.var() + second.var()) * log / count)
    bound += 2 * 7.0 * log / (3.0 * (count - 1))
    return abs(float(first.mean() - second.mean())) > bound


def _check_frequencies(address: str, draws: Tensor, log_p: Tensor) -> None:
    """Compare how often values (K, *event) were drawn with their probabilities."""
    rows = draws.reshape(len(draws), -1)
    # Of numbers much faster than of rows.
    axis = {"dim": 0} if rows.shape[1] > 1 else {}
    values, which, counts = torch.unique(rows, return_inverse=True, return_counts=True, **axis)
    which = which.flatten()
    probability = torch.zeros(len(values), dtype=torch.float64).index_copy(0, which, log_p.exp())
    frequency = counts.double() / len(draws)
    log = math.log(2.0 * len(values) / FALSE_ALARM)
    likely = torch.maximum(probability.clamp(max=1.0), frequency)
    bound = torch.sqrt(2.0 * likely * log / len(draws)) + log / len(draws)
    wrong = ((probability - frequency).abs() > bound) | (probability > 1.0 + 1e-6)
    if bool(wrong.any()) or float(probability.sum()) > 1.0 + 1e-6:
        k = int(wrong.nonzero()[0]) if bool(wrong.any()) else 0
        raise ProgramError(
            Fault.DENSITY,
            address,
            f"site {address!r} was drawn at {_short(values[k])} in {100 * float(frequency[k]):.3g} % of its "
            f"draws, and has there a probability of {100 * float(probability[k]):.3g} %; {FITS}.",
        )


def _short(value: Tensor) -> str:
    return ", ".join(f"{float(each):.4g}" for each in value.reshape(-1)[:4]) + (
        ", ..." if value.numel() > 4 else ""
    )
