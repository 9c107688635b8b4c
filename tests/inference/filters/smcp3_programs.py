"""Shared by tests of SMCP3: mutants of its weights, and a program without choices."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from bcppl.inference.kernels.jacobian import log_abs_det_jacobian
from bcppl.traces import Trace
from bcppl.traces.verbs import assessed


def silent(*args: Any) -> Trace:
    """Mutant: the backward program's choices have no density."""
    trace = assessed(*args)
    trace.known.update({a: torch.zeros(len(trace), dtype=torch.float64) for a in trace.addresses})
    return trace


def flat(again: Any, inputs: Any, outputs: Any, **options: Any) -> Tensor:
    """Mutant: no Jacobian."""
    return torch.zeros_like(log_abs_det_jacobian(again, inputs, outputs, **options))


def turned_over(*args: Any, **options: Any) -> Tensor:
    """Mutant: the inverse of the Jacobian."""
    return -log_abs_det_jacobian(*args, **options)


def nothing(trace: Trace) -> None:
    pass
