"""Plain data in a file, equal to the bit: tensors, arrays, numbers, text, mappings and sequences of them.

Nothing else is written, and nothing that is read runs code. An HDF5 file holds two datasets: `structure`,
JSON text in which an array is its type, shape and strides, and `numbers`, the arrays' bytes in the same
order. With one dataset for each array a series of a thousand steps would take sixty times as long. Strides
are kept, since sums round by them.
"""

from __future__ import annotations

import hashlib
import json
from collections import namedtuple
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from bcppl.errors import InputError

STRUCTURE, NUMBERS, DIGEST = "structure", "numbers", "sha256"
NUMERIC = "biufc"  # kinds of numpy's types
WIDEST = 16  # an array of gaps may take so many times the memory of its numbers
DAMAGED = "it is damaged or was changed; save it again."


class NotPlainError(TypeError):
    """A value is no plain data; the message is its type."""


def plain(value: Any) -> Any:
    """The value without what may be computed: tensors detached, numpy's numbers made Python's.

    Raises:
        NotPlainError: it holds something else than plain data.
    """
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, Tensor):
        return value.detach()
    if isinstance(value, np.ndarray) and value.dtype.kind in NUMERIC:
        return value
    if isinstance(value, np.generic) and value.dtype.kind in NUMERIC:
        return value.item()
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        each = [plain(part) for part in value]
        return type(value)(*each) if hasattr(value, "_fields") else type(value)(each)
    raise NotPlainError(type(value).__name__)


def write(file: h5py.File, content: Mapping[str, Any]) -> None:
    """Write plain data and a hash of them."""
    blocks: list[bytes] = []
    structure = json.dumps(_described(content, blocks)).encode()
    for name, data in ((STRUCTURE, structure), (NUMBERS, b"".join(blocks))):
        file.create_dataset(name, data=np.frombuffer(data, dtype=np.uint8))
    file.attrs[DIGEST] = _digest(structure, b"".join(blocks))


def read(file: h5py.File) -> Any:
    """The plain data of a file.

    Raises:
        InputError: they are not those that were written.
    """
    structure, numbers = (_bytes(file, name) for name in (STRUCTURE, NUMBERS))
    if file.attrs[DIGEST] != _digest(structure, numbers):
        raise InputError(DAMAGED)
    return _made(json.loads(structure), numbers)


def _digest(structure: bytes, numbers: bytes) -> str:
    total = hashlib.sha256(structure)
    total.update(numbers)
    return total.hexdigest()


def _bytes(file: h5py.File, name: str) -> bytes:
    """The bytes of a dataset that lie in this file: links and virtual datasets would lead to others."""
    held = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
    if (
        not isinstance(held, h5py.Dataset)
        or (held.dtype != np.uint8 or held.ndim != 1)
        or (held.is_virtual or held.external or held.chunks)
        or held.id.get_storage_size() != held.size
    ):
        raise InputError(DAMAGED)
    return np.asarray(held[()]).tobytes()


def _described(value: Any, blocks: list[bytes]) -> Any:
    """JSON of plain data; the bytes of arrays are appended to the blocks."""
    if isinstance(value, Tensor | np.ndarray):
        kind = "tensor" if isinstance(value, Tensor) else "array"
        strides, tensor = _collapsed(value if isinstance(value, Tensor) else torch.from_numpy(value))
        array = tensor.numpy(force=True)
        blocks.append(np.ascontiguousarray(array).tobytes())
        return [kind, array.dtype.str, list(array.shape), strides]
    if isinstance(value, Mapping):
        return {key: _described(each, blocks) for key, each in value.items()}
    if isinstance(value, list | tuple):
        kind = "list" if isinstance(value, list) else "tuple"
        names = list(getattr(value, "_fields", ()))
        return ["named" if names else kind, names, [_described(each, blocks) for each in value]]
    return plain(value)


def _made(description: Any, numbers: bytes) -> Any:
    """The plain data of a description; arrays follow one another in the bytes."""
    reached = 0

    def made(part: Any) -> Any:
        nonlocal reached
        if isinstance(part, dict):
            return {key: made(each) for key, each in part.items()}
        if not isinstance(part, list):
            return part
        kind, *rest = part
        if kind in ("tensor", "array"):
            name, shape, strides = rest
            dtype, count = np.dtype(name), int(np.prod(shape, dtype=np.int64))
            if dtype.kind not in NUMERIC or min(shape, default=0) < 0:
                raise InputError(DAMAGED)
            flat = np.frombuffer(numbers, dtype, count, reached)
            reached += flat.nbytes
            tensor = _expanded(torch.tensor(flat).reshape(shape), strides)
            return tensor if kind == "tensor" else tensor.numpy()
        names, parts = rest
        each = [made(one) for one in parts]
        if kind == "named":
            return namedtuple("State", names)(*each)
        return each if kind == "list" else tuple(each)

    content = made(description)
    if reached != len(numbers):
        raise InputError(DAMAGED)
    return content


def _collapsed(value: Tensor) -> tuple[list[int], Tensor]:
    """The strides of a tensor, and the tensor with one entry along axes whose entries are all the same.

    Of such an axis the stride is minus its size.
    """
    strides = list(value.stride())
    for axis, (size, stride) in enumerate(zip(value.shape, strides, strict=True)):
        if stride == 0 and size > 1:
            value = value.narrow(axis, 0, 1)
            strides[axis] = -size
    return strides, value


def _expanded(value: Tensor, strides: list[int]) -> Tensor:
    """The tensor with its strides; in the usual order where these are no strides of it."""
    shape, inner = list(value.shape), [max(stride, 0) for stride in strides]
    reach = 1 + sum((size - 1) * stride for size, stride in zip(shape, inner, strict=True))
    if value.numel() and reach <= WIDEST * value.numel() and _injective(shape, inner):
        value = torch.empty_strided(shape, inner, dtype=value.dtype).copy_(value)
    sizes = [-stride if stride < 0 and n == 1 else n for n, stride in zip(shape, strides, strict=True)]
    return value.expand(sizes) if sizes != shape else value


def _injective(shape: list[int], strides: list[int]) -> bool:
    """Whether different entries lie in different places."""
    reach = 0
    for stride, size in sorted(
        (stride, size) for size, stride in zip(shape, strides, strict=True) if size > 1
    ):
        if stride <= reach:
            return False
        reach += (size - 1) * stride
    return True


def same(first: Any, second: Any) -> bool:
    """Whether two plain data are equal to the bit."""
    blocks: tuple[list[bytes], list[bytes]] = ([], [])
    one, other = (_described(value, each) for value, each in zip((first, second), blocks, strict=True))
    return json.dumps(one) == json.dumps(other) and blocks[0] == blocks[1]
