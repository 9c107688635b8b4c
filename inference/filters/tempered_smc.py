"""The default inference program: SMC with tempering, its moves shaped by the other particles.

Half of the moves are random walks, half are drawn from a normal that is fitted to the other half of the
particles. Where a move costs little (pushes, depth images), a measurement is let in by small steps, with many
moves of every particle after each. Once moves cost simulations it is let in by larger steps, and the
particles are moved until they have left where they were resampled. Copy this file to write your own:
`bcppl run RECORDING --inference FILE.py` takes any file that defines `infer`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.distributions.support import support_of
from bcppl.errors import InputError
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.step import Observed, Stepped
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.kernels import Kernel, Until, metropolis_hastings, mixture, sequence, until
from bcppl.inference.kernels.kernel import Move, takes
from bcppl.inference.population import Population
from bcppl.inference.proposals import Program, drift, independent, prior, spread_of
from bcppl.inference.proposals.climbing import Modes, jumps, modes
from bcppl.inference.proposals.coordinates import continuous_addresses
from bcppl.inference.proposals.walk import joint_drift
from bcppl.inference.resampling import adaptive, systematic
from bcppl.traces import Model, Series, Trace, generate

PHYSICS = 2  # the cost of a site that simulates contact (`bcppl.distributions.lazy`)


def kernel(pose: str, proposals: Sequence[Program] = (), modes: Modes | None = None) -> Kernel:
    """How a pose is moved: by a random walk, some of its steps long ones, or to wherever the others are.

    Discrete values (which of several holes it is) are drawn anew from the program.

    Where a program has other latent values that can be moved (a camera's error, a grasp), each of them then
    walks alone, and all of them together.

    Args:
        pose: its address.
        proposals: programs that the model's author gives along (`bcppl.traces.Model`); each is used once.
        modes: that were found; then a third of the moves of the pose are jumps to one of them.
    """
    # A fifth of the draws are three times as wide as the particles: few particles may have missed a mode.
    anew = independent(pose, 1, inflation=1.2, wide=(0.2, 3.0))
    far = [] if modes is None else [metropolis_hastings(jumps(pose, modes))]
    alone = mixture([metropolis_hastings(drift(pose, (0.2, 2.0))), metropolis_hastings(anew), *far])

    def moved(population: Population) -> Move:
        others = [address for address in continuous_addresses(population.trace) if address != pose]
        if not others:
            return alone(population)
        each = [metropolis_hastings(drift(other, (0.2, 2.0))) for other in others]
        walk = metropolis_hastings(joint_drift(pose, *others, scales=(0.2, 2.0)))
        return sequence([alone, *each, walk])(population)

    def spreads(population: Population) -> dict[str, Tensor]:
        return {a: spread_of(a)(population) for a in continuous_addresses(population.trace)}

    given = [metropolis_hastings(p, *([spreads] if takes(p, 2) else [])) for p in proposals]
    shaped = sequence([moved, *given]) if given else moved

    def chosen_anew(population: Population) -> Move:
        sites = population.trace.distributions
        choices = [a for a in population.trace.choices if support_of(sites[a]).is_discrete]
        # Without moves between them, resampling alone lets choices die out that the data does not tell apart.
        again = [metropolis_hastings(prior(choice)) for choice in choices]
        return sequence([shaped, *again])(population) if choices else shaped(population)

    return chosen_anew


def infer(
    model: Model,
    recording: Any,
    *,
    particles: int = 75,
    seed: int = 0,
    sweeps: tuple[int | Until, int | Until] | None = None,
    share: tuple[float, float] = (0.8, 0.6),
    climbs: int = 0,
    scene: Any = None,
    start: Step | None = None,
) -> Iterator[Step]:
    """Beliefs over a recording, one step for each measurement, the prior first.

    Args:
        model: what explains the recording.
        recording: a `bcppl.recordings.Recording`.
        particles: how many.
        seed: same seed, same beliefs.
        sweeps: moves of every particle after each resampling: without, and with physics in the program. By
            default 12 (6 where the model brings proposals of its own, which go farther), and until the
            particles' mean squared displacement is half their variance on every axis and four of five differ,
            at most 60.
        share: particles are resampled below this effective sample size, and a likelihood is let in by steps
            that keep this conditional one, as shares of N: without, and with physics.
        climbs: how many draws of the prior climb before a measurement is let in, to find the modes between
            which particles jump (`bcppl.inference.proposals.climbing`; it needs depth images). 0 for
            none.
        scene: what `model.prepare(recording)` gives, if it is at hand.
        start: a step to go on from, as `bcppl.inference.filters.smc.smc` does.

    Raises:
        InputError: a number is out of range.
    """
    particles = whole_number("SMC is to run {} particles", particles)
    for kept in share:
        number_within("a share of {} of the particles is to be kept", kept, least=0.0, below=1.0)
    enough = until(displacement=0.5, distinct=max(1, round(0.8 * particles)), most=60)
    climbing = whole_number("{} climbs are to find modes", climbs, least=0)
    if climbing and isinstance(model.program, Series):
        raise InputError("climbs find modes of one pose, and the model's is a series; give climbs=0.")
    moves = (6 if model.proposals else 12, enough) if sweeps is None else sweeps

    def by_physics(trace: Trace) -> int:
        return int(any(getattr(site, "cost", 0) >= PHYSICS for site in trace.distributions.values()))

    def resample(population: Population) -> tuple[Population, Tensor | None]:
        return adaptive(systematic, share[by_physics(population.trace)])(population)

    def step(population: Population, observed: Observed) -> Stepped:
        found = None
        if climbing:
            known = {**population.trace.observations, **observed.observations}
            climbers, _ = generate(model.program, observed.args, known, climbing)
            found = modes(climbers, model.pose)
        return tempered(
            kernel(model.pose, model.proposals, found),
            sweeps=lambda trace: moves[by_physics(trace)],
            resample=resample,
            share=lambda trace: share[by_physics(trace)],
        )(population, observed)

    return smc(model, recording, step=step, particles=particles, seed=seed, scene=scene, start=start)
