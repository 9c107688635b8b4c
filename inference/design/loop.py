"""Sequential design: plan candidates, rank them, execute the best, assimilate the measurement, and repeat.

In short, with any robot or world that executes plans:

    arm = BenchArm(scene)
    *_, last = guided_smc.infer(model, scene.look())
    planned = lambda belief, number: plan_candidates(belief, scene.part, scene.peg, seed=number)
    for each in probing_loop(model, scene.look(), arm, planned, start=last, probes=3):
        print(each.chosen.name, each.ranking.best.information_gain)
        last = each.step
    print(arm.insert(insertion_plan(last.belief, scene.part, scene.peg)))
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from bcppl.arguments import number_within, whole_number
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.inference.design.ranking import Ranking
from bcppl.inference.design.rules import AcquisitionRule, by_linearised_gain
from bcppl.inference.filters import guided_smc
from bcppl.inference.filters.smc import Step
from bcppl.inference.planning.candidate_layout import require_uncertain
from bcppl.inference.planning.constraints import Candidates, feasible, require_candidates
from bcppl.inference.planning.motion_constraints import duration_at_most
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
    """A robot, or a simulation of one such as `bcppl.models.worlds.bench.arm.BenchArm`."""

    def execute(self, candidate: Candidate) -> Sequence[Measurement]:
        """Execute a candidate and return its measurements.

        The windows of one probe with the plan's name, or an image of the view's camera.
        """


@dataclass(frozen=True, eq=False)
class Round:
    """One round of the loop.

    Attributes:
        number: from 0.
        candidates: that were ranked.
        ranking: of them.
        chosen: the candidate that was executed, under a name that no measurement before it has.
        recording: all measurements so far.
        before: the inference step before its measurements.
        step: the inference step after them.
        success_probability: of an insertion after it; NaN where it was not asked for.
    """

    number: int
    candidates: Sequence[Candidate]
    ranking: Ranking
    chosen: Candidate
    recording: Recording
    before: Step
    step: Step
    success_probability: float = math.nan


def probing_loop(
    model: Model,
    recording: Recording,
    world: World,
    candidates_from: CandidatesFrom,
    rule: AcquisitionRule | None = None,
    *,
    infer: Callable[..., Iterator[Step]] = guided_smc.infer,
    particles: int = 75,
    seed: int = 0,
    start: Step | None = None,
    probes: int = 3,
    seconds: float | None = None,
    minimum_gain: float | None = None,
    success_probability: Callable[[Belief], float] | None = None,
    sufficient: float = 0.95,
) -> Iterator[Round]:
    """Yields a round after each probe: candidates, the chosen one, its measurements and the posterior.

    Inference continues from the last step; nothing that was assimilated is computed again. Where the loop
    ends before the first probe, a warning gives the reason.

    Args:
        model: its program's arguments are its scene and the actions.
        recording: the measurements before the first probe.
        world: executes the chosen candidates.
        candidates_from: candidates for a belief and the round's number.
        rule: ranks candidates; None: `by_linearised_gain` of the model's pose.
        infer: assimilates measurements, such as `bcppl.inference.filters.guided_smc.infer`.
        particles: how many, without `start`.
        seed: of inference, without `start`.
        start: a step that has assimilated some or all of the recording.
        probes: the largest number of rounds.
        seconds: the largest duration of all plans together; plans that last longer than the time left are
            not ranked, and the loop ends where none is left.
        minimum_gain: nats; the loop ends where the best utility is smaller.
        success_probability: of an insertion under a belief, such as
            `bcppl.inference.planning.success.success_probability(...).success`; computed before the first
            probe and after each. Its error with few particles is larger than `1 - sufficient`: subtract its
            `standard_error`.
        sufficient: the success probability at which the loop ends.

    Raises:
        InputError: there are no candidates, or one is of no known type, or a plan needs a peg that the
            recording lacks; the belief has no weight or has collapsed to a point; a number is out of range;
            the world cannot execute, or gives no measurements, those of something else, or some that do not
            fit the recording; inference yields no step; a success probability is no number from 0 to 1;
            `minimum_gain` is given with a rule without expected gains.
    """
    whole_number("the loop is to make at most {} probes", probes)
    number_within("the loop is to end at a success probability of {}", sufficient, least=0.0, most=1.0)
    left = math.inf if seconds is None else number_within("the loop is given {} s", seconds, least=0.0)
    if minimum_gain is not None:
        number_within("the loop is to end below a gain of {}", minimum_gain)
    rule = by_linearised_gain(model.pose) if rule is None else rule

    def success(belief: Belief) -> float:
        if success_probability is None:
            return math.nan
        what = "the success probability of an insertion is {}"
        return number_within(what, success_probability(belief), least=0.0, most=1.0)

    scene = model.prepare(recording)
    step = _last(infer(model, recording, particles=particles, seed=seed, scene=scene, start=start), start)
    if (probability := success(step.belief)) >= sufficient:
        _ends_at_once(f"an insertion succeeds with a probability of {probability:.3g} as it is")
        return
    for number in range(probes):
        require_uncertain(step.belief)
        candidates = _checked_candidates(candidates_from(step.belief, number), recording)
        if math.isfinite(left):
            candidates = feasible(candidates, [duration_at_most(left)])
            if not candidates:
                if number == 0:
                    _ends_at_once(f"all candidates last longer than {left:.3g} s")
                return
        scene = model.prepare(with_candidates(recording, candidates))
        ranking = rule(step.population, candidates, scene)
        utility = ranking.best.value
        if minimum_gain is not None and math.isnan(utility):
            raise InputError(
                "the loop is to end below a minimum_gain, and its rule expects no gains; leave minimum_gain "
                "out, or rank by information gain."
            )
        if minimum_gain is not None and utility < minimum_gain:
            if number == 0:
                _ends_at_once(f"the best candidate has an expected utility of {utility:.3g} nats")
            return
        chosen = named_apart(ranking.best.candidate, recording)
        recording = _extended(recording, list(world.execute(chosen)), chosen)
        left = max(0.0, left - duration_of(chosen))
        scene, before = model.prepare(recording), step
        count = len(before.population)
        step = _last(infer(model, recording, particles=count, seed=seed, scene=scene, start=before), None)
        probability = success(step.belief)
        yield Round(number, candidates, ranking, chosen, recording, before, step, probability)
        if probability >= sufficient:
            return


def _last(steps: Iterator[Step], before: Step | None) -> Step:
    for each in steps:
        before = each
    if before is None:
        raise InputError("the loop's inference yields no step; give one that yields a step per measurement.")
    return before


def _ends_at_once(reason: str) -> None:
    warnings.warn(f"the loop ends before its first probe: {reason}.", stacklevel=3)


def _checked_candidates(given: Iterable[Candidate], recording: Recording) -> Candidates:
    candidates = given if isinstance(given, Candidates) else Candidates(tuple(given))
    for each in candidates:
        if planner_of(each).needs_peg and recording.peg is None:
            raise InputError(
                f"there is no peg to execute {name_of(each)!r} with; add the peg to the recording, or "
                "ask for views."
            )
    return require_candidates(candidates)


def _extended(recording: Recording, measurements: Sequence[Measurement], chosen: Candidate) -> Recording:
    """The recording with the measurements of a candidate, which must not add problems."""
    if not measurements:
        raise InputError(f"the world gave no measurement of {name_of(chosen)!r}.")
    for name in map(name_of, (each.action for each in measurements)):
        if name != name_of(chosen):
            raise InputError(
                f"the world was to execute {name_of(chosen)!r} and gave a measurement of {name!r}; give the "
                "windows of a probe with the plan's name, or an image of the view's camera."
            )
    longer = replace(recording, measurements=[*recording.measurements, *measurements])
    known = set(problems(recording))
    for problem in problems(longer):
        if problem not in known:
            raise InputError(f"the world's measurement of {name_of(chosen)!r} does not fit: {problem}")
    return longer
