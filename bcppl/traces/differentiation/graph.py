"""Gradients through the verbs: within `gradients()` they keep torch's graph, which they do without otherwise.

    import pyro
    import pyro.distributions as dist
    import torch

    from bcppl.traces import assess, gradients

    def program():
        x = pyro.sample("x", dist.Normal(0.0, scale))
        pyro.sample("y", dist.Normal(x, 1.0))

    scale = torch.tensor(2.0, requires_grad=True)
    x = torch.tensor([0.5, 1.0], requires_grad=True)
    with gradients():
        log_prob = assess(program, (), {"x": x, "y": torch.zeros(2)}, 2)
    print(torch.autograd.grad(log_prob.sum(), [x, scale]))

The gradient is that of each particle's log-density with respect to its own value, and to the scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial
from types import CellType, FunctionType
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError

_kept: ContextVar[bool] = ContextVar("bcppl_gradients", default=False)


@contextmanager
def gradients() -> Iterator[None]:
    """A context in which the verbs and `trace.log_prob` can be differentiated.

    `simulate`, `generate`, `assess`, `propose`, `update` and `log_prob` are then attached to every tensor
    that asks for gradients: values and observations that they are given, parameters that a program closes
    over. Draws of reparameterised distributions are attached to the parameters of these, others are
    constants. The program is run again, and every log-probability evaluated again, each time that one is
    asked for: at the present values of trained parameters, also where the trace has kept one of earlier
    values. Outside, a trace is of the parameters that it was made with: after a step of training, generate a
    new one before particles are moved or weighed. A trace that is made within and evaluated after the context
    is evaluated without gradients. In a series the states from which a step begins are constants where the
    steps before it were run outside.

    Raises:
        InputError: (by the verbs) a program or a site takes a tensor that asks for gradients out of torch, or
            the log-probability of a site whose distribution holds one does not depend on it. A tensor that
            the program detaches itself counts as a constant.
    """
    token = _kept.set(True)
    try:
        yield
    finally:
        _kept.reset(token)


def kept() -> bool:
    """Whether the verbs keep the graph."""
    return _kept.get()


def graph() -> Any:
    """The context in which programs are run and sites evaluated: without gradients, unless they are kept."""
    return torch.set_grad_enabled(_kept.get())


def taken_out(address: str | None) -> InputError:
    """The error of a site, or of a program after the site that it visited last, that leaves torch."""
    return InputError(
        f"{address or 'the program'} takes a value that carries gradients out of torch, which no gradient "
        "survives; compute with torch, or detach the value where its gradient is not wanted."
    )


def refuse_cut(address: str, distribution: Any) -> None:
    """Refuse a distribution that holds a tensor asking for gradients, though its log-probability has none."""
    if carries(distribution):
        raise InputError(
            f"site {address!r} depends on a tensor that asks for gradients and passes no gradient on; "
            "detach that tensor, or differentiate the log-probabilities of other sites alone."
        )


def carries(value: Any) -> bool:
    """Whether a tensor that asks for gradients is a part of a value: of its attributes, items or closures."""
    stack, met = [value], set()
    while stack:
        part = stack.pop()
        if isinstance(part, Tensor):
            if part.requires_grad:
                return True
            continue
        if id(part) in met or isinstance(part, type | str | bytes | int | float):
            continue
        met.add(id(part))
        if isinstance(part, Mapping):
            stack += part.values()
        elif isinstance(part, list | tuple | set | frozenset):
            stack += part
        elif isinstance(part, partial):
            stack += [part.func, part.args, part.keywords]
        elif isinstance(part, FunctionType):
            stack += [*(part.__closure__ or ()), *(part.__defaults__ or ())]
        elif isinstance(part, CellType):
            with suppress(ValueError):  # a variable that has no value yet
                stack.append(part.cell_contents)
        elif hasattr(part, "__self__"):
            stack.append(part.__self__)
        stack += getattr(part, "__dict__", {}).values()
    return False
