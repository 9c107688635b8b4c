"""Long series: a model that is a pair (init, step), run step by step, its particles' ancestry as indices.

    def init():
        return pyro.sample("x", dist.Normal(0.0, 1.0))

    def step(x):
        x = pyro.sample("x", dist.Normal(x, 0.5))
        pyro.sample("y", dist.Normal(x, 0.3))
        return x

    walk = Series(init, step)
    trace, weight = generate(walk, (), {}, particles=100)
    for y in observed:
        trace, weight = extend(trace, (), {"y": y})
    trace["x"], trace["x", 3]  # now, and what each particle's ancestor had after three steps

The trace is that of the newest step, whose addresses are those that `step` visits; kernels move them. Earlier
steps are read by number and moved no more. So the cost of T steps is of order T, and choosing ancestors costs
a single gather; paths are traced back when they are asked for (Murray, Bayesian state-space modelling on
high-performance hardware using LibBi, JSS 67, 2015, section 3.3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.cached import cached_property
from bcppl.errors import InputError
from bcppl.traces.carried import Entry
from bcppl.traces.differentiation.graph import kept
from bcppl.traces.indexing import Index, aligned, composed, indexed
from bcppl.traces.run import Program, Run
from bcppl.traces.trace import Trace


@dataclass(frozen=True)
class Series:
    """A program in two parts, for `simulate` and `generate` (the first) and `extend` (the second, once each).

    Attributes:
        init: `init(*args) -> state`.
        step: `step(state, *args) -> state`, with the arguments of that step alone.
        history: whether earlier steps stay readable; without, memory does not grow with the steps.

    A state is a tensor, or a dictionary, list, tuple or named tuple of such, the particle axis first;
    numbers, None and tensors without axes are the same for all particles. Anything else that it holds is
    indexed by (K,) int64.
    """

    init: Callable[..., Any]
    step: Callable[..., Any]
    history: bool = True


@dataclass(frozen=True, eq=False)
class Stage:
    """One step of a series as a program, which begins from the states of a trace's particles."""

    series: Series
    number: int = 0
    before: SeriesTrace | None = None
    picks: tuple[Tensor, ...] = ()

    def __call__(self, *args: Any) -> Any:
        """Run the step from the states of the chosen particles."""
        if self.before is None:
            return self.series.init(*args)
        state = indexed(self.before.state, self.chosen, self.before.particles)
        after = self.series.step(state, *args)
        if after is None and state is not None:
            raise InputError(
                "a series' step returned nothing, but it was given a state; return the next state from it."
            )
        return after

    @cached_property
    def chosen(self) -> Tensor | None:
        """The particles (N,) of the trace before from which the step begins; None for all, in order."""
        return reduce(composed, self.picks, None)

    def take(self, index: Tensor) -> Stage:
        """The same step for the particles at `index` (K,)."""
        # Composed only when asked for: a filter that runs the next step never does.
        return replace(self, picks=(*self.picks, index)) if self.before is not None else self

    def where(self, mask: Tensor, other: Stage) -> Stage:
        """The same step for this one's ancestors where `mask` (N,) is true, the other's elsewhere."""
        if self.series is not other.series or self.before is not other.before:
            raise InputError(
                "two traces of a series were to be merged that do not begin from the same step; "
                "merge traces of one population."
            )
        if self.before is None or self.chosen is other.chosen:
            return self
        own = torch.arange(len(mask))
        first, second = (own if each.chosen is None else each.chosen for each in (self, other))
        return replace(self, picks=(torch.where(mask, first, second),))


def runnable(program: Program | Series) -> Program:
    """The program itself, or the first stage of a series."""
    if not callable(program) and not isinstance(program, Series):
        raise InputError(
            f"a program is a function, and {type(program).__name__} is given; give the function itself, its "
            "arguments beside it as a tuple (of a model its `program`)."
        )
    return Stage(program) if isinstance(program, Series) else program


class Chosen(Mapping[str, Tensor]):
    """The choices of the particles at an index (K,), gathered when they are asked for."""

    def __init__(self, whole: Mapping[str, Tensor], index: Tensor) -> None:
        self._whole, self._index = whole, index
        self._gathered: dict[str, Tensor] = {}

    def __getitem__(self, address: str) -> Tensor:
        if address not in self._gathered:
            self._gathered[address] = self._whole[address].index_select(0, self._index)
        return self._gathered[address]

    def __contains__(self, address: object) -> bool:
        return address in self._whole

    def __iter__(self) -> Iterator[str]:
        return iter(self._whole)

    def __len__(self) -> int:
        return len(self._whole)


@dataclass(frozen=True, eq=False, repr=False)
class SeriesTrace(Trace):
    """The newest step of a series for N particles, the earlier ones behind it.

    `trace["x"]` is the newest value, `trace["x", t]` that of each particle's ancestor after t steps (0: what
    `init` drew; -1: the newest). Choices, observations, addresses and distributions are the newest step's.

    Attributes:
        origin: the trace that this one's particles were chosen from, and which (N,); None if from none.
    """

    origin: tuple[SeriesTrace, Tensor] | None = None

    @property
    def stage(self) -> Stage:
        """The step that the trace is of."""
        assert isinstance(self.program, Stage)
        return self.program

    @property
    def steps(self) -> int:
        """How many steps were run after `init`."""
        return self.stage.number

    @cached_property
    def _result(self) -> Any:
        return self._run.result

    @property
    def state(self) -> Any:
        """What the newest step returned, the particle axis first."""
        if self.origin is None:
            return self._result
        whole, index = self.origin
        return indexed(whole.state, index, whole.particles)

    def _keep_run(self, ran: Run) -> None:
        indexed(ran.result, None, self.particles)
        super()._keep_run(ran)

    def log_prob(self, *addresses: str | tuple[str, int]) -> Tensor:
        """Log-probability (N,) of sites, summed; of all sites of all steps where none is named.

        Args:
            addresses: an address of the newest step, or one with the number of a step, ("x", 3).

        Raises:
            InputError: no site has that address, or the earlier steps were not kept.
            InferenceError: a log-probability is NaN or +inf; names the site and the particles.
        """
        if not addresses:
            return self._whole_path()
        values = []
        attached: dict[int, Run] = {}
        for address in addresses:
            name, number = (address, -1) if isinstance(address, str) else address
            then, index = self._after(number)
            if kept() and then.steps not in attached:
                attached[then.steps] = then._again()
            value = then._site(name, attached.get(then.steps))
            values.append(value if index is None else value.index_select(0, index))
        return sum(values[1:], values[0])

    def _site(self, address: str, attached: Run | None) -> Tensor:
        if self.origin is not None and address not in self.known and address not in self.hidden:
            whole, index = self.origin
            if address in whole.known:
                self.known[address] = whole.known[address].index_select(0, index)
        return super()._site(address, attached)

    def _whole_path(self) -> Tensor:
        """The sum over all steps; each step's is kept, so that asking after every step costs no more."""
        links: list[tuple[SeriesTrace, Tensor | None]] = []
        node: SeriesTrace | None = self
        while node is not None and (kept() or "_total" not in node.__dict__):
            links.append((node, node.stage.chosen))
            if isinstance(node, Forgotten):
                raise _forgotten(node.steps)
            node = node.stage.before
        total = None if node is None else node.__dict__["_total"]
        for node, chosen in reversed(links):
            own = node.log_prob(*node.addresses) if node.addresses else torch.zeros(node.particles)
            if total is not None:
                own = own + (total if chosen is None else total.index_select(0, chosen))
            total = own.to(torch.float64)
            if not kept():
                node.__dict__["_total"] = total
        assert total is not None
        return total

    def _after(self, number: int) -> tuple[SeriesTrace, Tensor | None]:
        """The trace after so many steps, and which of its particles (N,) are ancestors of these."""
        what = f"step {{}} of a series was asked for, which has run {self.steps}"
        wanted = whole_number(what, number, least=-self.steps - 1, most=self.steps) % (self.steps + 1)
        node, index = self, None
        while node.steps > wanted and node.stage.before is not None:
            node, index = node.stage.before, composed(node.stage.chosen, index)
        if isinstance(node, Forgotten):
            raise _forgotten(wanted)
        return node, index

    def since(self, previous: Trace) -> list[str]:
        """The addresses that `previous` does not visit: all of the newest step's, if it is another."""
        same = isinstance(previous, SeriesTrace) and previous.steps == self.steps
        return [] if same else self.addresses

    def ancestors(self, number: int) -> Tensor:
        """The particle (N,) int64 after a step, before any were chosen, from which each descends."""
        then, index = self._after(number)
        return torch.arange(then.particles) if index is None else index

    def __getitem__(self, key: str | tuple[str, int] | Index) -> Any:
        if isinstance(key, tuple) and len(key) == 2 and isinstance(key[0], str):
            then, chosen = self._after(key[1])
            value = then[key[0]]
            return value if chosen is None or key[0] in then.observations else value.index_select(0, chosen)
        return super().__getitem__(list(key) if isinstance(key, tuple) else key)

    def chosen(self, index: Tensor) -> Any:
        """The trace of the particles at an index (K,) int64 that is known to be in range."""
        whole, first = (self, None) if self.origin is None else self.origin
        both = composed(first, index)
        assert both is not None
        return whole._like(
            program=self.stage.take(index),
            particles=len(index),
            choices=Chosen(whole.choices, both),
            carried={a: e.take(index) for a, e in self.carried.items()},
            known={},
            hidden=self.hidden,
            origin=(whole, both),
        )

    def settled(self) -> SeriesTrace:
        """The same trace with all of its values gathered."""
        if self.origin is None:
            return self
        whole, index = self.origin
        known = {a: v.index_select(0, index) for a, v in whole.known.items() if a not in self.known}
        return self._like(choices=dict(self.choices), known={**known, **self.known}, origin=None)

    def where(self, mask: Tensor, other: Trace) -> SeriesTrace:
        """This trace where `mask` (N,) is true, the other (of the same step and past) elsewhere.

        Raises:
            InputError: the two do not begin from the same step of one population.
        """
        assert isinstance(other, SeriesTrace)
        first, second = self.settled(), other.settled()
        merged = super(SeriesTrace, first).where(mask, second)
        return merged._like(program=first.stage.where(mask, second.stage))

    def replaced(self, index: Tensor, source: Trace) -> SeriesTrace:  # noqa: D102
        rows, mask = aligned(index, self.particles)
        return source.chosen(rows).where(mask, self)

    def revised(self, *args: Any, **options: Any) -> Trace:  # noqa: D102
        return super(SeriesTrace, self.settled()).revised(*args, **options)

    @cached_property
    def _forgotten(self) -> SeriesTrace:
        """The state alone; of one trace the same one, so that steps that begin from it can be merged."""
        return resumed(self.stage.series, self.state, self.steps, self.particles)

    def next_stage(self) -> Stage:
        """The step that comes after this trace's, for its particles."""
        whole, index = (self, None) if self.origin is None else self.origin
        series = self.stage.series
        if not series.history:
            whole = whole._forgotten
        else:
            # The state is all that the next step needs: the distributions of a past step are released.
            whole.__dict__["_result"] = whole._result
            whole.__dict__.pop("_run", None)
        return Stage(series, self.steps + 1, whole, () if index is None else (index,))


class Forgotten(SeriesTrace):
    """An earlier step of which only the state is kept."""


def resumed(
    series: Series, state: Any, steps: int, particles: int, carried: Mapping[str, Entry] | None = None
) -> SeriesTrace:
    """A trace of which only the state after some steps is known, for `extend` to run on.

    Args:
        series: what was run.
        state: what its newest step returned, the particle axis first.
        steps: how many were run after `init`.
        particles: N.
        carried: simulator states by name (`bcppl.traces.carried`).
    """
    trace = Forgotten(Stage(series, steps), (), particles, {}, {}, carried=dict(carried or {}))
    trace.__dict__["_result"] = state
    return trace


def _forgotten(number: int) -> InputError:
    return InputError(
        f"step {number} of a series was asked for, which was not kept; make the series with `history=True`."
    )
