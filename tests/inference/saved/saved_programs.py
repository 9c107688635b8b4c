"""Populations that tests save, and what is done with them next: here, and in another process.

It goes on from each NAME.h5, and writes NAME.later.h5:

    python -m tests.inference.saved.saved_programs NAME... FOLDER
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.inference import importance_sampling, saved, tempered
from bcppl.inference.filters.step import Observed
from bcppl.inference.kernels import hmc, metropolis_hastings, sequence
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift, independent, prior
from bcppl.inference.resampling import adaptive, systematic
from bcppl.traces import Series, extend
from bcppl.traces.series import SeriesTrace
from tests.invariance import number


def groups(count: int) -> None:
    """A hierarchy: a mean, a choice, a vector and a plate of values, and observations up to `count`."""
    mean = pyro.sample("mean", dist.Normal(number(0.0), 2.0))
    which = pyro.sample("which", dist.Categorical(torch.tensor([0.3, 0.7]).double()))
    vector = pyro.sample("vector", dist.Normal(torch.zeros(3).double(), 1.0).to_event(1))
    with pyro.plate("schools", 5, dim=-2):
        each = pyro.sample("each", dist.Normal(mean, 1.0 + which))
        for k in range(count):
            pyro.sample(f"y_{k}", dist.Normal(each + vector.sum(-1), 0.3))


MOVES = sequence([metropolis_hastings(drift("mean")), metropolis_hastings(independent("vector"))])
MOVES = sequence([MOVES, metropolis_hastings(prior("which")), hmc("each", steps=3)])


def begun_groups(seed: int) -> Population:
    torch.manual_seed(seed)
    population = importance_sampling(groups, (0,), {}, 40)
    return next_groups(population)


def next_groups(population: Population) -> Population:
    (k,) = population.trace.args
    observed = Observed((k + 1,), {f"y_{k}": torch.tensor([0.5, -0.3, 0.1, 1.2, 0.4]).double() + k})
    return tempered(MOVES, sweeps=1)(population, observed).population


class State(NamedTuple):
    """Of the walk: where it is, and how fast."""

    x: Tensor
    speed: Tensor


def init(drag: float) -> State:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    return State(x, pyro.sample("speed", dist.Normal(number(0.0), drag)))


def step(before: State, drag: float) -> State:
    speed = pyro.sample("speed", dist.Normal(before.speed * drag, 0.1))
    x = pyro.sample("x", dist.Normal(before.x + speed, 0.2))
    pyro.sample("y", dist.Normal(x, 0.3))
    return State(x, speed)


WALK, FORGETFUL = Series(init, step), Series(init, step, history=False)


def begun_series(series: Series, steps: int) -> Callable[[int], Population]:
    def begun(seed: int) -> Population:
        torch.manual_seed(seed)
        population = importance_sampling(series, (1.0,), {}, 30)
        for k in range(steps):
            population = next_series(population, k)
        return population

    return begun


def next_series(population: Population, k: int = 7) -> Population:
    observed = Observed((0.9 + 0.01 * k,), {"y": torch.tensor(0.1 * k).double()})
    kernel = metropolis_hastings(drift("x"))
    return tempered(kernel, sweeps=1, resample=adaptive(systematic, 0.7))(population, observed).population


def by_hand(population: Population) -> Population:
    """A step after a resampling, so that the file holds particles chosen from others."""
    trace, weight = extend(population.trace, (0.9,), {"y": torch.tensor(0.3).double()})
    later = population.with_trace(trace).reweighed(weight)
    return later.selected(torch.multinomial(later.log_weights.softmax(0), len(later), replacement=True))


class Kept(NamedTuple):
    """A program, how its population is begun with a seed, and what comes next."""

    program: Any
    begun: Callable[[int], Population]
    later: Callable[[Population], Population]


def chosen(seed: int) -> Population:
    return by_hand(begun_series(WALK, 3)(seed))


KEPT = {
    "groups": Kept(groups, begun_groups, next_groups),
    "series": Kept(WALK, begun_series(WALK, 5), next_series),
    "forgetful": Kept(FORGETFUL, begun_series(FORGETFUL, 5), next_series),
    "chosen": Kept(WALK, chosen, by_hand),
}


def bits(population: Population) -> dict[str, Any]:
    """All that is to be equal."""
    trace = population.trace
    paths = {}
    if isinstance(trace, SeriesTrace) and trace.stage.series.history:
        paths = {f"x {t}": trace["x", t] for t in range(trace.steps + 1)} | {"path": trace.log_prob()}
    return {
        **trace.choices,
        **{f"log p({a})": trace.log_prob(a) for a in trace.addresses},
        **paths,
        "log weights": population.log_weights,
        "founders": population.founders,
        "numbers": torch.tensor([population.log_evidence, population.log_pairs]).double(),
        "size": torch.tensor(population.effective_sample_size).double(),
        "next draw": torch.rand(3),
    }


def gone_on(name: str, path: Path) -> dict[str, Any]:
    """What comes after a file, from its random state."""
    kept = KEPT[name.split("-")[0]]
    population = saved.load(path, kept.program)
    torch.set_rng_state(saved.random_state(path))
    return bits(kept.later(kept.later(population)))


if __name__ == "__main__":
    *names, folder = sys.argv[1:]
    for each in names:
        torch.save(gone_on(each, Path(folder) / f"{each}.h5"), Path(folder) / f"{each}.pt")
