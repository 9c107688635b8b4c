"""The loop: look where to touch, touch there, take in what was felt, until it is enough; then insert.

In short, with any robot or world that carries out plans:

    arm = BenchArm(scene)
    *_, last = guided_smc.infer(model, scene.look())
    asked = lambda belief, number: candidates(belief, scene.part, scene.peg, seed=number)
    for each in probing_loop(model, scene.look(), arm, asked, start=last, probes=3):
        print(each.chosen.name, each.ranking.best.information_gain)
        last = each.step
    print(arm.insert(insertion_plan(last.belief, scene.part, scene.peg)))
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from bcppl.arguments import number_within, whole_number
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.inference.design.ranking import Ranking
from bcppl.inference.design.rules import Rank, by_information
from bcppl.inference.filters import guided_smc
from bcppl.inference.filters.smc import Step
from bcppl.inference.planning.candidate_list import refuse_settled
from bcppl.inference.planning.filters import (
    Candidates,
    no_longer_than,
    refuse_none,
    sifted,
)
from bcppl.recordings.check import problems
from bcppl.sensors import Measurement, Recording
from bcppl.sensors.candidates import (
    Candidate,
    duration_of,
    name_of,
    named_apart,
    planner_of,
    with_candidates,
)
from bcppl.traces import Model

# Candidates for a belief; the number counts rounds, from 0.
CandidatesFrom = Callable[[Belief, int], Sequence[Candidate]]


class World(Protocol):
    """What plays the robot: a simulation such as `bcppl.models.worlds.bench_arm.BenchArm`, or a real one."""

    def carry_out(self, candidate: Candidate) -> Sequence[Measurement]:
        """Do what is asked, and say what was measured.

        The windows of one probe with the plan's name, or an image of the view's camera.
        """


@dataclass(frozen=True, eq=False)
class Round:
    """One probe of the loop.

    Attributes:
        number: from 0.
        candidates: among which was chosen.
        ranking: of them.
        chosen: what was carried out, under a name that nothing before it has.
        recording: all that was measured so far.
        before: the last step before it.
        step: the last step after it.
        chance: of an insertion after it; NaN where it was not asked for.
    """

    number: int
    candidates: Sequence[Candidate]
    ranking: Ranking
    chosen: Candidate
    recording: Recording
    before: Step
    step: Step
    chance: float = math.nan


def probing_loop(
    model: Model,
    recording: Recording,
    world: World,
    candidates_from: CandidatesFrom,
    rank: Rank | None = None,
    *,
    infer: Callable[..., Iterator[Step]] = guided_smc.infer,
    particles: int = 75,
    seed: int = 0,
    start: Step | None = None,
    probes: int = 3,
    seconds: float | None = None,
    least_gain: float | None = None,
    chance: Callable[[Belief], float] | None = None,
    enough: float = 0.95,
) -> Iterator[Round]:
    """Choose, carry out, take in: yields after each probe.

    What was taken in is not computed again: inference goes on from the last step. Where it is over before the
    first probe a warning says why.

    Args:
        model: what explains the recording; its program's arguments are its scene and the actions.
        recording: what was measured before the first probe.
        world: carries out what is chosen.
        candidates_from: what may be done next, for a belief and the round's number.
        rank: puts candidates in order; None: `by_information` of the model's pose.
        infer: takes measurements in, from a step on, such as `bcppl.inference.filters.guided_smc.infer`.
        particles: how many, where there is no `start`.
        seed: of inference, where there is no `start`.
        start: a step that has taken in some or all of the recording.
        probes: at most so many.
        seconds: that all plans together last at most; those that last longer than what is left are not
            ranked, and where none is left it is over.
        least_gain: nats; where the best candidate is expected to tell less, less its cost, it is over.
        chance: of an insertion under a belief, such as `chance_of_success(...).success`; asked before the
            first probe and after each. Of few particles it errs by more than `enough` leaves: take its
            `error` off.
        enough: it is over once that chance reaches so much.

    Raises:
        InputError: there are no candidates, or what is given as one is none, or a plan needs a peg that the
            recording lacks; the belief has no weight or has collapsed to a point; a number is out of range;
            the world cannot carry out anything, or measured nothing, something else than was asked for or
            what does not fit the recording; inference took nothing in; a chance is no number from 0 to 1;
            `least_gain` is given with a rule that foretells no gains.
    """
    whole_number("the loop is to make {} probes at most", probes)
    number_within("an insertion is tried from a chance of {} on", enough, least=0.0, most=1.0)
    left = math.inf if seconds is None else number_within("the loop is given {} s", seconds, least=0.0)
    if least_gain is not None:
        number_within("the loop ends below a gain of {}", least_gain)
    if not callable(getattr(world, "carry_out", None)):
        raise InputError(
            f"the loop's world is a {type(world).__name__}, which cannot carry out anything; give one with "
            "`carry_out(candidate)`, such as bcppl.models.worlds.bench_arm.BenchArm."
        )
    rank = by_information(model.pose) if rank is None else rank
    for what, given in (("candidates_from", candidates_from), ("rank", rank), ("infer", infer)):
        if not callable(given):
            raise InputError(f"the loop's {what} is a {type(given).__name__}; give a function.")
    scene = model.prepare(recording)
    step = _last(infer(model, recording, particles=particles, seed=seed, scene=scene, start=start), start)
    if chance is not None and (likely := _likely(chance, step.belief)) >= enough:
        _nothing_done(f"an insertion succeeds with a chance of {likely:.3g} as it is")
        return
    for number in range(probes):
        refuse_settled(step.belief)
        found = _listed(candidates_from(step.belief, number), recording)
        if math.isfinite(left):
            found = sifted(found, [no_longer_than(left)])
            if not found:
                if number == 0:
                    _nothing_done(f"all candidates last longer than {left:.3g} s")
                return
        scene = model.prepare(with_candidates(recording, found))
        ranking = _ranked(rank(step.population, found, scene), least_gain is not None)
        if least_gain is not None and ranking.best.value < least_gain:
            if number == 0:
                _nothing_done(
                    f"the best candidate is expected to tell {ranking.best.value:.3g} nats, too few"
                )
            return
        chosen = named_apart(ranking.best.candidate, recording)
        measured = _measured(world.carry_out(chosen), chosen)
        left = max(0.0, left - duration_of(chosen))
        recording = _going_on(recording, measured, chosen)
        scene, before = model.prepare(recording), step
        count = len(before.population)
        step = _last(infer(model, recording, particles=count, seed=seed, scene=scene, start=before), None)
        likely = math.nan if chance is None else _likely(chance, step.belief)
        yield Round(number, found, ranking, chosen, recording, before, step, likely)
        if likely >= enough:
            return


def _last(steps: Iterator[Step], before: Step | None) -> Step:
    for each in steps:
        before = each
    if before is None:
        raise InputError(
            "the loop's inference yields no step, so that nothing was taken in; give one that yields a step "
            "for each measurement."
        )
    return before


def _nothing_done(why: str) -> None:
    warnings.warn(f"the loop is over before its first probe: {why}.", stacklevel=3)


def _ranked(ranking: object, foretold: bool) -> Ranking:
    if not isinstance(ranking, Ranking) or not len(ranking):
        raise InputError(
            f"the loop's rank gives a {type(ranking).__name__} that ranks nothing; give a function that "
            "returns a Ranking of the candidates, such as by_information(pose)."
        )
    if foretold and math.isnan(ranking.best.value):
        raise InputError(
            "the loop is to end below a least_gain, and its rank foretells no gains; leave least_gain out, "
            "or rank by information."
        )
    return ranking


def _likely(chance: Callable[[Belief], float], belief: Belief) -> float:
    return number_within("the chance of an insertion is said to be {}", chance(belief), least=0.0, most=1.0)


def _listed(found: object, recording: Recording) -> Sequence[Candidate]:
    """Candidates that may be indexed and gone through as often as is needed."""
    if not isinstance(found, Iterable) or isinstance(found, str):
        raise InputError(f"candidates are given as a {type(found).__name__}; give a list of plans and views.")
    listed = found if isinstance(found, Candidates) else tuple(found)
    for each in listed:
        if planner_of(each).needs_peg and recording.peg is None:
            raise InputError(
                f"there is no peg to carry out {name_of(each)!r} with; add the peg to the recording, or "
                "ask for views."
            )
    refuse_none(Candidates(tuple(listed)))
    return listed


def _measured(given: object, chosen: Candidate) -> list[Measurement]:
    measured: list[Any] = list(given) if isinstance(given, Iterable) else [given]
    if given is None or not measured:
        raise InputError(f"the world measured nothing when it was asked for {name_of(chosen)!r}.")
    for each in measured:
        if not isinstance(each, Measurement):
            raise InputError(
                f"the world gave a {type(each).__name__} when it was asked for {name_of(chosen)!r}; give "
                "measurements, each an action and what was observed."
            )
        name = name_of(each.action)
        if name != name_of(chosen):
            raise InputError(
                f"the world was asked for {name_of(chosen)!r} and gave a measurement of {name!r}; give the "
                "windows of a probe with the plan's name, or an image of the view's camera."
            )
    return measured


def _going_on(recording: Recording, measured: Sequence[Measurement], chosen: Candidate) -> Recording:
    """The recording with what was measured, which must leave it as sound as it was."""
    longer = replace(recording, measurements=[*recording.measurements, *measured])
    found = set(problems(recording))
    for problem in problems(longer):
        if problem not in found:
            raise InputError(f"what the world measured for {name_of(chosen)!r} does not fit: {problem}")
    return longer
