"""Torch's tensors as Warp's arrays, on the same device and without a copy, and kernels launched on these.

A kernel is launched on torch's stream: it reads what torch has written before, and torch what it has written.
"""

from __future__ import annotations

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


def rows_of(tensor: Tensor) -> Any:
    """A tensor (N, K) as an array of numbers."""
    return array_of(tensor, wp.float64)


def launch(kernel: Any, shape: int | Sequence[int], inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
    """Launch a kernel on the device of its first output, an array."""
    device = outputs[0].device
    stream = wp.stream_from_torch(torch_device(device)) if device.is_cuda else None
    wp.launch(kernel, dim=shape, inputs=[*inputs], outputs=[*outputs], device=device, stream=stream)
