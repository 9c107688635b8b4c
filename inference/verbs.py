"""Verbs on populations; a filter is a loop over them.

    scene = model.prepare(recording)
    population = initialize(model, scene, particles=75)
    for observed in observations_of(model, scene, recording.measurements):
        population = update(population, observed)
        if population.effective_sample_size < 40:
            population = rejuvenate(resample(population), kernel)

Others change the number of particles: `resize`, `replicate` and `merge` (`bcppl.inference.sizing`). They draw
from torch's generator. The loop `bcppl.inference.smc` adds to these a seed of its own, records of each step,
and resuming. GenParticleFilters.jl has the same verbs (`pf_initialize`, `pf_update!`, `pf_resample!`,
`pf_rejuvenate!`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from bcppl.errors import InputError
from bcppl.inference.filters.smcp3 import Pair, move_and_weight
from bcppl.inference.filters.step import Observed
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import Kernel, Until, moved_by
from bcppl.inference.population import Population, refuse_no_population
from bcppl.inference.resampling import Scheme, systematic
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.sensors.capabilities import Defers
from bcppl.traces import Model, Series, extend


def initialize(model: Model, scene: Any, particles: int = 75) -> Population:
    """Particles of a model's prior, before any measurement.

    For any program, with observations or a proposal of its own, there is `importance_sampling`.

    Args:
        model: its program is run.
        scene: `model.prepare(recording)`.
        particles: N.

    Raises:
        InputError: the number of particles is no whole number, 1 or more.
    """
    return importance_sampling(model.program, (scene, []), {}, particles)


def observations_of(
    model: Model, scene: Any, measurements: Sequence[Any], start: int = 0
) -> Iterator[Observed]:
    """What each measurement adds: the program's arguments up to it, and the observations at new addresses.

    Args:
        model: maps measurements to observations.
        scene: `model.prepare(recording)`.
        measurements: of the recording, in the order in which they are assimilated.
        start: number of measurements that the population has assimilated.

    Raises:
        InputError: a measurement gives no observation at a new address.
    """
    # A step of a series is given the newest measurement alone, under its own addresses, and may have none.
    alone = isinstance(model.program, Series)
    known = set(model.observe(scene, measurements[:start])) if start and not alone else set()
    for count in range(start + 1, len(measurements) + 1):
        given = measurements[count - 1 if alone else 0 : count]
        if not alone and _is_deferred(scene, given[-1]):
            yield Observed((scene, [each.action for each in given]), {})
            continue
        new = {a: value for a, value in model.observe(scene, given).items() if a not in known}
        if not (new or alone):
            raise InputError(
                f"measurement {count - 1} gives no observation, so it would leave the belief as it is; "
                "let the model's `observe` name its addresses, or leave the measurement out."
            )
        if not alone:
            known |= new.keys()
        yield Observed((scene, [each.action for each in given]), new)


def _is_deferred(scene: Any, measurement: Any) -> bool:
    sensor = scene.sensor(measurement.action) if hasattr(scene, "sensor") else None
    return isinstance(sensor, Defers) and sensor.is_deferred(measurement.action)


def update(population: Population, observed: Observed, pair: Pair | None = None) -> Population:
    """The population given new observations: weighted by their likelihood, and moved if a pair is given.

    Args:
        population: of N particles.
        observed: the program's arguments, and observations at new addresses.
        pair: forward and backward programs of SMCP3 (Lew et al., AISTATS 2023); without it, latent values
            that come with the observations are sampled from the program (a bootstrap filter).

    Raises:
        InputError: what is given is no population (a trace has an `update` of its own, `bcppl.update`).
        NoWeightError: no particle has any weight left.
        NotANumberError: a weight is NaN or +inf.
    """
    refuse_no_population("update", population)
    if pair is not None:
        return move_and_weight(population, pair, observed)
    trace, log_likelihood = extend(population.trace, *observed)
    return population.with_trace(trace).reweighed(log_likelihood)


def resample(population: Population, scheme: Scheme = systematic) -> Population:
    """N particles of equal weight, drawn from the population."""
    refuse_no_population("resample", population)
    return population.selected(scheme(population.log_weights))


def rejuvenate(
    population: Population, kernel: Kernel, target: Target = POSTERIOR, sweeps: int | Until = 1
) -> Population:
    """The population with every particle moved `sweeps` times by a kernel that leaves the target invariant.

    Weights and evidence stay. `bcppl.inference.kernels.moved_by` returns acceptance and displacement, too.

    Raises:
        InputError: what is given is no population, no kernel, or no number of sweeps.
    """
    refuse_no_population("rejuvenate", population)
    return moved_by(population, kernel, target, sweeps).population
