"""States carried by what made them, and the check of programs that no trace can see through."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError
from bcppl.traces import Series, carried, check_program, generate, update
from bcppl.traces.carried import Entry
from bcppl.traces.dependence import equality
from tests.invariance import number

N = 6


class State:
    """What a simulator made of two values of each particle."""

    def __init__(self, x: Tensor, y: Any) -> None:
        self.x, self.y = x, torch.as_tensor(y)

    def __getitem__(self, index: Tensor) -> State:
        return State(self.x[index], self.y[index])

    def where(self, mask: Tensor, other: State) -> State:
        return State(torch.where(mask, self.x, other.x), torch.where(mask, self.y, other.y))


X = torch.linspace(0.0, 1.0, N, dtype=torch.float64)
ORDER = torch.tensor([3, 3, 0, 5, 1, 2])
MASK = torch.tensor([True, False, True, True, False, False])


def held(x: Tensor, y: Any, kind: str, constant: Tensor | None = None) -> Callable[[], State]:
    if kind == "array":
        y = y.numpy()
    constant = torch.arange(4.0) if constant is None else constant
    if kind == "object":
        return partial(lambda holder, _: State(*holder.held), SimpleNamespace(held=[x, y]), constant)
    return lambda: State(x, y) if len(constant) else None  # type: ignore[return-value]


@pytest.mark.parametrize("kind", ["tensor", "array", "object"])
def test_a_state_belongs_to_the_values_of_its_particles(kind: str) -> None:
    entry = Entry.made(held(X, X + 1, kind), N)
    assert entry.made_by(held(X.clone(), X + 1, kind)) and not entry.made_by(held(X, X + 2, kind))
    taken = entry.take(ORDER)
    assert taken.made_by(held(X[ORDER], X[ORDER] + 1, kind))
    assert not taken.made_by(held(X, X + 1, kind)), "the values are those before the particles were chosen"
    assert taken.take(ORDER).made_by(held(X[ORDER][ORDER], X[ORDER][ORDER] + 1, kind))
    few = torch.tensor([4, 0])
    assert entry.take(few).made_by(held(X[few], X[few] + 1, kind))
    other = Entry.made(held(X - 5, X, kind), N)
    for first, second in (
        (entry, other),
        (taken, other),
        (entry, other.take(ORDER)),
        (taken, other.take(ORDER)),
    ):
        merged = first.where(MASK, second)
        assert merged is not None
        x, y = (torch.where(MASK, getattr(first.state, a), getattr(second.state, a)) for a in "xy")
        for m, index in ((merged, torch.arange(N)), (merged.take(ORDER), ORDER)):
            assert torch.equal(m.state.x, x[index]) and m.made_by(held(x[index], y[index], kind))
            assert not m.made_by(held(X, X + 1, kind)) and not m.made_by(held(X - 5, X, kind))
        # Entries that have one beginning in common.
        for third in (first, second, first.take(ORDER), merged.take(ORDER)):
            for a, b in ((merged, third), (third, merged)):
                again = a.where(~MASK, b)
                assert again is not None
                x, y = (torch.where(~MASK, getattr(a.state, v), getattr(b.state, v)) for v in "xy")
                assert torch.equal(again.state.y, y) and again.made_by(held(x, y, kind))
                assert again.take(ORDER).made_by(held(x[ORDER], y[ORDER], kind))
                assert not again.made_by(held(x + 1e-9, y, kind))


def test_states_of_unlike_beginnings_are_not_merged() -> None:
    entry = Entry.made(held(X, X + 1, "tensor"), N)
    assert entry.where(MASK, Entry.made(held(X, X, "object"), N)) is None
    assert entry.where(MASK, Entry.made(held(X, X, "tensor", torch.arange(5.0)), N)) is None
    # One tensor in both places here, two there.
    assert (
        Entry.made(held(X, X, "tensor"), N).where(MASK, Entry.made(held(X + 1, X + 2, "tensor"), N)) is None
    )
    assert (
        Entry.made(held(X, X, "tensor"), N).where(MASK, Entry.made(held(X + 1, X + 1, "tensor"), N))
        is not None
    )


def test_a_state_begun_in_a_loop_is_found_again() -> None:
    started: list[int] = []

    def program(z: float) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("z", dist.Normal(number(z), 1.0))
        for k in range(3):

            def begin() -> State:
                started.append(k)  # noqa: B023
                return State(x, x + k)  # noqa: B023

            state = carried(f"state {k}", begin)
            assert torch.equal(state.y, x + k)

    trace, _ = generate(program, (0.0,), {}, N)
    assert started == [0, 1, 2]
    moved = update(trace[ORDER], {"z": trace["z"]}).trace
    assert started == [0, 1, 2]
    update(moved, {"x": trace["x"]}).trace  # noqa: B018
    assert started == [0, 1, 2] * 2


# ---- programs that no trace can see through


LAST: dict[str, Tensor] = {}


class Reads(LazyDistribution):
    """A likelihood of x, and of whatever the function it is given reads."""

    def __init__(self, x: Tensor, read: Callable[[], Tensor]) -> None:
        self.x, self.read = x, read
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return dist.Normal(self.x + self.read(), 1.0).log_prob(value)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return dist.Normal(self.x + self.read(), 1.0).sample()


def through_a_global() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    LAST["shift"] = pyro.sample("shift", dist.Normal(number(0.0), 1.0))
    pyro.sample("y", Reads(x, lambda: LAST["shift"]))


def at_random() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    pyro.sample("y", Reads(x, lambda: torch.randn(len(x), dtype=torch.float64)))


def through_a_closure() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    shift = pyro.sample("shift", dist.Normal(x, 1.0))
    pyro.sample("within", dist.Uniform(-shift.exp(), shift.exp()))
    pyro.sample("y", Reads(x, lambda: shift))


@pytest.mark.parametrize(
    ("program", "match"),
    [
        (through_a_global, "site 'y' reads 'LAST' from outside .* hold all"),
        (at_random, "site 'y' has log-probability .* draws random numbers"),
    ],
)
def test_a_program_that_hides_what_it_depends_on_is_refused(program: Callable[[], None], match: str) -> None:
    torch.manual_seed(0)
    with pytest.raises(InputError, match=match):
        check_program(program, (), {"y": number(0.3)}, 10)


def test_a_program_that_hides_nothing_passes() -> None:
    torch.manual_seed(0)
    check_program(through_a_closure, (), {"y": number(0.3)}, 10)
    check_program(Series(through_a_closure, lambda state: state), (), {"y": number(0.3)}, 10)
    check_program(through_a_state, (), {"y": number(0.3)}, 10)


# ---- mutants


def through_a_state() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    shift = pyro.sample("shift", dist.Normal(number(0.0), 1.0))
    state = carried("state", lambda: State(x, shift.clone()))
    pyro.sample("y", Reads(x, lambda: state.y))


STATES = sys.modules["bcppl.traces.carried"]
MUTANTS: dict[str, tuple[Any, str, Any, Callable[[], None]]] = {
    "tensors are all equal": (equality, "equal", lambda a, b: True, through_a_closure),
    "tensors of states are all equal": (STATES, "equal", lambda a, b: True, through_a_state),
    "cells left out": (equality, "_parts_of_functions", lambda a, b: [], through_a_closure),
    "cells of beginnings left out": (equality, "_parts_of_functions", lambda a, b: [], through_a_state),
    "attributes left out": (equality, "_attributes", lambda *_: [], through_a_closure),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_mutants_that_miss_a_change_fail_the_check(mutant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    owner, name, wrong, program = MUTANTS[mutant]
    monkeypatch.setattr(owner, name, wrong)
    torch.manual_seed(0)
    with pytest.raises(InputError, match=r"site '.*' has log-probability"):
        check_program(program, (), {"y": number(0.3)}, 10)


def test_mutants_that_forget_which_particles_a_state_is_of(monkeypatch: pytest.MonkeyPatch) -> None:
    def not_indexed(self: Entry, index: Tensor) -> Entry:
        return replace(self, state=self.state[index])

    def not_merged(self: Entry, mask: Tensor, other: Entry) -> Entry:
        return replace(self, state=self.state.where(mask, other.state))

    for name, wrong in (("take", not_indexed), ("where", not_merged)):
        with monkeypatch.context() as patched, pytest.raises(AssertionError):
            patched.setattr(Entry, name, wrong)
            test_a_state_belongs_to_the_values_of_its_particles("tensor")
