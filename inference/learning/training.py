"""Training: parameters that make an objective small, by stochastic gradients."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import Module

from bcppl.arguments import seed_number, whole_number
from bcppl.devices import seed_here
from bcppl.errors import InferenceError, InputError
from bcppl.inference.learning.objectives import Objective
from bcppl.inference.progress import watched

# What is optimised: modules or parameters.
Trainable = Module | Tensor | Iterable[Module | Tensor]
Optimiser = Callable[[list[Tensor]], torch.optim.Optimizer]

# The seed of held-out draws is another one than that of training, also in the 32 bits that torch reads.
HELD_OUT = 0x5DEECE66
ADAM = partial(torch.optim.Adam, lr=1e-3)


@dataclass(frozen=True)
class Checks:
    """When the held-out loss is evaluated, and when training ends early.

    Attributes:
        every: so many steps.
        batches: of the objective, on draws of their own, the same ones each time.
        patience: training ends after so many checks without a smaller held-out loss.
    """

    every: int = 200
    batches: int = 10
    patience: int = 5

    def __post_init__(self) -> None:
        whole_number("training is checked every {} steps", self.every)
        whole_number("training is checked on {} batches", self.batches)
        whole_number("training has a patience of {} checks", self.patience)


CHECKS = Checks()


@dataclass(frozen=True, repr=False)
class Trained:
    """A record of training; the parameters are those of the step with the smallest held-out loss.

    Attributes:
        losses: (S,) of the steps.
        held_out: (C,) of the checks, the first before the first step.
        steps: (C,) after how many steps each check was made.
        best: after how many steps the held-out loss was smallest.
        seconds: that training took, its checks included.
    """

    losses: Tensor
    held_out: Tensor
    steps: Tensor
    best: int
    seconds: float

    def __repr__(self) -> str:
        first, least = float(self.held_out[0]), float(self.held_out.min())
        return (
            f"Trained({len(self.losses)} steps in {self.seconds:.1f} s, held-out loss {first:.4f} before, "
            f"{least:.4f} at best (step {self.best}))"
        )


def train(
    parameters: Trainable,
    objective: Objective,
    *,
    steps: int = 2000,
    optimiser: Optimiser = ADAM,
    checks: Checks = CHECKS,
    seed: int = 0,
    progress: bool = False,
) -> Trained:
    """Minimise an objective; the same seed gives the same parameters, whatever torch's generator is at.

    The learning rate falls to zero along half a cosine (Loshchilov and Hutter, ICLR 2017). Modules are in
    training mode during steps and in evaluation mode during checks and afterwards.

    Args:
        parameters: a module, a parameter, or several of them.
        objective: `forward_kl(...)`, `evidence_bound(...)`, or any function whose result is a loss that is
            attached to the parameters.
        steps: at most.
        optimiser: makes one for a list of parameters.
        checks: of the held-out loss.
        seed: of all draws; the initial values of the parameters are the caller's.
        progress: show a bar, on a terminal or in a notebook.

    Raises:
        InputError: there is no parameter that asks for gradients, or the loss depends on none.
        InferenceError: the loss, or that of held-out draws, is not finite.
    """
    modules, tensors = _listed(parameters)
    steps = whole_number("training is to make {} steps", steps)
    seed = seed_number(seed)
    begun = time.perf_counter()
    losses: list[float] = []
    with torch.random.fork_rng(devices=[]):
        seed_here(seed)
        optimiser_ = optimiser(tensors)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser_, steps)
        record = [(0, _finite(_held_out(objective, modules, checks, seed), 0))]
        best, kept = record[0], _values(modules, tensors)
        for number in watched(range(1, steps + 1), description="training", progress=progress):
            optimiser_.zero_grad()
            loss = objective()
            if not loss.requires_grad:
                raise InputError(
                    "the objective of training depends on no parameter; use them in the proposal, as torch "
                    "computes with them."
                )
            losses.append(_finite(float(loss.detach()), number))
            loss.backward()
            optimiser_.step()
            schedule.step()
            if number % checks.every and number < steps:
                continue
            record.append((number, _finite(_held_out(objective, modules, checks, seed), number)))
            if record[-1][1] < best[1]:
                best, kept = record[-1], _values(modules, tensors)
            late = sum(1 for made, _ in record if made > best[0])
            if late >= checks.patience:
                break
    _restore(modules, tensors, kept)
    made, held_out = zip(*record, strict=True)
    return Trained(
        torch.tensor(losses, dtype=torch.float64),
        torch.tensor(held_out, dtype=torch.float64),
        torch.tensor(made),
        best[0],
        time.perf_counter() - begun,
    )


def _listed(parameters: Trainable) -> tuple[list[Module], list[Tensor]]:
    """The modules, and all parameters that ask for gradients, each once."""
    given: list[Any] = [parameters] if isinstance(parameters, Module | Tensor) else list(parameters)
    modules = [each for each in given if isinstance(each, Module)]
    tensors = [p for each in given for p in (each.parameters() if isinstance(each, Module) else [each])]
    tensors = list({id(p): p for p in tensors if p.requires_grad}.values())
    if not tensors:
        raise InputError("training is given no parameter that asks for gradients; give a module or several.")
    return modules, tensors


def _finite(loss: float, number: int) -> float:
    if not math.isfinite(loss):
        raise InferenceError(
            f"the loss of training is {loss} at step {number}; use a smaller learning rate, or bound what "
            "the network gives."
        )
    return loss


def _held_out(objective: Objective, modules: list[Module], checks: Checks, seed: int) -> float:
    """The mean loss of some batches, drawn in the same way each time."""
    with torch.random.fork_rng(devices=[]), _evaluating(modules):
        seed_here(seed ^ HELD_OUT)
        return sum(float(objective().detach()) for _ in range(checks.batches)) / checks.batches


@contextmanager
def _evaluating(modules: list[Module]) -> Iterator[None]:
    for module in modules:
        module.eval()
    try:
        yield
    finally:
        for module in modules:
            module.train()


def _values(modules: list[Module], tensors: list[Tensor]) -> tuple[list[Any], list[Tensor]]:
    return [copy.deepcopy(m.state_dict()) for m in modules], [t.detach().clone() for t in tensors]


def _restore(modules: list[Module], tensors: list[Tensor], kept: tuple[list[Any], list[Tensor]]) -> None:
    for module, state in zip(modules, kept[0], strict=True):
        module.load_state_dict(state)
        module.eval()
    with torch.no_grad():
        for tensor, value in zip(tensors, kept[1], strict=True):
            tensor.copy_(value)
