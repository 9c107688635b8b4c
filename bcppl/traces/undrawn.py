"""A trace extended by new arguments whose lazy sites are not drawn: only their distributions are wanted."""

from __future__ import annotations

from typing import Any

from bcppl.traces.run import run
from bcppl.traces.trace import Trace
from bcppl.traces.verbs import trace_of


def undrawn(trace: Trace, args: tuple[Any, ...]) -> Trace:
    """The trace with the sites that new arguments add; the values of lazy ones are NaN.

    Several of them can then be sampled in one batch. Other new sites are drawn from the program.
    """
    given = {**trace.choices, **trace.observations}
    ran = run(trace.program, args, trace.particles, given, trace.carried, draws_lazy=False)
    longer = trace_of(trace.program, args, trace.particles, ran, trace.observations)
    longer.known.update(trace.known)
    return longer
