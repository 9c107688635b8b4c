"""SMC in which the model's own programs take measurements in, and moves repair what they do not know.

A program that goes straight to where the new measurement says that the part is, weighed by SMCP3
(`smcp3`), spares the many small steps by which tempering lets a sharp likelihood in. Where
such a step leaves too few particles with weight, it is undone and the likelihood is tempered in.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.errors import InputError, NoWeightError
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.smcp3 import Pair, smcp3
from bcppl.inference.filters.step import Observed, StepFunction, StepInfo, Stepped
from bcppl.inference.filters.tempering import resample_move, tempered
from bcppl.inference.kernels import Kernel, metropolis_hastings, sequence
from bcppl.inference.kernels.kernel import Move
from bcppl.inference.population import Population
from bcppl.inference.proposals import Program, drift
from bcppl.inference.proposals.together import continuous
from bcppl.inference.resampling import adaptive, never, systematic
from bcppl.inference.sizing import replicated
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Model, extend

WALK = (0.2, 2.0)  # scales of the random walks
CERTAIN = 0.01  # nats: what is expected for sure tells nothing
ASKED = 4  # particles that are asked first whether all had to expect a measurement


def kernel(pose: str, proposals: Sequence[Program]) -> Kernel:
    """One other latent value walks, then the pose is drawn anew by the model's proposals, then it walks."""

    def moved(population: Population) -> Move:
        others = [address for address in continuous(population.trace) if address != pose]
        walks = [metropolis_hastings(drift(other, WALK)) for other in others]
        given = [metropolis_hastings(proposal) for proposal in proposals]
        # One for all: drawn for each particle, every walk would have to run.
        chosen = [walks[int(torch.randint(len(walks), ()))]] if walks else []
        return sequence([*chosen, *given, metropolis_hastings(drift(pose, WALK))])(population)

    return moved


def guided(
    pair: Pair,
    moves: Kernel,
    *,
    sweeps: int = 1,
    share: float = 0.5,
    few: float = 0.2,
    most: int = 40,
    least: float = 0.03,
    room: int = 40_000,
) -> StepFunction:
    """A step that takes a measurement in by a pair of programs, resamples when needed, and moves.

    Args:
        pair: there and back.
        moves: of every particle after each step.
        sweeps: how many of them.
        share: particles are resampled below this effective sample size, as a share of N.
        few: so many are to be left effective by the pair, as a share of N.
        most: it is run anew with more copies of each particle, as many as seem needed and at most so many,
            until they are; N of all are kept.
        least: where even with `most` copies fewer would be left effective, as a share of N, the measurement
            is tempered in.
        room: so many copies in all at most: memory and time grow with them.
    """
    by_pair = smcp3(pair, resample=never)
    resample = adaptive(systematic, share)
    rejuvenation = resample_move(moves, sweeps, resample, always_move=True)
    by_tempering = tempered(moves, sweeps=2 * sweeps, resample=resample)

    def weighed(population: Population, observed: Observed) -> Population | None:
        try:
            return by_pair(population, observed).population
        except NoWeightError:
            return None

    def as_expected(population: Population, observed: Observed) -> Population | None:
        """The particles as they are, where all had to expect the measurement and nothing latent comes."""
        alive = (population.log_weights > -torch.inf).nonzero()[:, 0]
        few = population.trace.chosen(alive[:ASKED])
        with torch.random.fork_rng(devices=[]):
            asked, gained = extend(few, *observed)
        if len(asked.choices) == len(few.choices) and not bool((gained.abs() < CERTAIN).all()):
            return None  # mostly so, and a few are asked in no time
        longer, gained = extend(population.trace, *observed)
        if len(longer.choices) > len(population.trace.choices):
            return None
        certain = bool((gained[alive].abs() < CERTAIN).all())
        return population.with_trace(longer).reweighed(gained) if certain else None

    def step(population: Population, observed: Observed) -> Stepped:
        count = len(population)
        chosen: Tensor | None = None
        stayed = as_expected(population, observed)
        if stayed is not None:
            return Stepped(stayed, _info(population, stayed, stayed.effective_sample_size))
        times, goal = 1, few * count
        allowed = max(1, min(most, room // count))
        reached = weighed(population, observed)
        while times < allowed and (reached is None or reached.effective_sample_size < goal):
            each = 0.0 if reached is None else reached.effective_sample_size / times
            # Effective sizes are often taken for too large: ask for more than would just do.
            times = min(allowed, max(2 * times, math.ceil(1.5 * goal / max(each, goal / most))))
            reached = weighed(replicated(population, times), observed)
        if reached is None or reached.effective_sample_size < least * count * times / most:
            return by_tempering(population, observed)
        effective = reached.effective_sample_size
        if len(reached) > count:
            chosen = systematic(reached.log_weights, count)
            reached = reached.selected(chosen)
        moved, ancestors, acceptance, _ = rejuvenation(reached, POSTERIOR)
        if chosen is not None:
            origin = chosen // times
            ancestors = origin if ancestors is None else origin[ancestors]
        return Stepped(moved, _info(population, moved, effective, acceptance, ancestors))

    return step


def _info(
    before: Population,
    after: Population,
    effective: float,
    acceptance: float | None = None,
    ancestors: Tensor | None = None,
) -> StepInfo:
    return StepInfo(
        acceptance=float("nan") if acceptance is None else acceptance,
        resampled=int(ancestors is not None),
        effective_sample_size_before=effective,
        effective_sample_size=after.effective_sample_size,
        log_evidence=after.log_evidence - before.log_evidence,
        ancestors=ancestors,
    )


def infer(
    model: Model,
    recording: Any,
    *,
    particles: int = 75,
    seed: int = 0,
    sweeps: int = 1,
    share: float = 0.5,
    scene: Any = None,
    start: Step | None = None,
) -> Iterator[Step]:
    """Beliefs over a recording, one step for each measurement, the prior first.

    Args:
        model: what explains the recording; it has an `arrival`.
        recording: a `bcppl.recordings.Recording`.
        particles: how many.
        seed: same seed, same beliefs.
        sweeps: moves of every particle after each measurement.
        share: particles are resampled below this effective sample size, as a share of N.
        scene: what `model.prepare(recording)` gives, if it is at hand.
        start: a step to go on from, as `bcppl.inference.filters.smc.smc` does.

    Raises:
        InputError: a number is out of range, or the model brings no `arrival`.
    """
    particles = whole_number("SMC is to run {} particles", particles)
    sweeps = whole_number("SMC is to make {} sweeps", sweeps)
    share = number_within("particles are to be resampled below a share of {}", share, least=0.0, most=1.0)
    if model.arrival is None:
        raise InputError(
            "guided SMC is given a model without programs that take measurements in; give it an `arrival`, "
            "or use bcppl.inference.filters.tempered_smc."
        )
    step = guided(Pair(*model.arrival), kernel(model.pose, model.proposals), sweeps=sweeps, share=share)
    return smc(model, recording, step=step, particles=particles, seed=seed, scene=scene, start=start)
