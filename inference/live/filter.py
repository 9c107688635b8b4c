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
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

from bcppl.arguments import number_within, whole_number
from bcppl.beliefs import Belief
from bcppl.errors import InferenceError, InputError
from bcppl.inference.design.ranking import Ranking
from bcppl.inference.design.rules import AcquisitionRule, by_linearised_gain
from bcppl.inference.filters.default import default_inference
from bcppl.inference.filters.smc import Step, own_state
from bcppl.inference.live.showing import COLUMNS, show, show_earlier
from bcppl.inference.live.waiting import Waiting
from bcppl.inference.planning.candidate_layout import plan_candidates, require_uncertain
from bcppl.inference.planning.constraints import Candidates, require_candidates
from bcppl.inference.planning.insertion import InsertionParameters, insertion_plan
from bcppl.inference.sizing import resize
from bcppl.robot.arm_with_peg import ArmWithPeg
from bcppl.robot.plan import InsertionPlan
from bcppl.sensors import Measurement, Recording, checks
from bcppl.sensors.candidates import Candidate, with_candidates
from bcppl.sensors.layout import link
from bcppl.sensors.protocol import InParts, sensor_for
from bcppl.traces import Model
from bcppl.viewer.live import LivePage

FEWEST = 20  # particles, that no deadline takes
KEPT = 1000  # updates
AHEAD = 0.5  # of the deadline: a faster update may have more particles

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class UpdateInfo:
    """What one update of a live belief did.

    Attributes:
        joined: how many measurements it assimilated as one.
        particles: how many it was made with.
        seconds: from the arrival of the last of them until the belief had it.
        fault: why they are left out; empty where they are not.
    """

    joined: int
    particles: int
    seconds: float
    fault: str = ""


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
            kind the model does not explain is left out with a warning ("skip") or ends the filter ("stop").
        on_update: called in the filter's thread with the step and what the update did, after each.

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
    ) -> None:
        self.particles = whole_number("a live filter is to run {} particles", particles)
        self.deadline = number_within("a live filter has a deadline of {} s", deadline, above=0.0)
        if on_fault not in ("skip", "stop"):
            raise InputError(f"on_fault is {on_fault!r}; give 'skip' or 'stop'.")
        self.model, self.seed = model, seed
        self._infer = default_inference(model)[1] if infer is None else infer
        self._on_fault, self._on_update = on_fault, on_update
        self._recording = replace(recording, measurements=[])
        self._waiting = Waiting()
        self._changed = threading.Condition()
        self._updates: deque[UpdateInfo] = deque(maxlen=KEPT)
        self._pages: list[LivePage] = []
        self._shared: dict[str, dict[str, Any]] = {}  # by kind and name, such as cameras
        self._failed: BaseException | None = None
        self._thread = ThreadPoolExecutor(1, "bcppl live")
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
        measurement = Measurement(action, observation)
        self._refuse(measurement)
        with self._changed:
            self._raise_failure()
            self._waiting.add(measurement, time.monotonic())
        self._submit(self._assimilate)

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
    def updates(self) -> Sequence[UpdateInfo]:
        """The newest thousand updates."""
        with self._changed:
            return list(self._updates)

    @property
    def behind(self) -> int:
        """How many measurements wait, those included that wait for earlier windows."""
        return len(self._waiting)

    def settle(self, timeout: float | None = None) -> Step:
        """Wait until everything that can be is assimilated, and return the newest step.

        Args:
            timeout: seconds; None to wait as long as it takes.

        Raises:
            TimeoutError: it takes longer.
            InferenceError: a measurement has ended the filter.

        Warns:
            RuntimeWarning: windows wait for earlier ones that have not come.
        """
        self._run(lambda: None, timeout)
        self._raise_failure()
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
            candidates: by default touches that are planned around the belief's mean.
            rule: ranks them; by default the linearised expected information gain.
            timeout: seconds, after which `TimeoutError` is raised.

        Raises:
            InputError: no candidate is left, or the belief has collapsed.
        """

        def ranked() -> Ranking:
            step, recording = self._step, self._recording
            require_uncertain(step.belief)
            listed = candidates
            if listed is None:
                assert recording.peg is not None
                listed = plan_candidates(step.belief, recording.part, recording.peg, seed=step.taken)
            own = listed if isinstance(listed, Candidates) else Candidates(tuple(listed))
            scene = self.model.prepare(with_candidates(recording, require_candidates(own)))
            return (rule or by_linearised_gain(self.model.pose))(step.population, own, scene)

        if candidates is None and self._recording.peg is None:
            raise InputError(
                "there is no peg to plan touches for; add it to the recording, or give candidates."
            )
        return self._run(ranked, timeout)

    def insertion(
        self, parameters: InsertionParameters | None = None, timeout: float | None = None
    ) -> InsertionPlan:
        """A compliant insertion at the newest belief (`bcppl.inference.planning.insertion`).

        Raises:
            InputError: there is no peg, the part has no hole or several, or the peg does not fit.
        """
        peg = self._recording.peg
        if peg is None:
            raise InputError("there is no peg to insert; add it to the recording.")
        plan = lambda: insertion_plan(self.belief, self._recording.part, peg, parameters=parameters)  # noqa: E731
        return self._run(plan, timeout)

    def view(self, title: str = "", arm: ArmWithPeg | None = None) -> LivePage:
        """A page that follows in a browser: open its `url` on this machine.

        It begins after what waits, and steps from before are shown without their particles. What it shows is
        computed in a thread of its own; one that stalls is left.

        Args:
            title: of the page.
            arm: that holds the peg; it is drawn where the peg was measured.
        """
        page = LivePage(self._recording, title, COLUMNS, arm)

        def begin() -> None:
            show_earlier(page, self._recording)
            show(page, self._step, self._recording)
            self._pages.append(page)

        self._run(begin, None)
        return page

    def close(self) -> None:
        """End the filter's thread, and its pages; what waits is not assimilated."""
        self._thread.shutdown(wait=True, cancel_futures=True)
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
            if taken is None:
                return
            try:
                self._update(*taken)
            except Exception as error:  # of a callback as well: the next call of `observe` or `settle` has it
                self._failed = error

    def _update(self, measurement: Measurement, arrived: float, joined: int) -> None:
        before, count = self._step, self._affordable(joined)
        recording = replace(self._recording, measurements=[*self._recording.measurements, measurement])
        fault = ""
        try:
            start = resized(before, count)
            scene = self.model.prepare(recording)
            options = {"particles": count, "seed": self.seed, "scene": scene, "start": start}
            for step in self._infer(self.model, recording, **options):
                self._step, self._recording = step, recording
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
        for page in self._pages if not fault else []:
            show(page, self._step, self._recording, update)
        if self._on_update is not None:
            self._on_update(self._step, update)

    def _affordable(self, joined: int) -> int:
        """How many particles the next update is made with, by how long the last one took."""
        last = self._updates[-1] if self._updates else None
        if last is None:
            return self.particles
        if last.seconds > 2.0 * self.deadline and last.joined > 1 and joined > 1:
            return max(min(FEWEST, self.particles), last.particles // 2)
        if last.seconds < AHEAD * self.deadline:
            return min(self.particles, 2 * last.particles)
        return last.particles

    def _run(self, what: Callable[[], T], timeout: float | None) -> T:
        return self._submit(what).result(timeout)

    def _submit(self, what: Callable[[], T]) -> Future[T]:
        try:
            return self._thread.submit(what)
        except RuntimeError as error:
            raise InputError("the live filter is closed; begin another with its recording.") from error

    def _raise_failure(self) -> None:
        if self._failed is not None:
            raise self._failed

    def _refuse(self, measurement: Measurement) -> None:
        """Refuse a measurement that is wrong by itself."""
        sensor = sensor_for(measurement)
        alone = sensor.alone(measurement) if isinstance(sensor, InParts) else measurement
        number = len(self._recording.measurements)
        for _, problem in sensor.problems([(number, alone)], self._recording):
            raise InputError(problem)
        for name, kept in sensor.action.fields.items():
            if kept.group:
                thing = getattr(measurement.action, name)
                link(thing.name)  # refuses an empty one
                known = self._shared.setdefault(kept.group, {})
                for problem in checks.named_alike(f"measurement {number}", kept.group, thing, known):
                    raise InputError(problem)


def resized(step: Step, count: int) -> Step:
    """A step with another number of particles, drawn by its own random state."""
    if len(step.population) == count:
        return step
    state = [step.random_state]
    with own_state(state, count):
        population = resize(step.population, count)
    return replace(step, population=population, random_state=state[0])
