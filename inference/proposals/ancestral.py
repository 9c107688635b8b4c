"""Prior proposals: latent values, discrete ones included, redrawn from the program itself."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import pyro
from torch import Tensor

from bcppl.arguments import latent_address
from bcppl.errors import InputError
from bcppl.traces import Trace


def prior(*addresses: str) -> Callable[[Trace], None]:
    """A proposal that redraws some latent values from the program, in its order, given the others.

    Later ones are conditioned on the new values of earlier ones, as when the program is run. The acceptance
    ratio is that of the densities of the other sites: the proposal is valid for any value, and efficient for
    values that the observations hardly inform.

    Args:
        addresses: latent addresses, in any order.

    Raises:
        InputError: no address is given; when it is run: one is not latent.
    """
    if not addresses:
        raise InputError("prior is given no address; give one or more latent ones.")

    def regenerated(trace: Trace) -> None:
        for address in addresses:
            latent_address("prior is given {}", address, trace.choices)
        fresh: dict[str, Tensor] = {}
        for address in trace.addresses:
            if address in addresses:
                current = trace.at(fresh) if fresh else trace
                fresh[address] = _sampled(address, current.distributions[address])

    return regenerated


def _sampled(address: str, distribution: Any) -> Tensor:
    """A site's value, particle axis first, sampled in the plates that its distribution needs."""
    sizes = distribution.batch_shape[:-1]
    with ExitStack() as stack:
        for k, size in enumerate(sizes):
            dim = k - len(sizes) - 1
            stack.enter_context(pyro.plate(f"{address} plate {dim}", size, dim=dim))
        value: Tensor = pyro.sample(address, distribution)
    return value.movedim(len(sizes), 0)
