"""Summaries of a population at any of its latent addresses: moments, quantiles, probabilities.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling
    from bcppl.inference.summaries import covariance, mean, quantiles

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    population = importance_sampling(weighed, (), {"reading": torch.tensor(2.4).double()}, 1000)
    print(mean(population, "mass"), covariance(population, "mass"))
    print(quantiles(population, "mass", [0.05, 0.95]))

At the address of a pose (its distribution has a `freedom`) these are the belief's: a mean pose (7,), and six
tangent coordinates at it, metres and radians, 0 along held axes (`bcppl.beliefs`). At that of an angle (its
density is periodic, as von Mises' is) the mean is circular (Mardia and Jupp, Directional Statistics, 2000,
section 2.2), and the others are of the angles within half a turn of it. All raise InputError where no latent
site has the address, and NoWeightError where no particle has any weight.

What a program names by `pyro.deterministic` has summaries too, as a pose where it holds seven numbers of
which the last four are a unit quaternion.

Of a long series (`bcppl.traces.Series`) an address may be one with the number of a step, `("x", 3)`: the
value of each particle's ancestor at that step, with the particle's present weight.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl.arguments import latent_address
from bcppl.beliefs import Belief, normalised, weighted_quantiles
from bcppl.distributions.support import freedom_of, is_of_angles
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.poses import FREE, Freedom
from bcppl.poses.quaternions import wrapped_angle
from bcppl.traces import Trace
from bcppl.traces.series import SeriesTrace

Address = str | tuple[str, int]

COLLAPSED = (
    "has collapsed to a point: all particles with weight are the same, so no observation is informative; use "
    "more particles, or move them apart first (rejuvenation)."
)
WEIGHTLESS = (
    "the belief has no weight: every particle's is zero; widen the prior, use more particles, or check the "
    "values that are observed."
)


def values_at(population: Population, address: Address) -> Tensor:
    """The values (N, *event) at a latent address."""
    name, then = _site(population, address)
    if isinstance(address, str):
        value: Tensor = then[name]
        return value
    assert isinstance(population.trace, SeriesTrace)
    return population.trace[address]


def is_pose(population: Population, address: Address) -> bool:
    """Whether a latent address holds poses (N, 7): its distribution has a `freedom`."""
    return _freedom(population, address) is not None


def _site(population: Population, address: Address) -> tuple[str, Trace]:
    """The name of a latent address, and the trace of the step that has it."""
    trace = population.trace
    if isinstance(address, str):
        latent_address("a summary of {} was asked for", address, _summed_up(address, trace))
        return address, trace
    name, number = address
    if not isinstance(trace, SeriesTrace):
        raise InputError(
            f"a summary of {name!r} after step {number} was asked for, but the program is no Series; "
            "give the address alone."
        )
    # A step may have others than the newest, such as what only `init` samples.
    then = trace._after(number)[0]
    what = f"a summary of step {number} was asked for at {{}}"
    latent_address(what, name, _summed_up(name, then))
    return name, then


def _summed_up(address: str, trace: Trace) -> Collection[str]:
    """The addresses that have summaries; those that are determined by others are known after a run only."""
    return trace.choices if address in trace.choices else [*trace.choices, *trace.determined]


def _freedom(population: Population, address: Address) -> Freedom | None:
    name, then = _site(population, address)
    # A pose is one at every step, and the newest distributions are there.
    newest = population.trace
    if name not in newest.choices and name not in then.choices:
        return FREE if _are_poses(then[name]) else None
    return freedom_of((newest if name in newest.choices else then).distributions[name])


def _are_poses(values: Tensor) -> bool:
    return values.shape[1:] == (7,) and bool(((values[:, 3:].norm(dim=1) - 1.0).abs() < 1e-6).all())


def is_angle(population: Population, address: Address) -> bool:
    """Whether a latent address holds angles: its density is periodic."""
    name, then = _site(population, address)
    return name in then.choices and is_of_angles(then.distributions[name])


def _values(population: Population, address: Address) -> tuple[Tensor, Tensor]:
    """Values (N, *event) that are no poses, angles within half a turn of the mean; and the mean (*event)."""
    values, weights = values_at(population, address).to(torch.float64), normalised(population.log_weights)
    if not is_angle(population, address):
        return values, torch.einsum("n,n...->...", weights, values)
    sine, cosine = (torch.einsum("n,n...->...", weights, each) for each in (values.sin(), values.cos()))
    middle = torch.atan2(sine, cosine)
    return middle + wrapped_angle(values - middle), middle


def _belief(population: Population, address: Address) -> Belief:
    freedom = _freedom(population, address) or FREE
    return Belief(values_at(population, address), population.log_weights, freedom)


def mean(population: Population, address: Address) -> Tensor:
    """The weighted mean (*event) at an address, in its own units; of a discrete one that of its numbers."""
    if is_pose(population, address):
        return _belief(population, address).mean
    return _values(population, address)[1]


def covariance(population: Population, address: Address) -> Tensor:
    """The weighted covariance (D, D) of the D numbers of a value, in reading order; (6, 6) of a pose."""
    if is_pose(population, address):
        return _belief(population, address).covariance
    weights = normalised(population.log_weights)
    return weighted_covariance(_values(population, address)[0].reshape(len(weights), -1), weights)


def weighted_covariance(values: Tensor, weights: Tensor) -> Tensor:
    """The covariance (D, D) of values (N, D) under normalised weights (N,)."""
    centred = values - weights @ values
    return (weights[:, None] * centred).T @ centred


def quantiles(population: Population, address: Address, probabilities: object) -> Tensor:
    """Weighted quantiles (Q, *event) of each number of a value by itself, (Q, 6) of a pose.

    Args:
        population: weighted particles.
        address: a latent one, or with the number of a step.
        probabilities: one (then there is no first axis) or several in [0, 1]; see `weighted_quantiles`.
    """
    if is_pose(population, address):
        return _belief(population, address).quantiles(probabilities)
    values = (
        _values(population, address)[0] if is_angle(population, address) else values_at(population, address)
    )
    return weighted_quantiles(values, normalised(population.log_weights), probabilities)


class Probabilities(NamedTuple):
    """The distinct values (K, *event) of particles with weight, in order, and their probabilities (K,)."""

    values: Tensor
    probabilities: Tensor


def probabilities(population: Population, address: Address) -> Probabilities:
    """The probability of each value at a discrete address."""
    weights, values = normalised(population.log_weights), values_at(population, address)
    carrying = weights > 0
    distinct, which = torch.unique(values[carrying], dim=0, return_inverse=True)
    summed = torch.zeros(len(distinct), dtype=torch.float64).index_add_(0, which, weights[carrying])
    return Probabilities(distinct, summed)


def evidence_variance(population: Population) -> float:
    """Relative variance of a run's estimate of the evidence, about that of its log, from its genealogy alone.

    Lee and Whiteley, Variance estimation in the particle filter, Biometrika 105, 2018, eq. 8.

    With multinomial resampling, at fixed times, and fixed exponents and proposals, this times the squared
    estimate is unbiased for the estimate's variance; with resampling times that depend on the particles it is
    consistent (Du and Guyader, Variance estimation in adaptive sequential Monte Carlo, Annals of Applied
    Probability 31, 2021). It assumes independent draws: use `always(multinomial)` or `adaptive(multinomial)`.
    With systematic or SSP resampling at every step it was three times too small on a walk of five steps. It
    may be negative where the variance is small, and is imprecise once few founders are left.

    Returns:
        The relative variance; NaN where all particles with weight share one founder, where founders were
        merged, or where the initial population was stratified.

    Raises:
        NoWeightError: no particle has any weight.
    """
    weights = normalised(population.log_weights)
    if math.isinf(population.log_pairs):
        return math.nan
    _, founder = torch.unique(population.founders, return_inverse=True)
    shares = torch.zeros(int(founder.max()) + 1, dtype=torch.float64).index_add_(0, founder, weights)
    if int((shares > 0).sum()) < 2:
        return math.nan
    return 1.0 - math.exp(population.log_pairs) * (1.0 - float(shares @ shares))
