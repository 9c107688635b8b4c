"""Simulator states that a trace carries: run once per particle, indexed with the trace, extended with it.

A program asks for one by name, `rollout = carried("probe", partial(begin, pose, probe))`. The first time,
`begin` makes it; when the same particles are run again, the one that the trace carries is handed back. What
the state depends on is what `begin` holds: its arguments, its defaults, the variables of its surroundings
(see `bcppl.traces.dependence.equality`). When one of them changes, a new state is made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl.traces.dependence.equality import Array, alike, equal, snapshot
from bcppl.traces.differentiation.graph import carries
from bcppl.traces.indexing import broadcast


class Carryable(Protocol):
    """State with the particle axis first."""

    def __getitem__(self, index: Tensor) -> Any:
        """The state of the particles at `index` (K,) int64, in that order."""
        ...

    def where(self, mask: Tensor, other: Any) -> Any:
        """This state where `mask` (N,) is true, the other's elsewhere."""
        ...


@runtime_checkable
class Storable(Protocol):
    """State whose numbers can be kept in a file; one without is made again where a trace is read from one."""

    def stored(self) -> Mapping[str, npt.NDArray[Any]]:
        """Its numbers by name, all but those that a new state for the same particles has."""
        ...

    def restored(self, numbers: Mapping[str, npt.NDArray[Any]]) -> Any:
        """A new state with these numbers in place of its own."""
        ...


@runtime_checkable
class Branching(Protocol):
    """State that goes on at random when it is asked for more: each run has a branch of its own."""

    def branched(self) -> Any:
        """The same state, which goes on without this one."""
        ...


C = TypeVar("C", bound=Carryable)


@dataclass(frozen=True, eq=False)
class Entry:
    """The state of K particles, and the function that made it, with which the next run's is compared.

    A tensor or an array that `start` holds has the particles as its first axis if that has as many entries as
    there were particles: it is indexed and merged with them. All else is the same for every particle.

    Attributes:
        particles: how many it was made for.
        index: (K,) which of these the particles are now; None for all of them, in order.
        merged: where states that were made by several functions are merged, what stands now in place of each
            tensor and array of `start` that has the particles as its first axis, by its id, beside it.
    """

    state: Any
    start: Callable[[], Any]
    particles: int
    index: Tensor | None = None
    merged: Mapping[int, tuple[Array, Array]] | None = None

    @classmethod
    def made(cls, start: Callable[[], Any], particles: int) -> Entry:
        """The entry of a new state."""
        # Taken first: to make the state may assign to what the function shares with the program.
        then = snapshot(start)
        return cls(start(), then, particles)

    @property
    def as_made(self) -> bool:
        """Whether the particles are those that the state was made for."""
        return self.index is None and self.merged is None

    def made_by(self, start: Callable[[], Any]) -> bool:
        """Whether a function would make this state for the particles that there are now."""
        return alike(self.start, start, lambda a, b: equal(self._now(a), b), shared=not self.as_made)

    def _now(self, array: Array) -> Array:
        if self.merged is not None:
            return self.merged[id(array)][1] if id(array) in self.merged else array
        if self.index is None or array.ndim == 0 or len(array) != self.particles:
            return array
        return _taken(array, self.index)

    def take(self, index: Tensor) -> Entry:
        """The entry of the particles at `index` (K,)."""
        state, whole = self.state[index], index if self.index is None else self.index[index]
        if self.merged is None:
            return replace(self, state=state, index=whole)
        merged = {key: (held, _taken(now, index)) for key, (held, now) in self.merged.items()}
        return replace(self, state=state, merged=merged)

    def where(self, mask: Tensor, other: Entry) -> Entry | None:
        """This entry where `mask` (N,) is true, the other's elsewhere; None if their starts are unlike."""
        if self.start is other.start and self.merged is None and other.merged is None:
            rows = torch.arange(len(mask))
            mine, theirs = (rows if each.index is None else each.index for each in (self, other))
            state = self.state.where(mask, other.state)
            return replace(self, state=state, index=torch.where(mask, mine, theirs))
        merged: dict[int, tuple[Array, Array]] = {}

        def merge(a: Array, b: Array) -> bool:
            now = _chosen(mask, self._now(a), other._now(b))
            if now is None or now.shape[:1] != mask.shape:
                return now is not None
            # What stands here in two places may be two tensors there.
            return equal(merged.setdefault(id(a), (a, now))[1], now)

        if self.start is other.start:
            held = [a for each in (self, other) for a, _ in (each.merged or {}).values()]
            mergeable = all(merge(a, a) for a in held)
        else:
            mergeable = alike(self.start, other.start, merge, shared=True)
        if not mergeable:
            return None
        return Entry(self.state.where(mask, other.state), self.start, len(mask), None, merged)


def _taken(array: Any, index: Tensor) -> Array:
    return array[index if isinstance(array, Tensor) else index.numpy()]


def _chosen(mask: Tensor, first: Array, second: Array) -> Array | None:
    """The first where `mask` (N,) is true, the second elsewhere; None if they are not of N particles."""
    if equal(first, second):
        return first
    if first.shape != second.shape or first.shape[:1] != mask.shape or first.dtype != second.dtype:
        return None
    mask = broadcast(mask, first)
    if isinstance(first, Tensor) and isinstance(second, Tensor):
        return torch.where(mask, first, second)
    return np.where(mask.numpy(), first, second)


@dataclass(eq=False)
class _Frame:
    particles: int
    available: Mapping[str, Entry]
    used: dict[str, Entry] = field(default_factory=dict)
    shared: dict[str, Any] = field(default_factory=dict)


_frame: ContextVar[_Frame | None] = ContextVar("bcppl_carried", default=None)


def carried(name: str, start: Callable[[], C]) -> C:
    """The state carried under `name` if `start` would make the same, else a new one from `start()`.

    Where a run keeps gradients and `start` is given a tensor that asks for them, the state is a new one too:
    that of an earlier run carries none.

    Args:
        name: unique within the program.
        start: makes the state for N particles. It is given what the state depends on by
            `functools.partial`, or takes it from its surroundings.
    """
    frame = _frame.get()
    if frame is None:
        return start()
    entry = frame.used.get(name)
    if entry is None and not (torch.is_grad_enabled() and carries(start)):
        entry = frame.available.get(name)
    if entry is None or not entry.made_by(start):
        entry = Entry.made(start, frame.particles)
    elif name not in frame.used:
        if isinstance(entry.state, Branching):
            entry = replace(entry, state=entry.state.branched())
        if not entry.as_made:
            # From here on what is compared is mostly the same object.
            entry = Entry(entry.state, snapshot(start), frame.particles)
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
def carrying(available: Mapping[str, Entry], particles: int) -> Iterator[dict[str, Entry]]:
    """Offer carried states to a program run within; yields those that it used or made."""
    frame = _Frame(particles, available)
    token = _frame.set(frame)
    try:
        yield frame.used
    finally:
        _frame.reset(token)
