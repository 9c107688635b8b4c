"""Which sites of two traces of one program differ."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from bcppl.traces.dependence.equality import comparison, equal
from bcppl.traces.dependence.surroundings import changed as surroundings_changed
from bcppl.traces.differentiation.graph import kept

if TYPE_CHECKING:
    from bcppl.traces.trace import Trace


def changed(first: Trace, second: Trace, addresses: Iterable[str]) -> Iterator[str]:
    """Those of some addresses of two traces whose values or distributions differ."""
    same, then, now = comparison(), first._run, second._run
    if kept():
        # Equal numbers may depend on different tensors.
        yield from addresses
        return
    for address in addresses:
        if (
            not equal(then.values[address], now.values[address])
            or not same(then.distributions[address], now.distributions[address])
            or surroundings_changed(then.surroundings.get(address, {}), now.surroundings.get(address, {}))
        ):
            yield address
