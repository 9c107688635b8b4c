"""A trace extended by new arguments whose lazy sites are not drawn: only their distributions are wanted."""

from __future__ import annotations

from typing import Any

from bcppl.traces.trace import Trace


def undrawn(trace: Trace, args: tuple[Any, ...]) -> Trace:
    """The trace with the sites that new arguments add; the values of lazy ones are NaN.

    Several of them can then be sampled in one batch. Other new sites are drawn from the program.
    """
    return trace.revised({}, args=args, draws_lazy=False)
