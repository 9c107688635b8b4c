"""What a simulator has cost so far: how often it was asked, how much it made, and how long that took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Effort:
    """The work of one simulator, added up; every simulator owns one as `.effort`.

    Attributes:
        calls: how often the simulator was asked.
        items: images rendered, or rollouts run.
        amount: rays traced, or seconds simulated over all rollouts.
        seconds: wall time spent.
    """

    calls: int = 0
    items: int = 0
    amount: float = 0.0
    seconds: float = 0.0

    @contextmanager
    def measure(self, items: int = 0, amount: float = 0.0) -> Iterator[Effort]:
        """Add one call, its wall time, and `items` and `amount`, also where the body raises.

        What is known only at the end is added in the body: `with effort.measure(75) as e: e.amount += rays`.
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
        """The work so far, as it stands now."""
        return Effort(self.calls, self.items, self.amount, self.seconds)

    def since(self, earlier: Effort) -> Effort:
        """The work done since an earlier `copy`."""
        return Effort(
            self.calls - earlier.calls,
            self.items - earlier.items,
            self.amount - earlier.amount,
            self.seconds - earlier.seconds,
        )
