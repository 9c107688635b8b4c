"""Several traces of one program as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from bcppl.errors import InputError
from bcppl.traces.series import SeriesTrace
from bcppl.traces.trace import Trace
from bcppl.traces.values import shapes


def concatenated(traces: Sequence[Trace]) -> Trace:
    """The particles of several traces of one program, in one, in their order.

    A simulator's state that cannot be joined with the others' is made again when it is asked for.

    Raises:
        InputError: the traces are of a series, or have different latent addresses.
    """
    first, *others = traces
    if isinstance(first, SeriesTrace):
        raise InputError(
            "traces of a series cannot be joined, as their pasts differ; write the program with a loop over "
            "the steps."
        )
    for other in others:
        if set(first.choices) != set(other.choices):
            raise InputError(
                f"two traces of {first.structure} have other latent addresses ({shapes(first.choices)}, and "
                f"{shapes(other.choices)}); let a structural site determine which are visited."
            )
    carried = dict(first.carried)
    count = len(first)
    for other in others:
        rows = torch.arange(count + len(other))
        mine, theirs = rows.clamp_max(count - 1), (rows - count).clamp_min(0)
        carried = {
            name: both
            for name, entry in carried.items()
            if name in other.carried
            and (both := entry.take(mine).where(rows < count, other.carried[name].take(theirs))) is not None
        }
        count += len(other)
    known = set(first.known).intersection(*(each.known for each in others))
    return replace(
        first,
        particles=count,
        choices={a: torch.cat([each.choices[a] for each in traces]) for a in first.choices},
        carried=carried,
        known={a: torch.cat([each.known[a] for each in traces]) for a in first.known if a in known},
        hidden=first.hidden.union(*(each.hidden for each in others)),
    )
