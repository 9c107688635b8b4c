"""One step of SMC, a function (population, observed) -> (population, info), and the loop over steps.

Any program can be run so, without a recording:

    population = importance_sampling(program, (0,), {}, particles=1000)
    observed = [Observed((k + 1,), {f"y_{k}": y}) for k, y in enumerate(series)]
    for population, info in steps(tempered(kernel), population, observed):
        print(info.effective_sample_size, population.log_evidence)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.kernels.kernel import takes
from bcppl.inference.kernels.rejuvenation import Moved
from bcppl.inference.population import Population, refuse_no_population
from bcppl.inference.progress import watched
from bcppl.traces.values import Value


class Observed(NamedTuple):
    """New observations, and the program's arguments that go with them.

    Attributes:
        args: the program's arguments up to and including the new measurement, as a tuple.
        observations: tensors, arrays or numbers at the new addresses, of the sites' event shape.
    """

    args: tuple[Any, ...]
    observations: Mapping[str, Value]


class Assimilated(NamedTuple):
    """A population given one more measurement.

    Attributes:
        population: of N particles.
        effective: the effective sample size of all copies of which these were chosen, or their own.
        origin: (N,) the particle that each was made of; None where each is its own.
        moved: what moves by the cheap target did, before physics; None without any.
    """

    population: Population
    effective: float
    origin: Tensor | None = None
    moved: Moved | None = None


class StepInfo(NamedTuple):
    """A record of one step.

    Attributes:
        acceptance: the share of proposals accepted, NaN where nothing was moved.
        exponents: of tempering, the last 1. Where sites are tempered one after another, those of each in
            turn, each ending with 1.
        resampled: how many times.
        effective_sample_size_before: just before the last resampling; where there was none, at the end.
        effective_sample_size: at the end.
        log_evidence: the increment of the log evidence.
        ancestors: (N,) int64, the particle before the step that each one descends from, -1 for one that was
            drawn afresh; None where nothing was resampled, and each descends from itself.
        displacement: mean squared displacement of the particles since the last resampling, in variances, on
            the axis on which it is least; NaN without resampling, or without `until(displacement=...)`.
    """

    acceptance: float = math.nan
    exponents: tuple[float, ...] = (1.0,)
    resampled: int = 0
    effective_sample_size_before: float = math.nan
    effective_sample_size: float = math.nan
    log_evidence: float = 0.0
    ancestors: Tensor | None = None
    displacement: float = math.nan

    def __repr__(self) -> str:
        shown = {name: f"{value:.4g}" for name, value in self._asdict().items() if isinstance(value, float)}
        shown["exponents"] = f"<{len(self.exponents)} steps>"
        shown["resampled"] = f"{self.resampled}"
        if self.ancestors is not None:
            shown["ancestors"] = f"<{len(self.ancestors.unique())} of {len(self.ancestors)}>"
        return f"StepInfo({', '.join(f'{name}={shown[name]}' for name in self._fields if name in shown)})"


def descended(ancestors: Tensor | None, chosen: Tensor | None, count: int) -> Tensor | None:
    """The ancestors of particles that are chosen once more from `count` of them.

    Args:
        ancestors: (count,) of those, as of `StepInfo`.
        chosen: (N,) int64 among those; from `count` on, particles drawn afresh. None for all, in order.
        count: how many there were.
    """
    if chosen is None:
        return ancestors
    first = torch.arange(count) if ancestors is None else ancestors
    return torch.where(chosen < count, first[chosen.clamp(max=count - 1)], -1)


class Stepped(NamedTuple):
    """A population that has assimilated observations, and the record of the step."""

    population: Population
    info: StepInfo


StepFunction = Callable[[Population, Observed], Stepped]


def refuse_no_step(where: str, step: object) -> None:
    """Refuse what cannot be a step."""
    if not callable(step) or not takes(step, 2):
        raise InputError(
            f"{where} is given something else than a step; if it is a kernel, give tempered(kernel) from "
            "bcppl.inference.filters.tempering."
        )


def steps(
    step: StepFunction, population: Population, observed: Iterable[Observed], *, progress: bool = False
) -> Iterator[Stepped]:
    """The population after each step: an iterator that can be paused, inspected and resumed.

    It draws from torch's own generator, so a population and torch's state resume it bit for bit.

    Args:
        step: such as `bcppl.inference.filters.tempering.tempered(...)`.
        population: before the first step, such as that of `importance_sampling(...)`.
        observed: one for each step.
        progress: show a bar, on a terminal or in a notebook, until the last step is taken; for a loop that is
            not paused.

    Raises:
        InputError: what is given is no step (a kernel, say), no population, or no list of `Observed`.
    """
    refuse_no_step("steps", step)
    refuse_no_population("steps", population)
    if isinstance(observed, Observed):
        raise InputError("steps is given one Observed; give a list of them, one for each step.")

    def stepping() -> Iterator[Stepped]:
        now = population
        for each in observed:
            now, info = step(now, each)
            yield Stepped(now, info)

    total = len(observed) if isinstance(observed, Sized) else None
    return watched(stepping(), total=total, description="steps", progress=progress)
