"""Sequential Monte Carlo over a recording: an iterator that can be paused, inspected and resumed.

One measurement is assimilated by a step (`bcppl.inference.filters.step`), such as `tempered(...)`. A program
without a recording is run by `bcppl.inference.filters.step.steps`.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl.arguments import seed_number, whole_number
from bcppl.beliefs import Belief
from bcppl.devices import (
    HOST,
    alone,
    device_named,
    on_device,
    random_state,
    seeded_state,
    set_random_state,
    to_device,
)
from bcppl.errors import InferenceError, InputError
from bcppl.inference.filters.step import Observed, StepFunction, StepInfo, refuse_no_step
from bcppl.inference.population import Population
from bcppl.inference.progress import watched
from bcppl.inference.verbs import initialize, observations_of
from bcppl.recordings import Recording, once_each, problems
from bcppl.traces import Model, Series, Trace, extend, generate


class Info(NamedTuple):
    """What happened while one measurement was assimilated.

    Attributes:
        label: the measurement's kind and number.
        time: seconds on the recording's clock, NaN if it has none.
        log_evidence: of all measurements so far.
        distinct: number of different poses among the particles with weight.
        truth_gap: log-likelihood of the true pose minus that of the best particle, all measurements so far;
            NaN where the truth is not known.
        seconds: wall time.
        effort: by simulator's name, its cost for this measurement.
        step: what the step itself reports.
    """

    label: str
    time: float
    log_evidence: float
    distinct: int
    truth_gap: float
    seconds: float
    effort: Mapping[str, Any]
    step: StepInfo

    @property
    def acceptance(self) -> float:
        """The share of proposals accepted, NaN where nothing was moved."""
        return self.step.acceptance

    @property
    def exponents(self) -> tuple[float, ...]:
        """The exponents of tempering; the last is 1."""
        return self.step.exponents

    @property
    def effective_sample_size(self) -> float:
        """Of the population afterwards."""
        return self.step.effective_sample_size


# Below this many particles, sharing a tensor out among threads takes longer than working on it.
FEW_PARTICLES = 5000


@contextmanager
def own_state(box: list[Tensor], particles: int, device: torch.device = HOST) -> Iterator[None]:
    """Torch's generators and threads set to the run's own within, and the caller's put back afterwards.

    What is made within is made on the device.
    """
    with alone():
        outside, threads = random_state(device), torch.get_num_threads()
        set_random_state(box[0], device)
        # On a GPU the processor has what is small.
        if particles < FEW_PARTICLES or device != HOST:
            torch.set_num_threads(1)
        try:
            with on_device(device):
                yield
        finally:
            box[0] = random_state(device)
            set_random_state(outside, device)
            torch.set_num_threads(threads)


@dataclass(frozen=True, eq=False)
class Step:
    """What `smc` yields: `for belief, info in smc(...)`, and the population behind them.

    Attributes:
        belief: over the sought pose.
        info: what happened.
        population: the particles, and the approximation that guides the filter.
        random_state: of torch's generator; with the population it is all that a run is resumed from.
        taken: number of measurements assimilated.
    """

    belief: Belief
    info: Info
    population: Population
    random_state: Tensor = field(repr=False)
    taken: int = 0

    def __iter__(self) -> Iterator[Any]:
        return iter((self.belief, self.info))


def smc(
    model: Model,
    recording: Any,
    *,
    step: StepFunction,
    particles: int = 75,
    seed: int = 0,
    scene: Any = None,
    start: Step | None = None,
    progress: bool = False,
    device: str | torch.device | None = None,
) -> Iterator[Step]:
    """Sequential Monte Carlo over a recording: the prior's belief first, then one step for each measurement.

    Args:
        model: what explains the recording.
        recording: a `bcppl.recordings.Recording`.
        step: assimilates one measurement, such as `tempered(...)`.
        particles: N.
        seed: same seed, same beliefs, bit for bit; torch's own generator is left as it was.
        scene: `model.prepare(recording)` unless given.
        start: resume from this step, with its particles and its random state: the steps after it are yielded,
            the same to the bit as those of the run that it was taken from.
        progress: show a bar, on a terminal or in a notebook, until the last step is made.
        device: where the particles are: "cpu" by default, or "cuda" (see `docs/gpu.md`). A run on a GPU draws
            other numbers than one on the processor; a run is resumed on the device that it was begun on.

    Raises:
        InferenceError: no particle is left with any weight; names the measurement.
        InputError: what is given is no step or no recording, the particles or the seed are no whole number,
            the program samples no pose at `model.pose`, `start` has assimilated more measurements than there
            are or was made on another device, or there is no such device.

    Warns:
        RuntimeWarning: the recording has a problem (`bcppl.recordings.problems`, checked where no scene is
            given): two cameras of one name, lengths in millimetres, times that decrease. The run continues;
            `bcppl run` refuses such a recording. Or a measurement repeats an earlier one, number by number:
            it is counted once.
    """
    refuse_no_step("smc", step)
    refuse_no_recording(recording)
    whole_number("SMC is to run {} particles", particles)
    seed_number(seed)
    recording = once_each(recording) if isinstance(recording, Recording) else recording
    steps = _steps(model, recording, step, particles, seed, scene, start, device_named(device))
    left = len(recording.measurements) + (1 if start is None else -start.taken)
    return watched(steps, total=left, describe=lambda each: each.info.label, progress=progress)


def refuse_no_recording(given: object) -> None:
    """Refuse what has no measurements, such as the path of a recording."""
    if not hasattr(given, "measurements"):
        raise InputError(
            f"inference is given a {type(given).__name__} in place of a recording; read one with bcppl.load."
        )


def _warn_of_problems(recording: Any) -> None:
    if not isinstance(recording, Recording) or not recording.measurements:
        return
    first, *others = problems(recording) or [""]
    if first:
        more = f" ({len(others)} more: bcppl.recordings.problems)" if others else ""
        warnings.warn(f"{first.rstrip('.')}{more}.", RuntimeWarning, stacklevel=4)


def _steps(
    model: Model,
    recording: Any,
    step: StepFunction,
    particles: int,
    seed: int,
    scene: Any,
    start: Step | None,
    device: torch.device,
) -> Iterator[Step]:
    if scene is None:
        _warn_of_problems(recording)
        scene = model.prepare(recording)
    scene = to_device(scene, device)
    measurements = recording.measurements
    if start is None:
        state = [seeded_state(seed, device)]
        with own_state(state, particles, device):
            population = initialize(model, scene, particles)
        if model.pose not in population.trace:
            raise InputError(
                f"the model's pose is at address {model.pose!r}, which its program never samples; "
                f"it samples {', '.join(population.trace.choices) or 'nothing'} before any measurement."
            )
        start = _prior(model, population, state[0])
        truth = _Truth(model, to_device(scene, HOST), recording, population, seed)
        yield start
    else:
        if start.taken > len(measurements):
            raise InputError(
                f"a run is to be resumed after {start.taken} measurements, but the recording has "
                f"{len(measurements)}; give the recording that it was run on."
            )
        if len(start.random_state) != len(seeded_state(seed, device)):
            raise InputError(
                f"a run is to be resumed on {device}, and was begun elsewhere; resume it on the same device."
            )
        state, population, particles = (
            [start.random_state],
            start.population.on(device),
            len(start.population),
        )
        truth = _Truth(model, to_device(scene, HOST), recording, population, seed)
        for observed in observations_of(model, scene, measurements[: start.taken]):
            truth.assimilate(observed)
    for count, observed in enumerate(
        observations_of(model, scene, measurements, start.taken), start.taken + 1
    ):
        measurement = measurements[count - 1]
        label = f"{measurement.kind} {count}"
        if not (observed.observations or isinstance(model.program, Series)):
            start = _unchanged(start, label, _time(measurement), population, state[0], count)
            yield start
            continue
        begun, before = time.perf_counter(), _effort(scene)
        try:
            with own_state(state, particles, device):
                population, happened = step(population, observed)
        except InferenceError as error:
            raise type(error)(f"{label}: {error}") from error
        belief = population.belief(model.pose)
        spent = {name: after.since(before[name]) for name, after in _effort(scene).items()}
        elapsed = time.perf_counter() - begun
        truth.assimilate(observed)
        gap = truth.gap(population)
        evidence, distinct = population.log_evidence, belief.distinct
        record = to_device(happened, HOST)
        info = Info(label, _time(measurement), evidence, distinct, gap, elapsed, spent, record)
        start = Step(belief, info, population, state[0], count)
        yield start


def _unchanged(
    before: Step, label: str, time: float, population: Population, random_state: Tensor, count: int
) -> Step:
    """The step of a measurement that adds nothing: the same particles."""
    happened = StepInfo(exponents=(), effective_sample_size=before.info.effective_sample_size)
    info = before.info._replace(label=label, time=time, seconds=0.0, effort={}, step=happened)
    return Step(before.belief, info, population, random_state, count)


def _prior(model: Model, population: Population, random_state: Tensor) -> Step:
    belief, nothing = population.belief(model.pose), math.nan
    happened = StepInfo(exponents=(), effective_sample_size=belief.effective_sample_size)
    evidence, count = population.log_evidence, len(population)
    info = Info("prior", nothing, evidence, count, nothing, 0.0, {}, happened)
    return Step(belief, info, population, random_state)


class _Truth:
    """One particle at the true pose, if that is known and the pose is all that is latent."""

    def __init__(self, model: Model, scene: Any, recording: Any, population: Population, seed: int) -> None:
        self.trace: Trace | None = None
        # Its generator is its own: a belief does not depend on whether the truth is known.
        self.state = [torch.Generator().manual_seed(seed).get_state()]
        self.latent = {model.pose}
        # A series' pose moves: one true pose is not where it began.
        moves = isinstance(model.program, Series)
        if recording.truth is None or moves or set(population.trace.choices) != self.latent:
            return
        pose = torch.as_tensor(recording.truth, dtype=torch.float64)[None]
        with own_state(self.state, 1):
            one, _ = generate(model.program, (scene, []), {}, 1)
            self.trace = one.at({model.pose: pose})

    def assimilate(self, observed: Observed) -> None:
        """Extend its trace."""
        if self.trace is not None:
            with own_state(self.state, 1):
                self.trace, _ = extend(self.trace, *to_device(observed, HOST))
            if set(self.trace.choices) != self.latent:
                self.trace = None

    def gap(self, population: Population) -> float:
        """Log-likelihood of the truth minus that of the best particle, NaN where the truth is not known."""
        if self.trace is None:
            return math.nan
        addresses = list(population.trace.observations)
        best = population.trace.log_prob(*addresses)[population.log_weights > -torch.inf].max()
        return float(self.trace.log_prob(*addresses) - best)


def _effort(scene: Any) -> dict[str, Any]:
    return {name: effort.copy() for name, effort in getattr(scene, "efforts", {}).items()}


def _time(measurement: Any) -> float:
    times = getattr(measurement.observation, "times", None)
    return float(times[-1]) if times is not None and len(times) else math.nan
