"""Values compared part by part, and functions as they were."""

from __future__ import annotations

import collections
import math
import random
import threading
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.traces.dependence.equality import comparison, snapshot

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
