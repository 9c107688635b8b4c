"""Shapes that fit N particles by coincidence, such as those of a plate of N: one more particle shows them."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.traces.run import Program, Run, run
from bcppl.traces.series import Stage, indexed

# A vector that was meant as one event is unlikely to have more entries.
FEW = 20


def refuse_coincidence(
    program: Program, args: tuple[Any, ...], particles: int, ran: Run, old: Collection[str] = ()
) -> None:
    """Run a program once more, for N + 1 particles, where its shapes may fit N of them alone.

    That is where a plate or an axis of an event has N entries, or the first site, of few particles, has N
    before it is expanded to them. All sites are set, the last particle to the first one's values: nothing is
    drawn and no simulator is run. A proposal that reads a trace is not checked: it is made for the trace's
    particles.

    Args:
        program: what was run.
        args: its arguments.
        particles: N.
        ran: the run for N particles.
        old: addresses that were checked before.

    Raises:
        InputError: the program fits N particles and no other number of them.
    """
    # A program's first site depends on no sampled value, so that N entries are a coincidence where N is small
    # and intended where it is large. A later step of a series begins from the state, which has N.
    begins = particles <= FEW and (not isinstance(program, Stage) or program.before is None)
    suspects = ran.coincident | ran.whole if begins else ran.coincident
    if not suspects.difference(old) or any(hasattr(arg, "particles") for arg in args):
        return
    index = torch.cat([torch.arange(particles), torch.tensor([0])])
    given = {
        a: _one_more(v, ran.distributions[a], index) for a, v in ran.values.items() if a not in ran.fixed
    }
    carried = {name: entry.take(index) for name, entry in ran.carried.items()}
    state = torch.get_rng_state()
    try:
        again = run(
            program.take(index) if isinstance(program, Stage) else program,
            args,
            particles + 1,
            given,
            carried,
        )
        if isinstance(program, Stage):
            indexed(again.result, None, particles + 1)
    except InputError as error:
        raise InputError(
            f"with {particles} particles the shapes fit by coincidence alone; with one more, "
            f"{str(error).removesuffix('.')}."
        ) from error
    finally:
        torch.set_rng_state(state)


def _one_more(value: Tensor, distribution: Any, index: Tensor) -> Tensor:
    shared = value.ndim == len(distribution.batch_shape) - 1 + len(distribution.event_shape)
    return value if shared else value[index]
