"""The cost of a simulator: calls, outputs, and wall time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace


@dataclass
class Effort:
    """The accumulated cost of one simulator; every simulator has one as `.effort`.

    Attributes:
        calls: number of calls.
        items: images rendered, or rollouts run.
        amount: rays traced, or seconds simulated over all rollouts.
        seconds: wall time.
    """

    # Simulators that differ in nothing but their cost so far are equal (`bcppl.traces.dependence`).
    __caches__ = ("calls", "items", "amount", "seconds")

    calls: int = 0
    items: int = 0
    amount: float = 0.0
    seconds: float = 0.0

    @contextmanager
    def measure(self, items: int = 0, amount: float = 0.0) -> Iterator[Effort]:
        """Add one call, its wall time, and `items` and `amount`, also where the body raises.

        The body may add more: `with effort.measure(75) as effort: effort.amount += rays`.
        """
        start = time.perf_counter()
        try:
            yield self
        finally:
            self.calls += 1
            self.items += items
            self.amount += amount
            self.seconds += time.perf_counter() - start

    def copy(self) -> Effort:
        """A copy of the cost so far."""
        return replace(self)

    def since(self, earlier: Effort) -> Effort:
        """The cost since an earlier `copy`."""
        return Effort(*(now - then for now, then in zip(astuple(self), astuple(earlier), strict=True)))
