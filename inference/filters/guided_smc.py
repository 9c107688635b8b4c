"""SMC guided by a Gaussian approximation of the posterior, with tempering where the approximation is poor.

    from itertools import islice

    from bcppl.inference import guided_smc
    from bcppl.models import load_recording
    from bcppl.models.look_and_touch import model

    for belief, info in islice(guided_smc.infer(model, load_recording("peg_probe"), particles=20), 2):
        print(info.label, belief.mean)

A measurement is assimilated by SMCP3: a forward kernel moves particles to where the approximation places the
part given the new measurement, and the weights correct for it. That spares the many small steps by which
tempering assimilates a sharp likelihood. Where too few particles keep weight, the step is undone and the
likelihood is tempered.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.devices import HOST, same_random_state, to_device
from bcppl.inference.approximations.approximation import Approximation
from bcppl.inference.approximations.gaussian import GaussianApproximation
from bcppl.inference.filters.assimilation import assimilate, assimilate_screened
from bcppl.inference.filters.screening import approximated, by_mode
from bcppl.inference.filters.second_search import Searched, searched
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.smcp3 import Pair
from bcppl.inference.filters.step import (
    Assimilated,
    Observed,
    StepFunction,
    StepInfo,
    Stepped,
    descended,
)
from bcppl.inference.filters.tempered_smc import kernel as fitted_moves
from bcppl.inference.filters.tempering import Rejuvenated, resample_move, tempered
from bcppl.inference.filters.view_search import is_refuted, searched_by_climbing
from bcppl.inference.kernels import Kernel, composed, metropolis_hastings, sequence, surrogate_transition
from bcppl.inference.kernels.rejuvenation import Moved, Until, moved_by, until
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift, prior
from bcppl.inference.proposals.approximated import (
    backward_kernel,
    conditional_proposal,
    forward_kernel,
    independent_proposal,
    joint_proposal,
    joint_random_walk,
)
from bcppl.inference.proposals.coordinates import continuous_addresses
from bcppl.inference.targets import POSTERIOR, Target, runs_physics
from bcppl.sensors.capabilities import Defers, FitsPose, Linearised
from bcppl.traces import Model, Program, Trace, extend

WALK = (0.2, 2.0)  # scales of the random walks
CERTAIN = 0.01  # nats: a log-likelihood as small for all particles carries no information
ASKED = 4  # particles that are evaluated first for that
# Particles and copies where images leave several modes: of 75 particles 20 stay effective, too few for the
# modes' shares.
SEVERAL = 1800
# Of an approximation, where a prior's limits do not matter: a box is no Gaussian, and particles in its
# corners had too little weight, for any number of them. Where less lies inside, the measurement is tempered.
INSIDE = 0.75
ALL = 0.99  # the same, from which on nothing is made of the limits
# Sweeps are made until the poses are displaced by so many variances, and no more than so many: one displaces
# them by .2 to 1 where touches tell them, and by less along a bent ridge such as a peg wedged in a hole
# leaves. There particles died out along it from window to window, and what was left was sure of a part.
DISPLACED, MOST_SWEEPS = 0.5, 6
UNGUIDED = 12  # sweeps after each exponent where nothing approximates a measurement, as of `tempered_smc`
# Where physics decides about moves, and few particles were left to it, many of their copies stay where they
# are, as at the end of `peg_probe`. So as large a share of the poses is to differ, too.
DISTINCT = 0.75


def gaussian_pair(before: Any, after: Any, action: Any) -> Pair:
    """Forward and backward kernels of one measurement, of Gaussian approximations without and with it."""
    forward, backward = forward_kernel(before, after, action), backward_kernel(before, after, action)
    return Pair(forward, backward, inside=before.share_inside(action) > ALL)


def gaussian_proposals(approximation: Any) -> Sequence[Program]:
    """Proposals of Metropolis-Hastings moves: one that is made in every sweep, then others."""
    return (
        joint_proposal(approximation),
        conditional_proposal(approximation),
        joint_random_walk(approximation),
    )


def kernel(pose: str, proposals: Callable[[Any], Sequence[Program]], *, screen: bool = True) -> Kernel:
    """A random walk of one other latent value, and two of the approximation's proposals.

    One that cannot walk, such as a discrete one, is redrawn from the program.

    `proposals` are those that go with the approximation that the population carries: the first is made in
    every sweep, and one of the others; a random walk of the pose where there are none. Where the program runs
    physics and these are to `screen`, they move by what is approximated (`approximated`), and physics decides
    once about where they have led.
    """

    def drawn(population: Population) -> Kernel:
        walking = continuous_addresses(population.trace)
        others = [address for address in population.trace.choices if address != pose]
        walks = [metropolis_hastings(drift(a, WALK) if a in walking else prior(a)) for a in others]
        of_pose: list[Any] = [*proposals(population.approximation)] or [drift(pose, WALK)]
        first, *further = (metropolis_hastings(proposal) for proposal in of_pose)
        guided = [first, *_one_of(further)]
        if screen and runs_physics(population.trace):
            # There and back: an order that all particles share is reversible only so.
            guided = [surrogate_transition(sequence([*guided, *reversed(guided[:-1])]), approximated)]
        return sequence([*_one_of(walks), *guided])

    return composed(drawn)


def _one_of(kernels: Sequence[Kernel]) -> list[Kernel]:
    """One for all particles: chosen for each, every one would have to run."""
    return [kernels[int(torch.randint(len(kernels), ()))]] if kernels else []


def guided(
    start: Callable[[Any], Approximation],
    pair: Callable[[Any, Any, Any], Pair],
    moves: Kernel,
    *,
    sweeps: int | Until = 1,
    threshold: float = 0.5,
    screen: bool = True,
    search: Callable[[Population, Trace], Searched] | None = None,
    otherwise: StepFunction | None = None,
) -> StepFunction:
    """A step that assimilates a measurement by SMCP3, resamples when needed, and moves the particles.

    Args:
        start: the approximation before any measurement, given the program's first argument.
        pair: the kernels of one measurement, given the approximations without and with it and the action.
        moves: of every particle after each step.
        sweeps: how many of them, or `until(...)`.
        threshold: particles are resampled below this effective sample size, as a share of N.
        screen: whether a cheap likelihood of what is simulated chooses among copies of the particles and
            moves them before each is simulated, where physics says little beyond that likelihood.
        search: given the population after each step and the trace before it, returns that population or
            another that takes its place, and where its particles come from.
        otherwise: assimilates in place of this step once a measurement is of a kind that nothing
            approximates, as the likelihoods of a `bcppl.sensors.Scene` tell.
    """

    def resample(population: Population) -> tuple[Population, Tensor | None]:
        if population.effective_sample_size >= threshold * len(population):
            return population, None
        ancestors = by_mode(population, len(population))
        return population.selected(ancestors), ancestors

    def until_distinct(trace: Trace) -> int | Until:
        if isinstance(sweeps, Until) and runs_physics(trace):
            return replace(sweeps, distinct=math.ceil(DISTINCT * trace.particles))
        return sweeps

    rejuvenation = resample_move(moves, until_distinct, resample, always_move=True)

    def cheaply(population: Population, target: Target) -> Moved:
        return moved_by(population, moves, target, sweeps)

    def rejuvenated(assimilated: Assimilated) -> Rejuvenated:
        if assimilated.moved is None:
            return rejuvenation(assimilated.population, POSTERIOR)
        _, acceptance, displacement = assimilated.moved
        return Rejuvenated(assimilated.population, None, acceptance, displacement)

    doubled = 2 if isinstance(sweeps, Until) else 2 * sweeps
    by_tempering = tempered(moves, sweeps=doubled, resample=resample)

    def step(population: Population, observed: Observed) -> Stepped:
        scene, actions = observed.args
        action, values = actions[-1], {**population.trace.observations, **observed.observations}
        before = population.approximation
        if before is None:
            before = _given_all(start(scene), population.trace, actions[:-1])
        certain = _certain(population, observed, before.is_far(scene, len(actions) - 1, action, values))
        if certain is not None:
            later = before.deferring(scene, len(actions) - 1, action, values)
            return Stepped(certain.with_approximation(later), _info(population, certain))
        before = before.updated()
        after = before.including(scene, len(actions) - 1, action, values)
        population = population.with_approximation(after)
        if otherwise is not None and not all(map(_is_approximated, scene.likelihoods_of(actions))):
            return settled(otherwise(population, observed), population.trace)
        least = math.ceil(SEVERAL / len(population)) if after.is_ambiguous else 1
        kernels = pair(before, after, action)
        screens = screen and any(after.screens(each) for each in actions)
        if screens:
            assimilated = assimilate_screened(
                population, before, observed, kernels, cheaply, threshold, least
            )
        elif before.share_inside(action) < INSIDE:
            assimilated = None
        else:
            assimilated = assimilate(population, observed, kernels, least)
        if assimilated is None:
            return settled(by_tempering(population, observed), population.trace)
        moved, ancestors, acceptance, displaced = rejuvenated(assimilated)
        info = _info(population, moved, assimilated, acceptance, ancestors)._replace(displacement=displaced)
        return settled(Stepped(moved, info), population.trace)

    def settled(stepped: Stepped, before: Trace) -> Stepped:
        population, info = stepped
        other, chosen = Searched(population) if search is None else search(population, before)
        if other is population:
            return stepped
        if chosen is not None:
            info = info._replace(
                resampled=info.resampled + 1,
                effective_sample_size_before=population.effective_sample_size,
                ancestors=descended(info.ancestors, chosen, len(population)),
            )
        gained = other.log_evidence - population.log_evidence
        # Nothing is resampled: all weigh alike, or as before the search.
        other = rejuvenation(other, POSTERIOR).population
        size = other.effective_sample_size
        return Stepped(
            other, info._replace(log_evidence=info.log_evidence + gained, effective_sample_size=size)
        )

    return step


def _is_approximated(sensor: Any) -> bool:
    return isinstance(sensor, FitsPose | Linearised | Defers)


def _given_all(approximation: Any, trace: Trace, actions: Sequence[Any]) -> Any:
    """The approximation given the measurements that a trace already holds."""
    for number, action in enumerate(actions):
        sensor = trace.args[0].sensor(action)
        if not (isinstance(sensor, Defers) and sensor.is_deferred(action)):
            approximation = approximation.including(trace.args[0], number, action, trace.observations)
    return approximation


def _certain(population: Population, observed: Observed, far: bool) -> Population | None:
    """The particles as they are, where all predict the measurement with certainty; None where not.

    Where it is made `far` from the part, it is enough that all predict it equally well. Elsewhere that may
    mean that all predict it badly.
    """
    alive = (population.log_weights > -torch.inf).nonzero()[:, 0]
    few = population.trace.chosen(alive[:ASKED])
    with same_random_state():
        longer, gained = extend(few, *observed)
    if len(longer.choices) == len(few.choices) and not _equal(gained, far):
        return None  # the usual case, decided by a few particles
    longer, gained = extend(population.trace, *observed)
    if len(longer.choices) > len(population.trace.choices):
        return None
    return population.with_trace(longer).reweighed(gained) if _equal(gained[alive], far) else None


def _equal(log_likelihood: Tensor, far: bool) -> bool:
    return bool((log_likelihood - (log_likelihood[:1] if far else 0.0)).abs().lt(CERTAIN).all())


def _info(
    before: Population,
    after: Population,
    assimilated: Assimilated | None = None,
    acceptance: float | None = None,
    ancestors: Tensor | None = None,
) -> StepInfo:
    if assimilated is not None and assimilated.origin is not None:
        ancestors = assimilated.origin if ancestors is None else assimilated.origin[ancestors]
    reached = after.effective_sample_size if assimilated is None else assimilated.effective
    return StepInfo(
        acceptance=math.nan if acceptance is None else acceptance,
        resampled=int(ancestors is not None),
        effective_sample_size_before=reached,
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
    sweeps: int | None = None,
    threshold: float = 0.5,
    screen: bool = True,
    scene: Any = None,
    start: Step | None = None,
    device: str | torch.device | None = None,
) -> Iterator[Step]:
    """Beliefs over a recording: first the prior's, then one step for each measurement.

    Args:
        model: its scene is one of sensors (`bcppl.sensors.Scene`).
        recording: a `bcppl.recordings.Recording`.
        particles: N.
        seed: same seed, same beliefs.
        sweeps: moves of every particle after each measurement; by default until the part's poses have left
            where they were, by `DISPLACED` variances along each axis, and at most `MOST_SWEEPS`.
        threshold: particles are resampled below this effective sample size, as a share of N.
        screen: whether a cheap likelihood of what is simulated chooses among copies of the particles and
            decides about their moves first (`bcppl.inference.filters.screening`), where the model has one.
        scene: `model.prepare(recording)` unless given.
        start: a step to continue from, as for `bcppl.inference.smc`.
        device: where the particles are, as for `bcppl.inference.smc`.

    Raises:
        InputError: a number is out of range, the model's scene is not made of sensors, or there is no such
            device.
    """
    particles = whole_number("SMC is to run {} particles", particles)
    if sweeps is not None:
        sweeps = whole_number("SMC is to make {} sweeps", sweeps)
    threshold = number_within(
        "particles are to be resampled below a share of {}", threshold, least=0.0, most=1.0
    )

    def gaussian(scene: Any) -> GaussianApproximation:
        return GaussianApproximation(model.pose, to_device(scene, HOST))

    if scene is not None:
        gaussian(scene)  # refuses a prior that it cannot approximate before anything is computed
    moves = kernel(model.pose, gaussian_proposals, screen=screen)

    def refitted(trace: Trace, near: Tensor) -> GaussianApproximation:
        scene, actions = trace.args
        again: GaussianApproximation = _given_all(replace(gaussian(scene), near=near), trace, actions)
        return replace(again, near=None)

    def search(population: Population, before: Trace) -> Searched:
        scene, actions = population.trace.args
        if isinstance(scene.sensor(actions[-1]), FitsPose):
            new = population.trace.since(before)
            if is_refuted(population, new):
                return searched_by_climbing(population, model.pose, refitted, independent_proposal)
        return searched(population, independent_proposal)

    times = sweeps or until(displacement=DISPLACED, of=(model.pose,), most=MOST_SWEEPS)
    step = guided(
        gaussian,
        gaussian_pair,
        moves,
        sweeps=times,
        threshold=threshold,
        screen=screen,
        search=search,
        otherwise=tempered(fitted_moves(model.pose), sweeps=UNGUIDED, share=0.8),
    )
    return smc(
        model, recording, step=step, particles=particles, seed=seed, scene=scene, start=start, device=device
    )
