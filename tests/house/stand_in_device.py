"""A stand-in for a GPU: the processor works, under another device's name, and refuses what CUDA would.

Within `stand_in` tensors made on or moved to `GPU` are marked as there. Torch's functions refuse to mix
them with those of the host (indices and numbers aside), and `Tensor.numpy()` refuses them. Kernels of Warp's
run on its processor back end.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
import warp as wp
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._device import _device_constructors
from torch.utils._pytree import tree_flatten, tree_map

from bcppl import devices, warp_arrays
from bcppl.inference import resampling
from bcppl.inference.filters import smc
from bcppl.sensors.likelihoods import erring_camera

GPU = torch.device("cuda:0")
# What asks for numbers or shapes, as a GPU's tensor answers it.
ANSWERS = ("__float__", "__int__", "__bool__", "__index__", "item", "tolist", "is_nonzero", "__len__", "size")
ANSWERS += ("dim", "stride", "numel", "is_floating_point", "is_complex", "is_contiguous", "__repr__")
INDEXING = ("__getitem__", "__setitem__")


class There(Tensor):
    """A tensor that is marked as on the GPU."""

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, held: Tensor) -> There:
        """Mark a tensor of the host, whose numbers it shares."""
        made: There = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls, held.size(), strides=held.stride(), dtype=held.dtype, device=GPU
        )
        made.held = held
        return made

    held: Tensor

    def __hash__(self) -> int:
        return id(self)

    @classmethod
    def __torch_dispatch__(cls, function: Any, *_: Any) -> Any:
        raise AssertionError(f"{function} reached a tensor of the stand-in past its mode")


def _held(value: Any) -> Any:
    return value.held if isinstance(value, There) else value


def _marked(value: Any) -> Any:
    return There(value) if isinstance(value, Tensor) and not isinstance(value, There) else value


class _Mode(TorchFunctionMode):
    """Torch's functions as they work on tensors that are marked."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(function, "__name__", "")
        if function in (Tensor.device.__get__, Tensor.is_cuda.__get__, Tensor.__hash__):  # type: ignore[attr-defined]
            return function(*args, **kwargs)
        copies = name == "as_tensor" and isinstance(args[0], Tensor)
        if devices.current_device() == GPU and function in _device_constructors() and not copies:
            kwargs.setdefault("device", GPU)
        given = [each for each in tree_flatten((args, kwargs))[0] if isinstance(each, Tensor)]
        target = _target(name, args, kwargs)
        if not any(isinstance(each, There) for each in given) and target in (None, devices.HOST):
            return function(*args, **kwargs)
        if name in ANSWERS:
            return function(*map(_held, args), **kwargs)
        if name == "numpy":
            raise TypeError("a tensor on the GPU has no array of numpy's")
        if name not in ("to", "copy_", "as_tensor"):
            _refuse_mixed(name, args, given)
        if "device" in kwargs:
            kwargs["device"] = devices.HOST
        own = [devices.HOST if isinstance(each, torch.device) else each for each in args]
        result = function(*tree_map(_held, own), **tree_map(_held, kwargs))
        stays = target == devices.HOST or (name == "copy_" and not isinstance(args[0], There))
        if stays or isinstance(result, torch.Size):
            return result
        same = [each for each in given if isinstance(each, There) and each.held is result]
        return same[0] if same else tree_map(_marked, result)


def _target(name: str, args: Any, kwargs: Any) -> torch.device | None:
    """The device that a call asks for."""
    if name == "cpu":
        return devices.HOST
    device = kwargs.get("device")
    for each in args[1:] if name == "to" else ():
        device = each if isinstance(each, torch.device) else device
        if isinstance(each, Tensor):
            device = GPU if isinstance(each, There) else devices.HOST
    return None if device is None else torch.device(device)


def _refuse_mixed(name: str, args: Any, given: list[Tensor]) -> None:
    if name in INDEXING and isinstance(args[0], There):
        given = [
            args[0],
            *(each for each in args[2:] if isinstance(each, Tensor)),
        ]  # indices are copied there
    host = [each for each in given if not isinstance(each, There) and each.ndim > 0]
    if host and any(isinstance(each, There) for each in given):
        shapes = [tuple(each.shape) for each in given]
        raise RuntimeError(f"{name} is given tensors of both devices, of shapes {shapes}")


def _array_of(tensor: Tensor, kind: Any) -> Any:
    assert isinstance(tensor, There), "Warp is given a tensor of the host"
    return wp.from_torch(tensor.held.detach().contiguous(), dtype=kind, requires_grad=False)


def _launch(kernel: Any, shape: Any, inputs: Any, outputs: Any) -> None:
    given = [_array_of(*each) if isinstance(each, tuple) else each for each in inputs]
    written = [wp.from_torch(each.held, dtype=kind, requires_grad=False) for each, kind in outputs]
    wp.launch(kernel, dim=shape, inputs=[*given, *written], device="cpu")


def _work_on(device: torch.device) -> None:
    devices._current = device


@contextmanager
def stand_in(patch: pytest.MonkeyPatch) -> Iterator[None]:
    """Runs with `device="cuda"` are made on the stand-in, with the random numbers of the host."""
    patch.setattr(devices, "_work_on", _work_on)
    replaced = {
        "device_named": lambda name: devices.HOST if name is None else GPU,
        "random_state": lambda device: torch.get_rng_state(),
        "seeded_state": lambda seed, device: torch.Generator().manual_seed(seed).get_state(),
        "set_random_state": lambda state, device: torch.set_rng_state(state),
        "seed_here": lambda seed: torch.default_generator.manual_seed(seed),
    }
    for name, function in replaced.items():
        for module in (devices, smc, resampling, erring_camera):
            patch.setattr(module, name, function, raising=False)
    patch.setattr(warp_arrays, "warp_device", lambda device: wp.get_device("cpu"))
    patch.setattr(warp_arrays, "torch_device", lambda device: GPU)
    patch.setattr(warp_arrays, "array_of", _array_of)
    patch.setattr(warp_arrays, "launch", _launch)
    with _Mode():
        yield
