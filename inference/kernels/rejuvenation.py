"""Rejuvenation: every particle of a population is moved, by a kernel that learns from other particles."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import address_list, number_within, whole_number
from bcppl.beliefs import normalised
from bcppl.devices import on_device_of
from bcppl.distributions.support import freedom_of
from bcppl.errors import InputError
from bcppl.inference.kernels.combinators import in_parts
from bcppl.inference.kernels.halving import apart_from, halved, halves
from bcppl.inference.kernels.kernel import Kernel, fitted, learns, scattered
from bcppl.inference.population import Population
from bcppl.inference.targets import Target, as_target

ROUNDING = 1e-9  # of a mean change: as small a standard error is none


class Moved(NamedTuple):
    """A rejuvenated population.

    Attributes:
        population: after the last sweep.
        acceptance: the share of proposals that were accepted, NaN without sweeps.
        displacement: mean squared displacement of the particles, in variances, on the axis on which it is
            least; NaN unless `until(displacement=...)` is given.
    """

    population: Population
    acceptance: float
    displacement: float = math.nan


@dataclass(frozen=True)
class Until:
    """Sweeps until a population is displaced, or its particles differ: see `until`."""

    distinct: int | None
    displacement: float | None
    most: int
    of: tuple[str, ...] = ()

    def reached(self, start: Population, now: Population) -> bool:
        """Whether the criteria hold for a population that began at `start`."""
        if self.distinct is not None:
            differ = now.distinct_in(self.of) if self.of else now.distinct
            if differ < min(self.distinct, len(now)):
                return False
        return self.displacement is None or bool((self.displaced(start, now) >= self.displacement).all())

    def displaced(self, start: Population, now: Population) -> Tensor:
        """The displacement (K,) on each axis that counts, as of `displacement`.

        Raises:
            InputError: none does, for no latent value is continuous.
        """
        displaced = displacement(start, now, self.of)
        if not len(displaced):
            raise InputError(
                "until waits for a displacement, and none of the latent values that count is continuous; "
                "give distinct, or a number of sweeps."
            )
        return displaced


def until(
    *,
    distinct: int | None = None,
    displacement: float | None = None,
    of: Sequence[str] | str = (),
    most: int = 50,
) -> Until:
    """Sweeps until the particles differ, or have left where they began, or both.

    A particle that had a stopping time of its own would be biased: a chain that is observed just after it
    moved is at places that are easy to reach. All stop together, on a mean or a count over the population in
    which each has a share of 1/N; the bias that remains falls as 1/N, as that of fitted proposals and
    adaptive tempering does. With a fixed number of sweeps there is none. Displacement is measured along the
    axes, and says little about narrow directions across them: on a Gaussian with six correlated axes and
    1000 particles, one of 0.5 left log Z 0.1 to 0.2 nats too low, and variances 1 to 5 % too large; on one
    with isotropic axes 0.5 left -.195 +- .060 and 1.5 -.001 +- .024 (`benchmarks/exact.py`).

    Args:
        distinct: how many particles shall differ in some latent value (all, if the population has fewer).
        displacement: the weighted mean squared displacement since the start that every axis of every
            continuous latent value shall reach, as a share of its variance in the population. It is 2 for
            independent particles, and 0.5 where the correlation with the start is about 0.75.
        of: the addresses of the latent values that count, or one; all unless given.
        most: the largest number of sweeps.

    Raises:
        InputError: nothing is asked for, or what no population can reach.
    """
    if distinct is None and displacement is None:
        raise InputError("until is given no criterion; give distinct, displacement or both.")
    if distinct is not None:
        distinct = whole_number("until is to wait for {} distinct particles", distinct)
    if displacement is not None:
        what = "until is to wait for a displacement of {} variances"
        displacement = number_within(what, displacement, above=0.0, below=2.0)
    most = whole_number("until may make {} sweeps at most", most)
    return Until(distinct, displacement, most, tuple(address_list(of)))


def displacement(start: Population, now: Population, of: Collection[str] = ()) -> Tensor:
    """Weighted mean squared displacement (K,) on each axis, as a share of the axis's variance now.

    All latent values count, unless some are named.

    Axes are the free axes of poses, in the tangent space at their mean, and the coordinates of other
    continuous latent values. An axis without variance has no displacement: 0.
    """
    weights = normalised(now.log_weights)
    shares = [weights.new_empty(0)]
    for address in now.trace.choices:
        if now.trace.distributions[address].support.is_discrete or (of and address not in of):
            continue
        step, place = _coordinates(start, now, address)
        variance = weights @ (place - weights @ place).square()
        share = weights @ step.square() / variance
        shares.append(torch.where(variance > 0.0, share, 0.0))
    return torch.cat(shares)


def shift(start: Population, now: Population) -> float:
    """By how many standard errors moves have changed a mean or a variance, on the axis where that is most.

    Moves that leave a target invariant change no expectation of particles that are draws of it. Copies of one
    count as one.
    """
    weights, most = normalised(now.log_weights), 0.0
    for address in now.trace.choices:
        step, place = _coordinates(start, now, address)
        before = place - step
        wider = (place - weights @ place).square() - (before - weights @ before).square()
        change = torch.cat([step, wider], dim=1)
        mean = weights @ change
        deviations = weights[:, None] * (change - mean)
        _, copy = torch.unique(start.trace[address].reshape(len(now), -1), dim=0, return_inverse=True)
        summed = torch.zeros_like(deviations).index_add_(0, copy, deviations)
        error = summed.square().sum(dim=0).sqrt()
        known = error > ROUNDING * (weights @ change.abs())  # unlike that of copies of one
        most = max([most, *(mean / error).abs()[known].tolist()])
    return most


def _coordinates(start: Population, now: Population, address: str) -> tuple[Tensor, Tensor]:
    """Each particle's displacement and its place, along the free axes (N, K)."""
    old, new = start.trace[address], now.trace[address]
    freedom = freedom_of(now.trace.distributions[address])
    if freedom is None or old.ndim != 2:
        old, new = (v.reshape(len(now), -1).to(torch.float64) for v in (old, new))
        return new - old, new
    mean = on_device_of(now.belief(address).mean, new)
    # Not the difference of two places about the mean, which jumps where a rotation passes half a turn.
    return freedom.coordinates(poses.local(old, new)), freedom.coordinates(poses.local(mean, new))


def moved_by(population: Population, kernel: Kernel, target: Target, sweeps: int | Until = 1) -> Moved:
    """Move every particle, `sweeps` times.

    A kernel that learns and moves one half of the population is fitted to the other, so that no particle
    shapes its own proposal, nor do its copies (`bcppl.inference.kernels.halving`). Where there is one
    particle, or all are copies of one, it is fitted to draws of the program. One that learns nothing moves
    all at once, which for few particles takes half as long; so do the parts of a `sequence`.

    Args:
        population: of N particles.
        kernel: fitted in each sweep.
        target: left invariant by the moves.
        sweeps: how many; 0 leaves the population as it is. Or `until(...)`.

    Raises:
        InputError: the sweeps are no whole number, 0 or more.
    """
    what = "a population is to be moved {} times"
    most = sweeps.most if isinstance(sweeps, Until) else whole_number(what, sweeps, least=0)
    target, start, shares, made = as_target(target), population, [], 0
    while made < most and not (isinstance(sweeps, Until) and sweeps.reached(start, population)):
        population, accepted = _sweep(population, kernel, target)
        shares.append(accepted)
        made += 1
    acceptance = float(torch.cat(shares).mean()) if shares else math.nan
    if not isinstance(sweeps, Until) or sweeps.displacement is None:
        return Moved(population, acceptance)
    return Moved(population, acceptance, float(sweeps.displaced(start, population).min()))


def _sweep(population: Population, kernel: Kernel, target: Target) -> tuple[Population, Tensor]:
    total, count = torch.zeros(len(population), dtype=torch.float64), 0
    for part, moves in in_parts(kernel, population):
        population, share = (_by_halves if learns(part) else _all_at_once)(population, part, target)
        total, count = total + moves * share, count + moves
    return population, total / count


def _all_at_once(population: Population, kernel: Kernel, target: Target) -> tuple[Population, Tensor]:
    moved, share = fitted(kernel, population)(population.trace, target)
    return population.with_trace(moved), share.to(torch.float64)


def _by_halves(population: Population, kernel: Kernel, target: Target) -> tuple[Population, Tensor]:
    # What is known of all particles is known of each half, and stays known of those that do not move.
    target(population.trace)
    population = halved(population)
    shares = torch.zeros(len(population), dtype=torch.float64)
    for mine in halves(population):
        moved, share = fitted(kernel, apart_from(population, mine))(population.trace[mine], target)
        shares[mine] = share.to(torch.float64)
        population = population.with_trace(scattered(population.trace, mine, moved))
    return population, shares
