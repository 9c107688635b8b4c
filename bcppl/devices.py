"""Where numbers are worked on: the processor, or a GPU of torch's.

A run decides once: within `on_device` whatever is made is made there. All else follows the tensors that it is
given. Numbers of particles stay on the device; what is small, the same for all of them, and costs by
operations rather than by numbers (an approximation, the rows of a probe, an image) stays on the host, and is
worked on within `on_host`. `numbers` is the way of tensors to compiled code of the processor, `beside` the
way back.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl.errors import InputError

T = TypeVar("T")
HOST = torch.device("cpu")


def device_named(name: str | torch.device | None) -> torch.device:
    """Torch's device of a name, such as "cuda" or "cuda:1"; the processor for None.

    Raises:
        InputError: it is neither the processor nor a GPU that torch reaches.
    """
    if name is None:
        return HOST
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError) as error:
        raise InputError(f"{name!r} names no device; give 'cpu' or 'cuda'.") from error
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise InputError("device 'cuda' was asked for, and torch reaches no GPU; give 'cpu'.")
        if device.index is None:
            device = torch.device("cuda", torch.cuda.current_device())
        if device.index >= torch.cuda.device_count():
            raise InputError(f"{name!r} was asked for, and torch reaches {torch.cuda.device_count()} GPUs.")
    elif device.type != "cpu":
        raise InputError(f"runs are made on 'cpu' or 'cuda', not on {name!r}.")
    return device


_current = HOST


def current_device() -> torch.device:
    """The device of the run that this is part of; the processor outside of runs."""
    return _current


@contextmanager
def on_device(device: torch.device) -> Iterator[None]:
    """What is made within is made on the device, unless it is made of what is elsewhere.

    That holds for the whole process, as do torch's generators and the number of its threads.
    """
    before = _current
    if device == before:
        yield
        return
    _work_on(device)
    try:
        yield
    finally:
        _work_on(before)


def _work_on(device: torch.device) -> None:
    # Torch's own context, `with device:`, looks at each operation in Python: a run of 10,000 particles made
    # 730,000, which took a quarter of its time.
    global _current
    kind = "DoubleTensor" if torch.get_default_dtype() is torch.float64 else "FloatTensor"
    if device.type == "cuda":
        torch.cuda.set_device(device)
        kind = f"cuda.{kind}"
    torch.set_default_tensor_type(f"torch.{kind}")
    _current = device


@contextmanager
def on_host() -> Iterator[None]:
    """What is made within, or by a function that it decorates, is made on the processor."""
    with on_device(HOST):
        yield


def is_on_host(tensor: Tensor) -> bool:
    """Whether compiled code of the processor can read a tensor as it is."""
    return tensor.device.type == "cpu"


def numbers(tensor: Tensor) -> npt.NDArray[Any]:
    """The numbers of a tensor, wherever it is; not copied where that is the host."""
    return np.asarray((tensor if is_on_host(tensor) else tensor.detach().cpu()).numpy())


def on_device_of(values: npt.NDArray[Any] | Tensor, other: Tensor) -> Tensor:
    """The numbers on the device of another tensor; not copied where that is the host."""
    tensor = torch.from_numpy(values) if isinstance(values, np.ndarray) else values
    return tensor if tensor.device == other.device else tensor.to(other.device)


def to_device(value: T, device: torch.device) -> T:
    """A value whose tensors are on a device: a tensor, or what holds some.

    That is a tuple or mapping of such values, or an object with a method `on`, which is given the device;
    anything else is returned as it is.
    """
    result: Any = value
    if isinstance(value, Tensor):
        result = value if value.device == device else value.to(device)
    elif isinstance(value, tuple):
        each = [to_device(one, device) for one in value]
        result = value._make(each) if hasattr(value, "_make") else tuple(each)
    elif isinstance(value, Mapping):
        result = {name: to_device(one, device) for name, one in value.items()}
    elif hasattr(value, "on"):
        result = value.on(device)
    return cast(T, result)


_COPIES: dict[tuple[int, torch.device, torch.dtype], Tensor] = {}


def constant(values: Tensor, like: Tensor) -> Tensor:
    """A constant of a module on the device of another tensor, numbers of its type; copied once for each."""
    kind = like.dtype if values.is_floating_point() else values.dtype
    if values.device == like.device and values.dtype == kind:
        return values
    key = id(values), like.device, kind
    if key not in _COPIES:
        _COPIES[key] = values.to(device=like.device, dtype=kind)
    return _COPIES[key]


def random_state(device: torch.device) -> Tensor:
    """The state of torch's generators, bytes: that of the processor, then that of a GPU."""
    state = torch.get_rng_state()
    if device.type == "cpu":
        return state
    return torch.cat([state, torch.cuda.get_rng_state(device)])


def set_random_state(state: Tensor, device: torch.device) -> None:
    """Set torch's generators to a state as of `random_state`."""
    size = len(torch.get_rng_state())
    torch.set_rng_state(state[:size])
    if device.type != "cpu":
        torch.cuda.set_rng_state(state[size:], device)


def seeded_state(seed: int, device: torch.device) -> Tensor:
    """The state of generators that are seeded."""
    state = torch.Generator(HOST).manual_seed(seed).get_state()
    if device.type == "cpu":
        return state
    return torch.cat([state, torch.Generator(device).manual_seed(seed).get_state()])


def seed_here(seed: int) -> None:
    """Seed torch's generators of the processor and of the run's device, and no others."""
    # `torch.manual_seed` would seed those of all GPUs, also within `on_host`.
    device = current_device()
    torch.default_generator.manual_seed(seed)
    if device.type != "cpu":
        torch.cuda.set_rng_state(torch.Generator(device).manual_seed(seed).get_state(), device)


_LOCK = threading.RLock()


def _unlock() -> None:
    global _LOCK
    _LOCK = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unlock)  # the thread that holds it stays behind


@contextmanager
def alone() -> Iterator[None]:
    """What is run within is run by one thread of the process at a time.

    Pyro's handlers, torch's generators, its default type and its number of threads are those of all threads.
    """
    with _LOCK:
        yield


@contextmanager
def same_random_state() -> Iterator[None]:
    """Torch's generators, that of the run's device too, are afterwards as they were before."""
    with alone():
        device = current_device()
        state = random_state(device)
        try:
            yield
        finally:
            set_random_state(state, device)
