"""Simulator state that a trace carries: run once per particle, indexed with the trace, extended with it.

A program asks for it by name, `rollout = carried("probe", pose, start)`. The first time, `start()` makes it;
when the same particles are run again with the same inputs, the one that the trace carries is handed back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor


class Carryable(Protocol):
    """State with the particle axis first."""

    def __getitem__(self, index: Tensor) -> Any:
        """The state of the particles at `index` (K,) int64, in that order."""
        ...

    def where(self, mask: Tensor, other: Any) -> Any:
        """This state where `mask` (N,) is true, the other's elsewhere."""
        ...


C = TypeVar("C", bound=Carryable)


@dataclass(frozen=True, eq=False)
class Entry:
    """What is carried under one name, and the inputs (N, ...) that it was started from."""

    inputs: tuple[Tensor, ...]
    state: Any

    def take(self, index: Tensor) -> Entry:
        """The entry of the particles at `index` (K,)."""
        return Entry(tuple(x[index] for x in self.inputs), self.state[index])

    def where(self, mask: Tensor, other: Entry) -> Entry:
        """This entry where `mask` (N,) is true, the other's elsewhere."""
        pairs = zip(self.inputs, other.inputs, strict=True)
        inputs = tuple(torch.where(_spread(mask, a), a, b) for a, b in pairs)
        return Entry(inputs, self.state.where(mask, other.state))


def _spread(mask: Tensor, like: Tensor) -> Tensor:
    return mask.reshape(-1, *[1] * (like.ndim - 1))


@dataclass(eq=False)
class _Frame:
    available: Mapping[str, Entry]
    used: dict[str, Entry] = field(default_factory=dict)
    shared: dict[str, Any] = field(default_factory=dict)


_frame: ContextVar[_Frame | None] = ContextVar("bcppl_carried", default=None)


def same_inputs(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> bool:
    """Whether two tuples of inputs hold the same values, bit for bit."""
    return len(first) == len(second) and all(
        a is b or (a.shape == b.shape and torch.equal(a, b)) for a, b in zip(first, second, strict=True)
    )


def carried(name: str, inputs: Tensor | tuple[Tensor, ...], start: Callable[[], C]) -> C:
    """The state carried under `name` if it was started from the same inputs, else a new one from `start()`.

    Args:
        name: unique within the program.
        inputs: every tensor (N, ...) that the state hangs on; when one changes, the state is thrown away.
        start: makes the state for N particles.
    """
    inputs = inputs if isinstance(inputs, tuple) else (inputs,)
    frame = _frame.get()
    if frame is None:
        return start()
    entry = frame.used.get(name) or frame.available.get(name)
    if entry is None or not same_inputs(entry.inputs, inputs):
        entry = Entry(inputs, start())
    frame.used[name] = entry
    return entry.state


T = TypeVar("T")


def once(name: str, make: Callable[[], T]) -> T:
    """The value of `make()`, called the first time that one run of a program asks for this name.

    For latent values that several measurements share: the first that needs them samples their sites.
    """
    frame = _frame.get()
    if frame is None:
        return make()
    if name not in frame.shared:
        frame.shared[name] = make()
    value: T = frame.shared[name]
    return value


@contextmanager
def carrying(available: Mapping[str, Entry]) -> Iterator[dict[str, Entry]]:
    """Offer carried states to a program run within; yields those that it used or started."""
    frame = _Frame(available)
    token = _frame.set(frame)
    try:
        yield frame.used
    finally:
        _frame.reset(token)
