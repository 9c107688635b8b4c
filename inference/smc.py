"""Sequential Monte Carlo over measurements, with tempering within a measurement and rejuvenation.

`tempered` makes the step that takes one measurement in: extend the traces, let the new likelihood in by
steps, resample and move the particles after each. `smc` is the loop over a recording, an iterator that can
be stopped, looked into and gone on with. Del Moral, Doucet and Jasra, Sequential Monte Carlo samplers, JRSS
B 68, 2006; Chopin and Papaspiliopoulos, An Introduction to Sequential Monte Carlo, 2020, chapter 17.

With fixed exponents and fixed proposals the estimate of the evidence is unbiased; with adaptive tempering
and fitted proposals it is consistent only. Evidence that contains a surrogate likelihood is a surrogate's.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl.beliefs import Belief
from bcppl.errors import InferenceError, InputError
from bcppl.inference.kernels import Kernel, rejuvenate
from bcppl.inference.population import Population
from bcppl.inference.resampling import Resample, adaptive
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.inference.tempering import next_exponent
from bcppl.traces import Model, Trace, extend, generate


class Info(NamedTuple):
    """What happened while one measurement was taken in.

    Attributes:
        label: the measurement's kind and number; time: seconds on the recording's clock, NaN if it has none.
        effective_sample_size, log_evidence, distinct: of the population afterwards.
        acceptance: the share of proposals accepted, NaN where nothing was moved.
        exponents: the steps by which the likelihood was let in; the last is 1.
        truth_gap: log-likelihood of the true pose minus that of the best particle, all measurements so far;
            NaN where the truth is not known.
        seconds: wall time.
        effort: by simulator's name, what it did for this measurement.
    """

    label: str
    time: float
    effective_sample_size: float
    log_evidence: float
    distinct: int
    acceptance: float
    exponents: tuple[float, ...]
    truth_gap: float
    seconds: float
    effort: Mapping[str, Any]


class Assimilated(NamedTuple):
    """A population that has taken a measurement in, the acceptance rate and the exponents gone through."""

    population: Population
    acceptance: float
    exponents: tuple[float, ...]


Assimilate = Callable[[Population, tuple[Any, ...], Mapping[str, Tensor]], Assimilated]


def tempered(
    kernel: Kernel | None = None,
    *,
    sweeps: int | Callable[[Trace], int] = 3,
    resample: Resample | None = None,
    share: float | Callable[[Trace], float] = 0.5,
) -> Assimilate:
    """How to take a measurement in: let its likelihood in by steps, resample and move after each.

    Args:
        kernel: moves the particles after each resampling; None leaves them where they are.
        sweeps: how many moves of every particle after each resampling, or a function of the trace.
        resample: when and how; by default systematic below half the effective sample size.
        share: tempering keeps the conditional effective sample size above this share of the particles;
            0 lets a likelihood in at once. A number, or a function of the trace, as `sweeps`.

    Returns:
        `assimilate(population, args, observations)`, with the program's arguments up to and including the new
        measurement, and the values of the new addresses. It raises InferenceError where no particle is left
        with any weight.

    Raises:
        InputError: `share` is not in [0, 1).
    """
    if not callable(share) and not 0.0 <= share < 1.0:
        raise InputError(
            f"tempering is asked to keep a share of {share} of the particles; give 0 up to below 1."
        )
    resample = adaptive() if resample is None else resample

    def assimilate(
        population: Population, args: tuple[Any, ...], observations: Mapping[str, Tensor]
    ) -> Assimilated:
        before = set(population.trace.addresses)
        longer, log_likelihood = extend(population.trace, args, observations)
        # Sites that the program itself fixes (`obs=`, `pyro.factor`) are let in with the observations.
        new = [a for a in longer.addresses if a not in before and a not in longer.choices]
        population = Population(longer, population.log_weights, population.log_evidence)
        exponent, exponents, acceptances = 0.0, [], []
        while exponent < 1.0:
            reached = exponent
            exponent = 1.0
            kept = share(population.trace) if callable(share) else share
            if kept > 0.0:
                exponent = next_exponent(population.log_weights, log_likelihood, reached, kept)
            exponents.append(exponent)
            # 0 times -inf is no number, so a particle that cannot be loses its weight here, once.
            population = population.reweighed((exponent - reached) * log_likelihood)
            population, resampled = resample(population)
            if resampled and kernel is not None:
                target = POSTERIOR if exponent == 1.0 else Target(dict.fromkeys(new, exponent))
                population, acceptance = rejuvenate(
                    population, kernel, target, sweeps(population.trace) if callable(sweeps) else sweeps
                )
                acceptances.append(acceptance)
            log_likelihood = population.trace.log_prob(*new) if new else torch.zeros_like(log_likelihood)
        acceptance = sum(acceptances) / len(acceptances) if acceptances else float("nan")
        return Assimilated(population, acceptance, tuple(exponents))

    return assimilate


# Below this many particles, sharing a tensor out among threads takes longer than working on it.
FEW_PARTICLES = 5000


@contextmanager
def _own_state(box: list[Tensor], particles: int) -> Iterator[None]:
    """Torch's generator and threads set to the run's own within, and the caller's put back afterwards."""
    outside, threads = torch.get_rng_state(), torch.get_num_threads()
    torch.set_rng_state(box[0])
    if particles < FEW_PARTICLES:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        box[0] = torch.get_rng_state()
        torch.set_rng_state(outside)
        torch.set_num_threads(threads)


class Step(NamedTuple):
    """What `smc` yields: the belief after a measurement, what happened, and the population to look into."""

    belief: Belief
    info: Info
    population: Population
    random_state: Tensor


def smc(
    model: Model,
    recording: Any,
    *,
    assimilate: Assimilate,
    particles: int = 75,
    seed: int = 0,
    scene: Any = None,
) -> Iterator[Step]:
    """Run SMC over a recording: yields the prior's belief first, then one step for each measurement.

    Args:
        model: what explains the recording.
        recording: a `bcppl.recordings.Recording`.
        assimilate: how one measurement is taken in, such as `tempered(...)`.
        particles: N.
        seed: same seed, same beliefs, bit for bit; torch's own generator is left as it was.
        scene: `model.prepare(recording)` unless given.

    Raises:
        InferenceError: no particle is left with any weight; names the measurement.
    """
    scene = model.prepare(recording) if scene is None else scene
    state = [torch.Generator().manual_seed(seed).get_state()]
    with _own_state(state, particles):
        trace, log_weights = generate(model.program, (scene, []), {}, particles)
    if model.pose not in trace:
        raise InputError(
            f"the model's pose is said to be at address {model.pose!r}, which its program never samples; "
            f"it samples {', '.join(trace.choices) or 'nothing'} before any measurement."
        )
    population = Population(trace, log_weights)
    # The truth draws from a generator of its own: a belief does not depend on whether it is known.
    aside = [torch.Generator().manual_seed(seed).get_state()]
    with _own_state(aside, 1):
        truth = _truth(model, scene, recording, trace)
    started = Info(
        "prior", float("nan"), float(particles), 0.0, particles, float("nan"), (), float("nan"), 0.0, {}
    )
    yield Step(population.belief(model.pose), started, population, state[0])
    for count, measurement in enumerate(recording.measurements, start=1):
        label = f"{measurement.kind} {count}"
        begun, before = time.perf_counter(), _effort(scene)
        measurements = recording.measurements[:count]
        new = _new(model.observe(scene, measurements), population.trace.observations)
        args = (scene, [m.action for m in measurements])
        try:
            with _own_state(state, particles):
                population, acceptance, exponents = assimilate(population, args, new)
        except InferenceError as error:
            raise InferenceError(f"{label}: {error}") from error
        belief = population.belief(model.pose)
        spent = {name: after.since(before[name]) for name, after in _effort(scene).items()}
        elapsed = time.perf_counter() - begun
        gap = float("nan")
        if set(population.trace.choices) != {model.pose}:
            truth = None
        if truth is not None:
            with _own_state(aside, 1):
                truth, _ = extend(truth, args, new)
            observed = list(population.trace.observations)
            best = population.trace.log_prob(*observed)[population.log_weights > -torch.inf].max()
            gap = float(truth.log_prob(*observed) - best)
        info = Info(
            label,
            _time(measurement),
            belief.effective_sample_size,
            population.log_evidence,
            belief.distinct,
            acceptance,
            exponents,
            gap,
            elapsed,
            spent,
        )
        yield Step(belief, info, population, state[0])


def _new(observations: Mapping[str, Tensor], known: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {a: v for a, v in observations.items() if a not in known}


def _truth(model: Model, scene: Any, recording: Any, trace: Any) -> Any:
    """One particle at the true pose, if it is known and the pose is all that is latent."""
    if recording.truth is None or set(trace.choices) != {model.pose}:
        return None
    pose = torch.as_tensor(recording.truth, dtype=torch.float64)[None]
    one, _ = generate(model.program, (scene, []), {}, 1)
    return one.at({model.pose: pose})


def _effort(scene: Any) -> dict[str, Any]:
    return {name: effort.copy() for name, effort in getattr(scene, "efforts", {}).items()}


def _time(measurement: Any) -> float:
    times = getattr(measurement.observation, "times", None)
    return float(times[-1]) if times is not None and len(times) else float("nan")
