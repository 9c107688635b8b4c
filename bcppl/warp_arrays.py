"""Torch's tensors as Warp's arrays, on the same device and without a copy, and kernels launched on these.

A kernel is launched on torch's stream: it reads what torch has written before, and torch what it has written.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

wp.config.quiet = True
wp.init()


def warp_device(device: torch.device | str | None) -> Any:
    """Warp's device that is torch's, or that has a name of Warp's; a GPU where there is one for None."""
    if isinstance(device, torch.device):
        return wp.device_from_torch(device)
    return wp.get_device(device)


def torch_device(device: Any) -> torch.device:
    """Torch's device that is Warp's."""
    return torch.device(str(device)) if device.is_cuda else torch.device("cpu")


def array_of(tensor: Tensor, kind: Any) -> Any:
    """A tensor as an array of some kind, such as `wp.vec3`, whose numbers have the tensor's type."""
    return wp.from_torch(tensor.detach().contiguous(), dtype=kind, requires_grad=False)


def argument_of(tensor: Tensor, kind: Any) -> Any:
    """The same for one launch, which takes half as long; the tensor, contiguous, is kept by the caller."""
    return wp.from_torch(tensor, dtype=kind, requires_grad=False, return_ctype=True)


@functools.cache
def _stream(handle: int, device: torch.device) -> Any:
    return wp.Stream(wp.device_from_torch(device), cuda_stream=handle)


def launch(
    kernel: Any,
    shape: int | Sequence[int],
    inputs: Sequence[Any],
    outputs: Sequence[tuple[Tensor, Any]],
) -> None:
    """Launch a kernel.

    Args:
        kernel: one of Warp's.
        shape: of its threads.
        inputs: a pair of a tensor and the kind of its entries for an array; anything else as Warp takes it.
        outputs: such pairs, contiguous, on the device of the launch.
    """
    device = outputs[0][0].device
    given = [(each[0].detach().contiguous(), each[1]) if isinstance(each, tuple) else each for each in inputs]
    arguments = [argument_of(*each) if isinstance(each, tuple) else each for each in (*given, *outputs)]
    if device.type == "cpu":
        wp.launch(kernel, dim=shape, inputs=arguments, device="cpu")
        return
    stream = _stream(torch.cuda.current_stream(device).cuda_stream, device)
    wp.launch(kernel, dim=shape, inputs=arguments, stream=stream)
