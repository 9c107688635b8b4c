"""A belief that follows measurements as they arrive, from any thread.

    live = Filter(model, recording)
    robot.on_window(live.observe)  # returns at once
    live.belief.mean, live.next_probe().best.candidate, live.insertion()

All that runs the model's program runs in one thread, for Pyro's handlers are shared by all threads.
"""

from __future__ import annotations

import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any, Literal, TypeVar

from bcppl.arguments import number_within, whole_number
from bcppl.beliefs import Belief
from bcppl.errors import InferenceError, InputError
from bcppl.geometry.holes import Hole
from bcppl.inference.design.ranking import Ranking
from bcppl.inference.design.rules import AcquisitionRule, by_linearised_gain
from bcppl.inference.filters.default import default_inference
from bcppl.inference.filters.smc import Step
from bcppl.inference.live.refusing import refuse, refuse_part
from bcppl.inference.live.showing import COLUMNS, show, show_earlier
from bcppl.inference.live.updates import UpdateInfo, affordable, resized
from bcppl.inference.live.waiting import Waiting
from bcppl.inference.live.worker import Worker
from bcppl.inference.planning.candidate_layout import plan_candidates, require_uncertain
from bcppl.inference.planning.constraints import Candidates, Constraint, require_candidates
from bcppl.inference.planning.insertion import InsertionParameters, insertion_plan
from bcppl.robot.arm_with_peg import ArmWithPeg
from bcppl.robot.plan import InsertionPlan
from bcppl.sensors import Measurement, Recording
from bcppl.sensors.candidates import Candidate, named_apart, with_candidates
from bcppl.traces import Model
from bcppl.viewer.live import LivePage

KEPT = 1000  # updates

T = TypeVar("T")


class Filter:
    """A belief that follows measurements as they arrive.

    Measurements are assimilated one by one in a thread of the filter's own, which also ranks and plans. Where
    updates take longer than the deadline, windows of a probe that wait are assimilated as one, by the moves
    of one; where that is not enough, by half of the particles, and not by fewer than 20. Both are undone when
    updates are in time again, and every update states what it did.

    Args:
        model: what explains the measurements.
        recording: part, guess, peg, and the measurements made so far, which may be none.
        infer: an inference program; by default the model's own.
        particles: N.
        seed: same seed, same belief, if no update is late.
        deadline: seconds within which a measurement is to be assimilated.
        on_fault: whether a measurement that no particle explains, whose likelihood is no number, or whose
            kind the model does not explain is left out with a warning ("skip"), and so are the windows after
            it in its probe, or ends the filter ("stop").
        on_update: called in the filter's thread with the step and what the update did, after each; it may
            rank and plan, and must not `settle`.
        constraints: of the touches that `next_probe` plans (`bcppl.inference.planning.motion_constraints`).

    Raises:
        InputError: the recording has a problem, or a number is out of range.
    """

    def __init__(
        self,
        model: Model,
        recording: Recording,
        *,
        infer: Callable[..., Iterator[Step]] | None = None,
        particles: int = 75,
        seed: int = 0,
        deadline: float = 0.5,
        on_fault: Literal["skip", "stop"] = "skip",
        on_update: Callable[[Step, UpdateInfo], None] | None = None,
        constraints: Sequence[Constraint] = (),
    ) -> None:
        self.particles = whole_number("a live filter is to run {} particles", particles)
        self.deadline = number_within("a live filter has a deadline of {} s", deadline, above=0.0)
        if on_fault not in ("skip", "stop"):
            raise InputError(f"on_fault is {on_fault!r}; give 'skip' or 'stop'.")
        self.model, self.seed, self.constraints = model, seed, constraints
        self._infer = default_inference(model)[1] if infer is None else infer
        self._on_fault, self._on_update = on_fault, on_update
        self._recording = replace(recording, measurements=[])
        self._waiting = Waiting()
        self._changed = threading.Condition()
        self._updates: deque[UpdateInfo] = deque(maxlen=KEPT)
        self._pages: list[LivePage] = []
        self._shared: dict[str, dict[str, Any]] = {}  # by kind and name, such as cameras
        self._under_way = 0  # measurements
        self._arrived: list[Measurement] = []
        self._left_out = 0
        self._failed: BaseException | None = None
        self._thread = Worker()
        try:
            self._step = self._thread.submit(self._begin).result()
            for measurement in recording.measurements:
                self.observe(measurement.action, measurement.observation)
        except BaseException:
            self.close()
            raise

    # ---- what arrives

    def observe(self, action: Any, observation: Any) -> None:
        """Give the filter a measurement; it returns at once.

        Windows of a probe may arrive in any order, and wait for those before them.

        Raises:
            InputError: the measurement has a problem, or the filter is closed.
            InferenceError: an earlier one has ended the filter (`on_fault="stop"`).
            Exception: `on_update` has raised it, which ends the filter.
        """
        # What is observed is a copy: the caller may use its arrays again.
        measurement = Measurement(action, deepcopy(observation))
        refuse(measurement, self._recording, self._shared)
        with self._changed:
            self._raise_failure()
            self._waiting.add(measurement, time.monotonic())
            self._arrived.append(measurement)
        self._thread.submit(self._assimilate)

    # ---- what is known

    @property
    def belief(self) -> Belief:
        """Over the part's pose, given all that is assimilated."""
        return self._step.belief

    @property
    def step(self) -> Step:
        """The newest step of inference."""
        return self._step

    @property
    def recording(self) -> Recording:
        """What is assimilated, as a recording that `bcppl.save` writes."""
        return self._recording

    @property
    def arrived(self) -> Recording:
        """What has arrived, also what waits or was left out, in that order."""
        with self._changed:
            return replace(self._recording, measurements=list(self._arrived))

    @property
    def left_out(self) -> int:
        """How many measurements were left out; `updates` state why."""
        return self._left_out

    @property
    def updates(self) -> Sequence[UpdateInfo]:
        """The newest thousand updates."""
        with self._changed:
            return list(self._updates)

    @property
    def behind(self) -> int:
        """How many measurements are not assimilated, those included that wait for earlier windows."""
        return len(self._waiting) + self._under_way

    def settle(self, timeout: float | None = None) -> Step:
        """Wait until everything that can be is assimilated, and return the newest step.

        Args:
            timeout: seconds; None to wait as long as it takes.

        Raises:
            TimeoutError: it takes longer.
            InferenceError: a measurement has ended the filter.
            InputError: it is called within `on_update`, which runs in the thread that is waited for.

        Warns:
            RuntimeWarning: windows wait for earlier ones that have not come.
        """
        if self._thread.inside:
            raise InputError("on_update waits for the filter's thread, its own; settle in another thread.")
        self._run(lambda: None, timeout)
        if held := self._waiting.held_back():
            warnings.warn(
                f"{len(held)} measurements wait for earlier ones of the same probe, the first of them "
                f"{held[0].action!r}; what came before it has not arrived.",
                RuntimeWarning,
                stacklevel=2,
            )
        return self._step

    # ---- what to do

    def next_probe(
        self,
        candidates: Sequence[Candidate] | None = None,
        rule: AcquisitionRule | None = None,
        timeout: float | None = None,
    ) -> Ranking:
        """Candidates ranked for the newest belief, the best first.

        Args:
            candidates: by default touches that are planned around the belief's mean, within the constraints.
            rule: ranks them; by default the linearised expected information gain.
            timeout: seconds, after which `TimeoutError` is raised.

        Raises:
            InputError: no candidate is left, or the belief has collapsed.
            InferenceError: a measurement has ended the filter.
        """

        def ranked() -> Ranking:
            step, recording = self._step, self._recording
            require_uncertain(step.belief)
            listed = candidates
            if listed is None:
                assert recording.peg is not None
                solids = recording.part, recording.peg
                listed = plan_candidates(step.belief, *solids, constraints=self.constraints, seed=step.taken)
            own = listed if isinstance(listed, Candidates) else Candidates(tuple(listed))
            scene = self.model.prepare(with_candidates(recording, require_candidates(own)))
            return (rule or by_linearised_gain(self.model.pose))(step.population, own, scene)

        if candidates is None and self._recording.peg is None:
            raise InputError(
                "there is no peg to plan touches for; add it to the recording, or give candidates."
            )
        return self._run(ranked, timeout)

    def named_apart(self, candidate: Candidate, others: Collection[str] = ()) -> Candidate:
        """The candidate under a name that nothing which has arrived has, also if it was left out."""
        arrived = [name for things in self._shared.values() for name in list(things)]
        return named_apart(candidate, self._recording, [*arrived, *others])

    def insertion(
        self,
        parameters: InsertionParameters | None = None,
        timeout: float | None = None,
        hole: Hole | None = None,
    ) -> InsertionPlan:
        """A compliant insertion at the newest belief (`bcppl.inference.planning.insertion`).

        Of a part with several holes, `hole` is one of them (`bcppl.geometry.holes.hole_of`).

        Raises:
            InputError: there is no peg, the part has no hole, or several and none is given, or the peg does
                not fit.
            InferenceError: a measurement has ended the filter.
        """
        peg = self._recording.peg
        if peg is None:
            raise InputError("there is no peg to insert; add it to the recording.")
        plan = lambda: insertion_plan(self.belief, self._recording.part, peg, hole, parameters)  # noqa: E731
        return self._run(plan, timeout)

    def view(self, title: str = "", arm: ArmWithPeg | None = None) -> LivePage:
        """A page that follows in a browser: open its `url` on this machine.

        It begins after what waits, and steps from before are shown without their particles. What it shows is
        computed in a thread of its own; one that stalls is left.

        Args:
            title: of the page.
            arm: that holds the peg; it is drawn where the peg was measured.

        Raises:
            InferenceError: a measurement has ended the filter.
        """
        page = LivePage(self._recording, title, COLUMNS, arm)

        def begin() -> None:
            show_earlier(page, self._recording)
            show(page, self._step, self._recording)
            self._pages.append(page)

        try:
            self._run(begin, None)
        except BaseException:
            page.close()
            raise
        return page

    def close(self) -> None:
        """End the filter's thread, and its pages; what waits is not assimilated.

        Raises:
            InputError: it is called within `on_update`, which runs in the thread that is to end.
        """
        if self._thread.inside:
            raise InputError(
                "on_update closes the filter whose thread it runs in; close it in another thread."
            )
        self._thread.close()
        for page in self._pages:
            page.close()

    def __enter__(self) -> Filter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- in the filter's thread

    def _begin(self) -> Step:
        scene = self.model.prepare(self._recording)
        first = self._infer(
            self.model, self._recording, particles=self.particles, seed=self.seed, scene=scene
        )
        return next(iter(first))

    def _assimilate(self) -> None:
        """Assimilate everything that can be: a measurement may have been waited for by others."""
        while self._failed is None:
            with self._changed:
                late = bool(self._updates) and self._updates[-1].seconds > self.deadline
                taken = self._waiting.take(join=late)
                self._under_way = 0 if taken is None else taken.joined
            if taken is None:
                return
            try:
                self._update(*taken)
            except Exception as error:  # of a callback as well: the next call of `observe` or `settle` has it
                self._failed = error
            finally:
                self._under_way = 0

    def _update(self, measurement: Measurement, arrived: float, joined: int) -> None:
        before = self._step
        last = self._updates[-1] if self._updates else None
        count = affordable(last, joined, self.particles, self.deadline)
        recording = replace(self._recording, measurements=[*self._recording.measurements, measurement])
        fault = ""
        try:
            refuse_part(recording)
            start = resized(before, count)
            scene = self.model.prepare(recording)
            options = {"particles": count, "seed": self.seed, "scene": scene, "start": start}
            for step in self._infer(self.model, recording, **options):
                self._step, self._recording = step, recording
            if self._step is before:
                fault = f"{measurement.action!r} has been assimilated before: it is left out"
        except (InferenceError, InputError) as error:
            fault = str(error)
            self._step = before
            if self._on_fault == "stop":
                self._failed = error
            else:
                warnings.warn(f"{fault.rstrip('.')}: it is left out.", RuntimeWarning, stacklevel=1)
        update = UpdateInfo(joined, count, time.monotonic() - arrived, fault)
        with self._changed:
            self._updates.append(update)
            self._left_out += joined if fault else 0
        for page in self._pages if not fault else []:
            show(page, self._step, self._recording, update)
        if self._on_update is not None:
            self._on_update(self._step, update)

    def _run(self, what: Callable[[], T], timeout: float | None) -> T:
        """What is asked for, after all measurements that wait; within `on_update`, at once."""

        def asked() -> T:
            self._raise_failure()
            return what()

        def after_measurements() -> T:
            self._assimilate()  # those as well that have arrived since the request: no request is before them
            return asked()

        return asked() if self._thread.inside else self._thread.run(after_measurements, timeout)

    def _raise_failure(self) -> None:
        if self._failed is not None:
            raise self._failed
