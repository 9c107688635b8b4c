"""Smoothing: whole paths of a series given all observations, drawn backwards through a filter's particles.

filtered = [start, *(population for population, _ in steps(tempered(), start, observed))]
paths = smooth(filtered, 500)
paths["x", 3].mean()  # of the state after three steps, given the observations of all
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.resampling import multinomial
from bcppl.inference.series.states import same
from bcppl.traces import extend
from bcppl.traces.series import SeriesTrace

PAIRS = 1 << 18  # of a path and a particle, evaluated in one batch


def smooth(filtered: Sequence[Population], draws: int) -> SeriesTrace:
    """Paths drawn from the smoothing distribution by forward filtering, backward sampling.

    Godsill, Doucet and West, Monte Carlo smoothing for nonlinear time series, JASA 99, 2004, algorithm 1: the
    last state is drawn from the last population. Each earlier one is drawn from the population of its step,
    with its weight times the density of the step that leads on to what was drawn. That density is the
    program's own at the given values. A path that is traced back along ancestors
    (`filtered[-1].trace["x", t]`) has few different values far back; these have as many as the filter had.

    A step may return more than the values that it sampled, such as a static parameter. Then a particle from
    which the step does not lead to the same state has no density, and the paths of different parameters stay
    apart: to smooth these, use `particle_gibbs`. The steps' likelihoods count as well, for what is observed
    may depend on the state before.

    Args:
        filtered: the population after each step, as a filter yields them (resampled or not, moved or not),
            the first of them after `init` or after any step.
        draws: D.

    Returns:
        A trace of D equally weighted paths: `paths["x", t]` is (D, *event). Time is of order N x D for each
        step; at most about 260,000 pairs are evaluated at once.

    Raises:
        InputError: the populations are not of successive steps of a series, or the draws are no whole number,
            1 or more.
        InferenceError: no particle of the last population has any weight.
    """
    draws = whole_number("a series is to be smoothed with {} draws", draws)
    traces: list[Any] = [getattr(population, "trace", None) for population in filtered]
    if not traces or not all(isinstance(trace, SeriesTrace) for trace in traces):
        raise InputError("smooth is given no populations of a series; give a list, one after each step.")
    for first, second in pairwise([trace.steps for trace in traces if isinstance(trace, SeriesTrace)]):
        if second != first + 1:
            raise InputError(
                f"smooth is given a population after {second} steps behind one after {first}; "
                "give one after each step."
            )
    index = multinomial(filtered[-1].log_weights, draws)[torch.randperm(draws)]
    chosen = [index]
    for before, after in reversed(list(pairwise(filtered))):
        block = max(1, PAIRS // len(before))
        index = torch.cat([_backward(before, after, each) for each in index.split(block)])
        chosen.append(index)
    paths = traces[0].chosen(chosen.pop())
    for trace in traces[1:]:
        index = chosen.pop()
        values = {address: value[index] for address, value in trace.choices.items()}
        paths, _ = extend(paths, trace.args, trace.observations, values)
    assert isinstance(paths, SeriesTrace)
    return paths


def _backward(before: Population, after: Population, index: Tensor) -> Tensor:
    """The particles (D,) of a population from which paths begin whose next step is at `index` (D,)."""
    count, draws = len(before), len(index)
    trace = after.trace
    pairs = torch.arange(count).repeat(draws)
    onto = index.repeat_interleave(count)
    values = {address: value[onto] for address, value in trace.choices.items()}
    onward, log_density = extend(before.trace.chosen(pairs), trace.args, trace.observations, values)
    assert isinstance(onward, SeriesTrace) and isinstance(trace, SeriesTrace)
    possible = same(onward.state, trace.chosen(onto).state, len(pairs))
    chance = torch.where(possible, log_density, -torch.inf).reshape(draws, count) + before.log_weights
    return torch.multinomial(torch.softmax(chance, dim=1), 1).squeeze(1)
