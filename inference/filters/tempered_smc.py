"""The default inference program: tempered SMC, its moves fitted to the other particles.

    from itertools import islice

    from bcppl.inference import tempered_smc
    from bcppl.models import load_recording
    from bcppl.models.point_probe import model

    recording = load_recording("point_probe_10_pushes")
    for belief, info in islice(tempered_smc.infer(model, recording, particles=20, sweeps=2), 3):
        print(info.label, belief.mean)

Half of the moves are random walks, half are drawn from a normal that is fitted to the other half of the
particles. Where a move costs little (pushes, depth images), a measurement is tempered by small steps, with
many moves of every particle after each. Once moves cost simulations the steps are larger, and the particles
are moved until they are displaced from where they were resampled. Copy this file to write your own:
`bcppl run RECORDING --inference FILE.py` takes any file that defines `infer`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.distributions.support import freedom_of
from bcppl.errors import InputError
from bcppl.inference.filters.searching import Searching
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.step import Observed, Stepped
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.kernels import Kernel, Until, metropolis_hastings, mixture, sequence, until
from bcppl.inference.kernels.kernel import Move, takes
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift, independent, prior, spread_of
from bcppl.inference.proposals.climbing import Modes, jumps, modes
from bcppl.inference.proposals.coordinates import continuous_addresses
from bcppl.inference.proposals.walk import joint_drift
from bcppl.inference.targets import runs_physics
from bcppl.traces import Model, Program, Series, Trace, generate


def kernel(
    pose: str,
    proposals: Sequence[Program] = (),
    modes: Modes | None = None,
    along: Sequence[str] = (),
    conditional: Program | None = None,
) -> Kernel:
    """Random walks of a pose at two scales, and independent moves fitted to the other particles.

    Other continuous latent values (a camera's error, a grasp) walk alone, and together with the pose. Those
    that cannot, such as discrete ones (which of several holes it is), are redrawn from the program.

    Args:
        pose: its address.
        proposals: the model's own (`bcppl.traces.Model`); each is used once.
        modes: if given, a third of the moves of the pose are jumps to one of them.
        along: addresses that jump with the pose (`bcppl.inference.proposals.climbing.jumps`).
        conditional: a proposal of the pose given these.
    """
    # A fifth of the draws are three times as wide as the particles: few particles may have missed a mode.
    redrawn = independent(pose, 1, inflation=1.2, wide=(0.2, 3.0))
    far = [] if modes is None else [metropolis_hastings(jumps(pose, modes, along, conditional))]
    alone = mixture([metropolis_hastings(drift(pose, (0.2, 2.0))), metropolis_hastings(redrawn), *far])

    def move_of(population: Population) -> Move:
        others = [address for address in continuous_addresses(population.trace) if address != pose]
        if not others:
            return alone(population)
        each = [metropolis_hastings(drift(other, (0.2, 2.0))) for other in others]
        walk = metropolis_hastings(joint_drift(pose, *others, scales=(0.2, 2.0)))
        return sequence([alone, *each, walk])(population)

    def spreads(population: Population) -> dict[str, Tensor]:
        return {a: spread_of(a)(population) for a in continuous_addresses(population.trace)}

    given = [metropolis_hastings(p, *([spreads] if takes(p, 2) else [])) for p in proposals]
    shaped = sequence([move_of, *given]) if given else move_of

    def with_choices(population: Population) -> Move:
        walking = continuous_addresses(population.trace)
        # Without moves between them, resampling alone lets choices die out that the data cannot distinguish.
        redraws = [metropolis_hastings(prior(a)) for a in population.trace.choices if a not in walking]
        return sequence([shaped, *redraws])(population) if redraws else shaped(population)

    return with_choices


def infer(
    model: Model,
    recording: Any,
    *,
    particles: int = 75,
    seed: int = 0,
    sweeps: int | Until | None = None,
    share: float | None = None,
    climbs: int = 0,
    conditional: Program | None = None,
    search_climbs: int = 120,
    always_search: bool = False,
    scene: Any = None,
    start: Step | None = None,
) -> Iterator[Step]:
    """Beliefs over a recording: first the prior's, then one step for each measurement.

    Args:
        model: what explains the recording.
        recording: a `bcppl.recordings.Recording`.
        particles: N.
        seed: same seed, same beliefs.
        sweeps: moves of every particle after each resampling. By default 12 (6 where the model brings
            proposals of its own, which go farther); where the program simulates physics, until the particles'
            mean squared displacement is half their variance on every axis and four of five differ, at most
            60.
        share: particles are resampled below this effective sample size, and exponents keep this conditional
            one, as shares of N; by default 0.8, and 0.6 where the program simulates physics.
        climbs: number of draws of the prior that climb before a measurement is tempered, to find the modes
            between which particles jump (`bcppl.inference.proposals.climbing`; it needs depth images).
        conditional: where depth images depend on other latent poses than the sought one (those at which
            cameras that err see the part), a proposal of the sought pose given these, which jump.
        search_climbs: number of draws of the prior that climb where a measurement surprises all particles
            (`bcppl.inference.filters.searching`); 0 for no search.
        always_search: search at every measurement; with onsets of touches it costs less than tempering.
        scene: `model.prepare(recording)` unless given.
        start: a step to resume from, as for `bcppl.inference.smc`.

    Raises:
        InputError: a number is out of range.
    """
    particles = whole_number("SMC is to run {} particles", particles)
    if share is not None:
        number_within("a share of {} of the particles is to be kept", share, least=0.0, below=1.0)
    # A run that is resumed has the particles that it was begun with.
    most = max(1, round(0.8 * (particles if start is None else len(start.population))))
    enough = until(displacement=0.5, distinct=most, most=60)
    climbing = whole_number("{} climbs are to find modes", climbs, least=0)
    if climbing and isinstance(model.program, Series):
        raise InputError("climbs find modes of one pose, and the model's is a series; give climbs=0.")

    def moves(trace: Trace) -> int | Until:
        if sweeps is not None:
            return sweeps
        return enough if runs_physics(trace) else 6 if model.proposals else 12

    def kept(trace: Trace) -> float:
        return share if share is not None else 0.6 if runs_physics(trace) else 0.8

    def step(population: Population, observed: Observed) -> Stepped:
        centres, along = None, []
        if climbing:
            known = {**population.trace.observations, **observed.observations}
            climbers, _ = generate(model.program, observed.args, known, climbing)
            if conditional is not None:
                sites, pose = climbers.distributions, model.pose
                along = [a for a in climbers.choices if a != pose and freedom_of(sites[a]) is not None]
            centres = modes(climbers, model.pose, along)
        return tempered(
            kernel(model.pose, model.proposals, centres, along, conditional),
            sweeps=moves,
            share=kept,
        )(population, observed)

    if whole_number("{} climbs are to search", search_climbs, least=0) and not isinstance(
        model.program, Series
    ):
        near = partial(kernel, model.pose, model.proposals)
        apart = until(distinct=most, most=12)
        step = Searching(
            step, model.program, model.pose, near, climbs=search_climbs, sweeps=apart, always=always_search
        )
    return smc(model, recording, step=step, particles=particles, seed=seed, scene=scene, start=start)
