"""Modes reached by climbs from all over the prior, and jumps between them: where the best mode is narrow.

Tempering follows the mass: where a wide mode holds more of it at a low exponent than a narrow one that wins
in the end, all particles are in the wide one before that comes to light, and more particles hardly help.
Climbers do not compete until they have climbed. What they find is used for proposals, accepted by Metropolis
and Hastings: the posterior weighs the modes, and no answer depends on how they were reached.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

import pyro
import torch
from torch import Tensor

from bcppl.distributions.poses import MixturePose, NormalPose
from bcppl.distributions.support import freedom_of
from bcppl.errors import InputError
from bcppl.inference.exponents import next_exponent
from bcppl.inference.proposals.coordinates import PoseCoordinates
from bcppl.inference.proposals.depth_points import depth_aligned
from bcppl.inference.proposals.least_squares import Alignment
from bcppl.inference.proposals.onset_points import onsets, onsets_aligned
from bcppl.inference.proposals.spread import conditioned
from bcppl.inference.summaries import weighted_covariance
from bcppl.poses import FREE
from bcppl.traces import Program, Trace

ALIGNMENTS = 4  # of every climber, of two steps each
WALKERS, STEPS = 24, 80  # the climbers that go on by small steps, and how many steps they try
MODES = 8  # that are kept
APART = (0.5, 1.0)  # the least distance of two walkers and of two modes, in standard deviations of the prior
REACH = 0.5  # of an alignment, likewise
FIRST, SMALLEST, LARGEST = 0.1, 0.002, 1.0  # sizes of a step, likewise
LONGER, SHORTER = 1.5, 0.9  # after a step and after none: at equilibrium a fifth of those tried are made
ROUNDS, DRAWS, KEPT = 5, 40, 0.25  # of fitting a normal to each mode; the share of the draws that stays
WIDTHS = (1.2, 3.0)  # of jumps, in a mode's own standard deviations: it is wider before the exponent is 1
ANYWHERE, WIDE = 0.1, 4.0  # the share of jumps that go anywhere, and their variance in the prior's


class Modes(NamedTuple):
    """A normal for each of K modes."""

    centers: Tensor  # poses (K, 7)
    covariance: Tensor  # (K, d, d) over the free axes
    log_mass: Tensor  # (K,) log of the integral of the joint density, by importance sampling
    scale: Tensor  # (d,) standard deviations of where the climbs began


def modes(start: Trace, address: str, along: Sequence[str] = ()) -> Modes:
    """The modes that climbs from a trace's particles lead to.

    Every climber is aligned with the depth images or the onsets of touches that there are, several times, and
    goes back to the best of these places.
    Those of the highest density, no two of them close together, try small steps, and go where the density is
    higher (the (1+1) evolution strategy of Rechenberg, Evolutionsstrategie, 1973). Those that end near
    a higher one count as one mode.
    To each a normal is fitted by population Monte Carlo (Cappe, Douc, Guillin, Marin and Robert, Adaptive
    importance sampling in general mixture classes, Statistics and Computing 18, 2008).

    Args:
        start: of a program with all its observations, its latent values drawn from the prior. The more
            particles, the narrower a mode may be that is reached.
        address: of the pose that is moved; other latent values stay as they are.
        along: addresses of poses that are set to the same pose, such as those at which cameras that err see
            the part: the errors are climbed without.

    Raises:
        InputError: no pose is at the address.
    """
    if address not in start.choices or start[address].shape != (start.particles, 7):
        raise InputError(f"climbs are to move {address!r}, where the program samples no pose; name one.")
    known = PoseCoordinates(freedom_of(start.distributions[address]) or FREE)
    start = _at(start, start[address], address, *along)
    equal = torch.full((start.particles,), 1.0 / start.particles, dtype=torch.float64)
    steps = known.steps(known.mean(start[address], equal), start[address])
    scale = steps.std(dim=0, correction=0).clamp_min(1e-9)
    damping = torch.diag((REACH * scale) ** -2)
    trace, density, pose = start, start.log_prob(), start[address]
    alignments = _alignments(start, address)
    for align in ALIGNMENTS * alignments:
        trace = _at(trace, align(trace, address, damping, steps=2).pose, address, *along)
        reached = trace.log_prob()
        # An alignment may lead out of the prior, or from a good place to a worse one.
        pose = torch.where((reached > density)[:, None], trace[address], pose)
        density = torch.maximum(reached, density)
    trace = _at(trace, pose, address, *along)
    kept = highest(known, trace[address], density, scale, WALKERS, APART[0])
    trace, density = trace.chosen(kept), density[kept]
    # Where onsets are all that is aligned, climbers end at the optimum: small steps gained no evidence.
    size = torch.full_like(density, FIRST)
    for _ in range(0 if alignments == [onsets_aligned] else STEPS):
        step = size[:, None] * scale * torch.randn(len(kept), known.dimension, dtype=torch.float64)
        tried = _at(trace, known.stepped(trace[address], step), address, *along)
        reached = tried.log_prob()
        higher = reached > density
        pose = torch.where(higher[:, None], tried[address], trace[address])
        trace, density = _at(trace, pose, address, *along), torch.maximum(density, reached)
        size = torch.where(higher, LONGER * size, SHORTER * size).clamp(SMALLEST, LARGEST)
    ends = highest(known, trace[address], density, scale, MODES, APART[1])
    return fitted(trace.chosen(ends), address, known, scale, along)


def _at(trace: Trace, pose: Tensor, *addresses: str) -> Trace:
    """The trace with the same pose (N, 7) at several addresses."""
    return trace.at(dict.fromkeys(addresses, pose))


def _alignments(trace: Trace, address: str) -> list[Callable[..., Alignment]]:
    """The alignments for which a trace has sites."""
    images = any(fnmatchcase(a, "depth_*") for a in trace.observations)
    return [depth_aligned] * images + [onsets_aligned] * bool(onsets(trace, address))


def fitted(
    trace: Trace, address: str, known: PoseCoordinates, scale: Tensor, along: Sequence[str] = ()
) -> Modes:
    """A normal for the mode at each of K particles; `scale` (d,) is that of where climbs began."""
    centers, count = trace[address], trace.particles
    many = trace.chosen(torch.arange(count).repeat_interleave(DRAWS))
    covariance = torch.diag(0.1 * scale).square().repeat(count, 1, 1)
    log_mass = torch.zeros(count, dtype=torch.float64)
    equal = torch.zeros(DRAWS, dtype=torch.float64)
    for k in range(ROUNDS):
        around = NormalPose(centers[:, None], covariance[:, None], known.freedom).expand((count, DRAWS))
        drawn = around.sample()
        density = _at(many, drawn.reshape(-1, 7), address, *along).log_prob().reshape(count, DRAWS)
        factor = density - around.log_prob(drawn)
        log_mass = torch.logsumexp(factor, dim=1) - math.log(DRAWS)
        if k == ROUNDS - 1:
            break
        for m in range(count):
            if not bool((factor[m] > -torch.inf).sum() > known.dimension):
                continue
            weights = torch.softmax(next_exponent(equal, factor[m], 0.0, KEPT) * factor[m], dim=0)
            center = known.mean(drawn[m], weights)
            spread = weighted_covariance(known.steps(center, drawn[m]), weights)
            spread = conditioned(
                spread + torch.diag(known.rounding(drawn[m]).square()), 1.0 / float(weights.square().sum())
            )
            centers = centers.index_copy(0, torch.tensor([m]), center[None])
            covariance = covariance.index_copy(0, torch.tensor([m]), spread[None])
    return Modes(centers, covariance, log_mass, scale)


def jumps(
    address: str, ends: Modes, along: Sequence[str] = (), conditional: Program | None = None
) -> Program:
    """A pose near one of several modes, wherever the particle was: an independent proposal.

    Where the modes are those of other poses `along`, these jump, and `conditional`, a proposal of the pose
    given them, follows.

    Half of the jumps go to all modes alike, half by their mass. Some are wider than the prior: particles
    where no mode was reached could not leave otherwise, for nothing would lead back.
    """
    count = len(ends.centers)
    # A mode about which no draw was possible has -inf.
    mass = torch.softmax(ends.log_mass.clamp_min(-1e300), dim=0)
    chance = (0.5 / count + 0.5 * mass).repeat_interleave(len(WIDTHS))
    centers = ends.centers.repeat_interleave(len(WIDTHS), dim=0)
    width = torch.tensor(WIDTHS, dtype=torch.float64).repeat(count)
    around = width[:, None, None] ** 2 * ends.covariance.repeat_interleave(len(WIDTHS), dim=0)
    best = ends.centers[ends.log_mass.argmax()][None]
    centers, around = torch.cat([centers, best]), torch.cat([around, torch.diag(WIDE * ends.scale**2)[None]])
    chance = torch.cat([(1.0 - ANYWHERE) * chance / chance.sum(), chance.new_tensor([ANYWHERE])])

    def jump(trace: Trace) -> None:
        freedom = freedom_of(trace.distributions[address]) or FREE
        mixture = MixturePose(chance.log(), centers, around, freedom)
        moved = {each: pyro.sample(each, mixture) for each in along or (address,)}
        if conditional is not None and along:
            conditional(trace.at(moved))

    return jump


def highest(
    known: PoseCoordinates, places: Tensor, density: Tensor, scale: Tensor, most: int, apart: float
) -> Tensor:
    """The places (K,) of highest density, none nearer to a higher one than `apart` times the scale (d,)."""
    kept: list[int] = []
    for k in density.argsort(descending=True).tolist():
        if len(kept) == most or (kept and not density[k] > -torch.inf):
            break
        steps = known.steps(places[kept], places[k]) / scale
        if not bool((steps.norm(dim=-1) < apart).any()):
            kept.append(k)
    return torch.tensor(kept)
