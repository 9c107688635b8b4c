"""Likelihoods that are given a shift in a way that comparing their attributes may not show."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from functools import cache, cached_property, partial
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from tests.small_programs import normal_log

Program = Callable[[], None]


class Shifted(LazyDistribution):
    """A normal at x, shifted by what a subclass computes."""

    def __init__(self, x: Tensor) -> None:
        self.x = x
        super().__init__(len(x), ())

    def shift(self) -> Any:
        raise NotImplementedError

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, self.x + torch.as_tensor(self.shift(), dtype=torch.float64), 1.0)


HIDDEN: dict[str, Callable[[Tensor, Tensor], Any]] = {}


def hidden(make: Callable[[Tensor, Tensor], Any]) -> Callable[[Tensor, Tensor], Any]:
    HIDDEN[make.__name__] = make
    return make


class Calling(Shifted):
    def __init__(self, x: Tensor, read: Callable[[], Any]) -> None:
        self.read = read
        super().__init__(x)

    def shift(self) -> Any:
        return self.read()


@hidden
def closure(x: Tensor, shift: Tensor) -> Any:
    return Calling(x, lambda: shift)


@hidden
def closure_of_a_closure(x: Tensor, shift: Tensor) -> Any:
    def inner() -> Tensor:
        return shift

    def outer() -> Tensor:
        return inner()

    return Calling(x, outer)


@hidden
def default_argument(x: Tensor, shift: Tensor) -> Any:
    return Calling(x, lambda held=shift: held)


@hidden
def keyword_default(x: Tensor, shift: Tensor) -> Any:
    def read(*, held: Tensor = shift) -> Tensor:
        return held

    return Calling(x, read)


@hidden
def partial_application(x: Tensor, shift: Tensor) -> Any:
    return Calling(x, partial(torch.clone, shift))


@hidden
def bound_method(x: Tensor, shift: Tensor) -> Any:
    return Calling(x, shift.clone)


@hidden
def attribute_of_a_function(x: Tensor, shift: Tensor) -> Any:
    def read() -> Tensor:
        return read.held  # type: ignore[attr-defined, no-any-return]

    read.held = shift  # type: ignore[attr-defined]
    return Calling(x, read)


@hidden
def generator(x: Tensor, shift: Tensor) -> Any:
    def forever() -> Iterator[Tensor]:
        while True:
            yield shift

    return Calling(x, partial(next, forever()))


@hidden
def numpy_view(x: Tensor, shift: Tensor) -> Any:
    held = np.concatenate([np.zeros(1), shift.numpy()])[1:]
    return Calling(x, lambda: held)


@hidden
def numpy_objects(x: Tensor, shift: Tensor) -> Any:
    held = np.array([shift, None], dtype=object)
    return Calling(x, lambda: held[0])


@hidden
def memory_view(x: Tensor, shift: Tensor) -> Any:
    held = memoryview(shift.numpy().copy())
    return Calling(x, lambda: np.asarray(held))


@hidden
def module_parameter(x: Tensor, shift: Tensor) -> Any:
    layer = torch.nn.Linear(1, 1)
    layer.bias = torch.nn.Parameter(shift.clone())
    return Calling(x, lambda: layer.bias)


@hidden
def module_buffer(x: Tensor, shift: Tensor) -> Any:
    layer = torch.nn.Identity()
    layer.register_buffer("held", shift)
    return Calling(x, lambda: layer.held)


@hidden
def namespace(x: Tensor, shift: Tensor) -> Any:
    return Calling(x, partial(getattr, SimpleNamespace(held=shift), "held"))


@hidden
def fresh_module(x: Tensor, shift: Tensor) -> Any:
    module = ModuleType("fresh")
    module.held = shift  # type: ignore[attr-defined]
    return Calling(x, partial(getattr, module, "held"))


class Slots:
    __slots__ = ("held",)

    def __init__(self, held: Any) -> None:
        self.held = held


@hidden
def slots(x: Tensor, shift: Tensor) -> Any:
    return Calling(x, partial(getattr, Slots(shift), "held"))


class Elsewhere(Shifted):
    """Reads what lies under its identity in a table of its class."""

    table: ClassVar[weakref.WeakKeyDictionary[Any, Any]] = weakref.WeakKeyDictionary()

    def __init__(self, x: Tensor, shift: Tensor) -> None:
        self.table[self] = shift
        super().__init__(x)

    def shift(self) -> Any:
        return self.table[self]


HIDDEN["table of weak keys"] = Elsewhere


class Attributed(Shifted):
    def __init__(self, x: Tensor, shift: Tensor) -> None:
        self.held = {"offset": shift}
        super().__init__(x)

    def __getattr__(self, name: str) -> Any:
        if name == "offset":
            return self.__dict__["held"]["offset"]
        raise AttributeError(name)

    def shift(self) -> Any:
        return self.offset


HIDDEN["__getattr__"] = Attributed


class Computed(Shifted):
    """Its cached property was computed before the attribute was set again."""

    def __init__(self, x: Tensor, shift: Tensor) -> None:
        self.held = shift
        super().__init__(x)

    @cached_property
    def offset(self) -> Tensor:
        return 2.0 * self.held

    def shift(self) -> Any:
        return self.offset


HIDDEN["cached property"] = Computed


class OfTheClass(Shifted):
    held: Any = 0.0

    def __init__(self, x: Tensor, shift: Tensor) -> None:
        type(self).held = shift
        super().__init__(x)

    def shift(self) -> Any:
        return self.held


HIDDEN["class attribute"] = OfTheClass


class Property(Shifted):
    def __init__(self, x: Tensor, shift: Tensor) -> None:
        GLOBALS["held"] = shift
        super().__init__(x)

    @property
    def offset(self) -> Any:
        return GLOBALS["held"]

    def shift(self) -> Any:
        return self.offset


GLOBALS: dict[str, Any] = {}
HIDDEN["property that reads elsewhere"] = Property


@hidden
def weak_reference(x: Tensor, shift: Tensor) -> Any:
    KEPT[:] = [shift]
    held = weakref.ref(shift)
    return Calling(x, lambda: held())


KEPT: list[Any] = []
CONTEXT: ContextVar[Any] = ContextVar("held")
LOCAL = threading.local()
QUEUE: list[Any] = []


@hidden
def global_list(x: Tensor, shift: Tensor) -> Any:
    QUEUE[:] = [shift]
    return Calling(x, lambda: QUEUE[0])


@hidden
def context_variable(x: Tensor, shift: Tensor) -> Any:
    CONTEXT.set(shift)
    return Calling(x, CONTEXT.get)


@hidden
def thread_local(x: Tensor, shift: Tensor) -> Any:
    LOCAL.held = shift
    return Calling(x, lambda: LOCAL.held)


@cache
def store() -> list[Any]:
    return [None]


@hidden
def cached_function(x: Tensor, shift: Tensor) -> Any:
    store()[0] = shift
    return Calling(x, lambda: store()[0])


class Written:
    held: Any = None


WRITTEN = Written()


@hidden
def object_written_into(x: Tensor, shift: Tensor) -> Any:
    WRITTEN.held = shift
    return Calling(x, partial(getattr, WRITTEN, "held"))


TENSOR = torch.zeros(10_000, dtype=torch.float64)


@hidden
def tensor_written_into(x: Tensor, shift: Tensor) -> Any:
    TENSOR[: len(shift)] = shift
    return Calling(x, lambda: TENSOR[: len(x)])


@hidden
def array_that_is_held_and_written_into(x: Tensor, shift: Tensor) -> Any:
    TENSOR.numpy()[: len(shift)] = shift.numpy()
    return Calling(x, partial(TENSOR.narrow, 0, 0, len(x)))


@hidden
def environment(x: Tensor, shift: Tensor) -> Any:
    import builtins

    builtins.bcppl_test_shift = shift  # type: ignore[attr-defined]
    return Calling(x, lambda: bcppl_test_shift)  # type: ignore[name-defined] # noqa: F821
