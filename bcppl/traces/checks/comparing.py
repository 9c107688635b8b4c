"""Log-probabilities of two runs compared, up to what rounding may change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from bcppl.errors import NotANumberError
from bcppl.traces.faults import Fault, ProgramError
from bcppl.traces.trace import Trace

# A trace of so many particles at values from the prior.
Start = Callable[[int], Trace]

# Simulators run for a batch of particles may round otherwise than for others.
TOLERANCE = 1e-6
# So may sums in single precision.
COARSE = 1e-3


def rerun(trace: Trace) -> Trace:
    """The trace of a new run at the same values, with nothing kept."""
    return replace(trace.settled(), carried={}, known={})


def log_probs(trace: Trace) -> dict[str, Tensor]:
    """Log-probability (N,) of every site, by address.

    Raises:
        ProgramError: one is NaN or +inf.
    """
    values = {}
    for address in trace.addresses:
        try:
            # A copy: what a log-probability returns may be written to again.
            values[address] = trace.log_prob(address).clone()
        except NotANumberError as error:
            raise ProgramError(Fault.NOT_A_NUMBER, address, str(error)) from error
    return values


def differing(first: Tensor, second: Tensor) -> Tensor:
    """Whether log-probabilities (N,) differ by more than rounding, (N,) bool."""
    coarse = all(bool((each.float().double() == each).all()) for each in (first, second))
    tolerance = COARSE if coarse else TOLERANCE
    return ~torch.isclose(first, second, rtol=tolerance, atol=tolerance, equal_nan=True)


def first_differing(expected: dict[str, Tensor], got: dict[str, Tensor]) -> tuple[str, int] | None:
    """The first site whose log-probabilities differ, and the first particle; None if none does."""
    for address, value in expected.items():
        if address in got and bool((other := differing(value, got[address])).any()):
            return address, int(other.nonzero()[0])
    return None
