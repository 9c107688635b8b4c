"""Programs that depend on more than they show."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from functools import lru_cache
from typing import Any

import pyro
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.traces import Fault, carried
from tests import small_programs
from tests.small_programs import normal_log
from tests.wrong_programs.catalogue import WRONG, Reads, Wrong, normal, wrong

# ---- dependence


class Shared:
    shift: Any = 0.0


class Own:
    shift: Any = 0.0


OWN, CONTEXT = Own(), ContextVar[Any]("shift")


@wrong(Fault.DEPENDENCE)
def object_written_into() -> None:
    x, OWN.shift = normal("x"), normal("shift")
    pyro.sample("y", Reads(x, partial_of_an_object(OWN)))


def partial_of_an_object(own: Own) -> Callable[[], Any]:
    return lambda: own.shift


@wrong(Fault.DEPENDENCE)
def context_variable() -> None:
    x = normal("x")
    CONTEXT.set(normal("shift"))
    pyro.sample("y", Reads(x, CONTEXT.get))


@lru_cache(maxsize=1)
def holder() -> dict[str, Any]:
    return {}


@wrong(Fault.DEPENDENCE)
def cached_holder() -> None:
    x = normal("x")
    holder()["shift"] = normal("shift")
    pyro.sample("y", Reads(x, lambda: holder()["shift"]))


class Rollout:
    """A simulator's state, which a trace carries."""

    def __init__(self, x: Tensor) -> None:
        self.x = x

    def __getitem__(self, index: Tensor) -> Rollout:
        return Rollout(self.x[index])

    def where(self, mask: Tensor, other: Rollout) -> Rollout:
        return Rollout(torch.where(mask, self.x, other.x))


STARTS: list[Any] = [None]


@wrong(Fault.DEPENDENCE)
def state_that_begins_from_a_global() -> None:
    STARTS[0] = normal("x")
    normal("y", carried("rollout", lambda: Rollout(STARTS[0])).x)


class Fixed(LazyDistribution):
    def __init__(self, x: Tensor) -> None:
        self.x = x
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, self.x, 1.0)


class Excepted(Fixed):
    __caches__ = ("x",)


@wrong(Fault.DEPENDENCE)
def attribute_declared_a_cache() -> None:
    pyro.sample("y", Excepted(normal("x")))


FIXED = Fixed(torch.zeros(10, dtype=torch.float64))


def one_object_for_all_runs() -> None:
    FIXED.__init__(normal("x"))  # type: ignore[misc]
    pyro.sample("y", FIXED)


WRONG["one_object_for_all_runs"] = Wrong(Fault.DEPENDENCE, "y", one_object_for_all_runs)


class ClassWide(LazyDistribution):
    shift: Any = 0.0

    def __init__(self, x: Tensor) -> None:
        self.x = x
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, self.x + self.shift, 1.0)


@wrong(Fault.DEPENDENCE)
def class_attribute() -> None:
    x = normal("x")
    ClassWide.shift = normal("shift")
    pyro.sample("y", ClassWide(x))


@wrong(Fault.DEPENDENCE)
def module_attribute() -> None:
    x = normal("x")
    small_programs.shift = normal("shift")  # type: ignore[attr-defined]
    pyro.sample("y", Reads(x, lambda: small_programs.shift))  # type: ignore[attr-defined]


@wrong(Fault.DEPENDENCE)
def function_attribute() -> None:
    x = normal("x")
    normal_log.shift = normal("shift")  # type: ignore[attr-defined]
    pyro.sample("y", Reads(x, lambda: normal_log.shift))  # type: ignore[attr-defined]


MEANS = torch.zeros(100_000, dtype=torch.float64)


@wrong(Fault.DEPENDENCE)
def one_buffer_for_all_means() -> None:
    x = normal("x")
    MEANS[: len(x)] = x
    normal("y", MEANS[: len(x)])
