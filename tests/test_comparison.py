"""Values compared part by part, states carried by what made them, and the check of a program."""

from __future__ import annotations

import collections
import math
import random
import sys
import threading
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.traces import Series, carried, check_program, generate, update
from bcppl.traces.carried import Entry
from bcppl.traces.dependence import equality
from bcppl.traces.dependence.equality import comparison, snapshot
from tests.invariance import number

N = 6


def t(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@dataclass
class Holder:
    held: Any


class Slots:
    __slots__ = ("__private", "shown")

    def __init__(self, private: Any, shown: Any = None) -> None:
        self.__private = private
        if shown is not None:
            self.shown = shown


class Below(Slots):
    """Slots above, a dictionary here."""

    def __init__(self, private: Any, held: Any) -> None:
        super().__init__(private)
        self.held = held


class Caching:
    """What is cached does not count, what it is computed from does."""

    __caches__ = ("last",)

    def __init__(self, x: float, last: Any = None, ask: bool = False) -> None:
        self.x, self.last = x, last
        if ask:
            self.double  # noqa: B018

    @cached_property
    def double(self) -> float:
        return 2.0 * self.x


class Seeded(random.Random):
    """Its state is kept where Python sees no attribute."""


class Numbers(list[Any]):
    """A list with an attribute."""

    def __init__(self, values: Any, unit: str) -> None:
        super().__init__(values)
        self.unit = unit


def knot(value: Any) -> list[Any]:
    """A list that holds itself."""
    loop = [value]
    loop.append(loop)
    return loop


def recursive(value: Any) -> Callable[[int], Any]:
    def again(count: int) -> Any:
        return value if count == 0 else again(count - 1)

    return again


def unset() -> Callable[[], Any]:
    def read() -> Any:
        return later

    if math.pi < 3.0:
        later = 0
    return read


def asked(distribution: Any) -> Any:
    """A distribution that has computed what it computes on demand."""
    distribution.log_prob(distribution.sample())
    return distribution


def positive() -> Any:
    return dist.LogNormal(t(0.0, 1.0), 1.0)


def keyword(value: Any) -> Callable[..., Any]:
    def read(*, given: Any = value) -> Any:
        return given

    return read


SAME: dict[str, Callable[[], Any]] = {
    "tensor": lambda: t(1.0, math.nan, -0.0),
    "expanded": lambda: t(1.0).expand(4),
    "whole numbers": lambda: torch.arange(3),
    "truth values": lambda: torch.tensor([True, False]),
    "complex": lambda: torch.complex(t(1.0), t(math.nan)),
    "parameter": lambda: torch.nn.Parameter(t(1.0)),
    "array": lambda: np.array([1.0, math.nan]),
    "entry of an array": lambda: np.float32(1.5),
    "number": lambda: float("nan"),
    "text": lambda: "".join(["a", "b"]),
    "containers": lambda: {
        "a": [(t(1.0), {1, 2}), frozenset({"b"})],
        3: types.MappingProxyType({"c": t(2.0)}),
    },
    "list with an attribute": lambda: Numbers([t(1.0)], "m"),
    "counter": lambda: collections.Counter("aab"),
    "loop": lambda: knot(t(1.0)),
    "object": lambda: Holder(Holder(t(1.0))),
    "namespace": lambda: Holder(torch.Size([1, 2])),
    "slots": lambda: Slots(t(1.0)),
    "slots and a dictionary": lambda: Below(t(1.0), t(2.0)),
    "function": lambda: (lambda x: lambda y=x: (x, y))(t(1.0)),
    "recursive": lambda: recursive(t(1.0)),
    "unset": unset,
    "keyword": lambda: keyword(t(1.0)),
    "partial": lambda: partial(max, t(1.0), key=Holder(t(2.0))),
    "bound": lambda: Holder(t(1.0)).__eq__,
    "bound of the language": lambda: [1.5].count,
    "normal": lambda: dist.Normal(t(0.0, 1.0), 1.0).to_event(1),
    "categorical": lambda: dist.Categorical(t(0.2, 0.8)),
    "logits": lambda: dist.Bernoulli(logits=t(0.2)),
    "transformed": positive,
    "inverse": lambda: dist.TransformedDistribution(positive(), dist.transforms.ExpTransform().inv),
    "masked": lambda: dist.Normal(t(0.0, 1.0), 1.0).mask(torch.tensor([True, False])),
    "pose": lambda: NormalPose(poses.identity(), 0.1 * torch.ones(6)),
}


@pytest.mark.parametrize("case", SAME)
def test_what_is_made_in_the_same_way_is_the_same(case: str) -> None:
    first, second = SAME[case](), SAME[case]()
    assert comparison()(first, second) and comparison()(first, first)
    assert not comparison()(first, Holder(second)) and not comparison()(second, None)


@pytest.mark.parametrize("make", [positive, SAME["categorical"], SAME["logits"], SAME["pose"]])
def test_what_a_distribution_computed_on_demand_does_not_count(make: Callable[[], Any]) -> None:
    assert comparison()(make(), asked(make())) and comparison()(asked(make()), make())


def test_what_is_cached_does_not_count() -> None:
    assert comparison()(Caching(1.0), Caching(1.0, last=object(), ask=True))
    assert not comparison()(Caching(1.0), Caching(2.0))
    given, computed = Caching(1.0), Caching(1.0, ask=True)
    given.double = 3.0
    assert not comparison()(given, computed), "what was assigned to it counts where both have it"


ONE = torch.complex(t(1.0), t(1.0))

DIFFERENT: dict[str, Callable[[int], Any]] = {
    "tensor": lambda k: t(1.0, float(k)),
    "sign of zero": lambda k: t(0.0 if k else -0.0),
    "bits of a number": lambda k: 0.0 if k else -0.0,
    "kind of number": lambda k: 1 if k else True,
    "precision": lambda k: torch.zeros(2, dtype=torch.float32 if k else torch.float64),
    "shape": lambda k: torch.zeros(2, 1 + k),
    "layout": lambda k: torch.eye(2) if k else torch.eye(2).to_sparse(),
    "parameter": lambda k: torch.nn.Parameter(t(1.0)) if k else t(1.0),
    "imaginary part": lambda k: torch.complex(t(1.0), t(float(k))),
    "conjugate": lambda k: ONE if k else ONE.conj(),
    "negative": lambda k: ONE.conj().imag if k else ONE.imag,
    "array": lambda k: np.array([1.0, float(k)]),
    "objects in an array": lambda k: np.array([Holder(k)], dtype=object),
    "masked array": lambda k: np.ma.array([1.0], mask=[bool(k)]),
    "entry of an array": lambda k: np.float32(k),
    "order": lambda k: {"a": 1, "b": 2} if k else {"b": 2, "a": 1},
    "length": lambda k: [1] * k,
    "kind of container": lambda k: [1] if k else (1,),
    "set": lambda k: {1, k + 2},
    "attribute of a list": lambda k: Numbers([1.0], "m" if k else "mm"),
    "default of a dictionary": lambda k: collections.defaultdict(int if k else float, a=1),
    "within a loop": lambda k: knot(t(float(k))),
    "private slot": lambda k: Slots(t(float(k))),
    "slot that is not set": lambda k: Slots(1.0, k or None),
    "beneath slots": lambda k: Below(t(1.0), t(float(k))),
    "class": lambda k: Holder(1) if k else Slots(1),
    "class made again": lambda k: type("Made", (), {})(),
    "attribute": lambda k: Holder(Holder(t(float(k)))),
    "another attribute": lambda k: types.SimpleNamespace(**{"ab"[k]: 1}),
    "cell": lambda k: (lambda x: lambda: x)(t(float(k))),
    "cell that is not set": lambda k: unset() if k else recursive(0),
    "default": lambda k: lambda x=k: x,
    "keyword": lambda k: keyword(t(float(k))),
    "code": lambda k: (lambda x: x + 1) if k else (lambda x: x + 2),
    "partial": lambda k: partial(max, key=t(float(k))),
    "function of a partial": lambda k: partial(max if k else min, 1),
    "self": lambda k: Holder(t(float(k))).__eq__,
    "method": lambda k: "ab".upper if k else "ab".lower,
    "state of C": lambda k: Seeded(k),
    "generator": lambda k: (x for x in [k]),
    "lock": lambda k: threading.Lock(),
    "sentinel": lambda k: object(),
    "scale": lambda k: dist.Normal(0.0, t(1.0 + k)),
    "chances": lambda k: dist.Categorical(t(0.2, 0.8 + k)),
    "chances or logits": lambda k: dist.Geometric(probs=t(0.5)) if k else dist.Geometric(logits=t(0.5)),
    "transform": lambda k: dist.TransformedDistribution(
        dist.Normal(0.0, 1.0), [dist.transforms.AffineTransform(t(float(k)), 1.0)]
    ),
    "inverse of a transform": lambda k: dist.TransformedDistribution(
        dist.Normal(0.0, 1.0), [dist.transforms.AffineTransform(t(float(k)), 1.0).inv]
    ),
    "mask": lambda k: dist.Normal(0.0, t(1.0)).mask(torch.tensor([bool(k)])),
}


@pytest.mark.parametrize("case", DIFFERENT)
def test_what_differs_or_is_not_understood_is_not_the_same(case: str) -> None:
    first, second = DIFFERENT[case](0), DIFFERENT[case](1)
    assert not comparison()(first, second) and not comparison()(second, first)
    assert comparison()(first, first)
    assert not comparison()([t(1.0), Holder(first)], [t(1.0), Holder(second)])


def test_the_same_tensors_are_compared_once() -> None:
    same, first, second = comparison(), t(1.0), t(1.0)
    assert same(Holder(first), Holder(second))
    second += 1.0
    assert same((first,), (second,)), "within one comparison of two runs nothing is written to"
    assert not comparison()((first,), (second,))


# ---- functions as they were


def test_a_snapshot_is_the_function_as_it_was() -> None:
    def in_a_loop() -> Iterator[Callable[[], Any]]:
        values: list[Any] = []
        for k in range(2):
            values.append(t(float(k)))
            yield lambda: (k, values)  # noqa: B023

    functions, then = [], []
    for function in in_a_loop():
        functions.append(function)
        then.append(snapshot(function))
    second = list(in_a_loop())[1]
    assert comparison()(functions[0], functions[1]), "both have come to see the last value"
    assert not comparison()(then[0], functions[0]) and not comparison()(then[0], second)
    assert comparison()(then[1], functions[1]) and comparison()(then[1], second)
    assert comparison()(then[0], snapshot(next(in_a_loop())))


def test_a_snapshot_of_what_two_runs_share_stays_the_same() -> None:
    shared: list[int] = []

    def write() -> None:
        shared.append(1)

    then = snapshot(partial(write))
    write()
    assert comparison()(then, partial(write))
    assert comparison()(snapshot(recursive(t(1.0))), recursive(t(1.0)))
    assert not comparison()(snapshot(recursive(t(1.0))), recursive(t(2.0)))
    assert comparison()(snapshot(keyword(t(1.0))), keyword(t(1.0)))


# ---- states by what made them


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
        return partial(lambda holder, _: State(*holder.held), Holder([x, y]), constant)
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
