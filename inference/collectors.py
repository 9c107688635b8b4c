"""Collectors: functions of each step of a run, evaluated without changing it.

    from bcppl.inference import collect, smc, tempered
    from bcppl.inference.collectors import effective_sample_size, mean
    from bcppl.models import load_recording
    from bcppl.models.point_probe import model

    run = smc(model, load_recording("point_probe_10_pushes"), step=tempered(), particles=50)
    watched = collect(run, size=effective_sample_size, part=mean("part"))
    for belief, info in watched:
        print(info.label)
    print(watched["size"])  # (steps,)

Named after the collectors of `particles` (Chopin and Papaspiliopoulos, An Introduction to Sequential Monte
Carlo, 2020).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import summaries

S = TypeVar("S")


class Collected(Generic[S]):
    """An iterator over the steps of a run, with a column for each function of the steps so far."""

    def __init__(self, steps: Iterable[S], functions: dict[str, Callable[[S], Any]]) -> None:
        self._steps = iter(steps)
        self._functions = functions
        self._columns: dict[str, list[Any]] = {name: [] for name in functions}

    def __iter__(self) -> Iterator[S]:
        return self

    def __next__(self) -> S:
        step = next(self._steps)
        # A function that samples must not change the random numbers of the run.
        with torch.random.fork_rng(devices=[]):
            row = {name: function(step) for name, function in self._functions.items()}
        for name, value in row.items():
            self._columns[name].append(value)
        return step

    @property
    def columns(self) -> dict[str, Any]:
        """By name, (steps, ...) tensors where all values are numbers or tensors of one shape, else lists."""
        return {name: self[name] for name in self._columns}

    def __getitem__(self, name: str) -> Any:
        if name not in self._columns:
            raise InputError(
                f"nothing was collected as {name!r}; there are {', '.join(self._columns) or 'no columns'}."
            )
        column = self._columns[name]
        if not column or not all(isinstance(v, Tensor | float | int) for v in column):
            return list(column)
        values = [torch.as_tensor(v, dtype=None if isinstance(v, Tensor) else torch.float64) for v in column]
        return torch.stack(values) if len({v.shape for v in values}) == 1 else list(column)


def collect(steps: Iterable[S], **functions: Callable[[S], Any]) -> Collected[S]:
    """Collect columns of a run, `name=function(step)` each.

    Args:
        steps: an iterator such as `smc(...)` or `steps(...)`; it is not run ahead.
        functions: of each step; see the ones below.

    Returns:
        An iterator over the same steps, whose `[name]` and `.columns` hold the columns so far.
    """
    return Collected(steps, functions)


def effective_sample_size(step: Any) -> float:
    """The effective sample size of the population after the step."""
    return float(step.population.effective_sample_size)


def log_evidence(step: Any) -> float:
    """The log evidence of all measurements so far."""
    return float(step.population.log_evidence)


def acceptance(step: Any) -> float:
    """The share of proposals accepted, NaN where nothing was moved."""
    return float(step.info.acceptance)


def distinct(step: Any) -> int:
    """The number of particles that differ in some latent value."""
    return int(step.population.distinct)


def mean(address: str) -> Callable[[Any], Tensor]:
    """The weighted mean of a latent address: of a pose (7,), of another value the shape of its event."""
    return lambda step: summaries.mean(step.population, address)
