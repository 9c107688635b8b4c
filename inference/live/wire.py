"""Messages on a socket: MessagePack maps after their length, four bytes, big-endian; nothing in them is code.

An array is the map `{"shape": [2, 3], "float64": bytes}` (or float32), little-endian and in row order.
"""

from __future__ import annotations

import math
import struct
from typing import Any, TypeVar

import msgpack
import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError

LARGEST = (32 << 20) + (64 << 10)  # bytes of a message: an image of 2048 x 2048 as float64, and its camera
GREETING = 1 << 10  # bytes of a client's first message, which is read before its token is known
MOST = 1 << 12  # maps and lists of a message: a row of numbers may be a list
DEEPEST = 6  # maps or lists within one another
LENGTH = struct.Struct(">I")
T = TypeVar("T")
TYPES = {"float64": "<f8", "float32": "<f4"}


def packed(message: dict[str, Any]) -> bytes:
    """A message with its length before it."""
    body = msgpack.packb(message, default=_packed_array)
    return LENGTH.pack(len(body)) + body


def length_of(header: bytes, most: int = LARGEST) -> int:
    """The length of a message's body.

    Raises:
        InputError: it is empty, or larger than `most`.
    """
    (length,) = LENGTH.unpack(header)
    if not 0 < length <= most:
        raise InputError(f"a message of {length} bytes is announced; send 1 to {most}.")
    return int(length)


def unpacked(body: bytes) -> dict[str, Any]:
    """A message of its body.

    Raises:
        InputError: it is no MessagePack map, holds too many maps and lists, is nested too deeply, or has an
            array that is none.
    """
    left = MOST

    def counted(held: T) -> T:
        nonlocal left
        left -= 1
        if left < 0:
            raise InputError(f"a message holds more than {MOST} maps and lists; send arrays as bytes.")
        return held

    try:
        read = msgpack.unpackb(
            body,
            raw=False,
            strict_map_key=True,
            max_str_len=1 << 16,
            max_bin_len=LARGEST,
            max_array_len=1 << 20,
            max_map_len=1 << 10,
            max_ext_len=0,
            list_hook=counted,
            object_hook=counted,
        )
    except InputError:
        raise
    except Exception as error:  # the library raises its own, ValueError, and those of Unicode
        raise InputError(f"a message is no MessagePack ({type(error).__name__}); send one map.") from error
    if not isinstance(read, dict) or not all(isinstance(name, str) for name in read):
        raise InputError("a message is no map of names; send {'ask': 'belief'}, say.")
    return {name: _arrays(value, 1) for name, value in read.items()}


def _arrays(value: Any, depth: int) -> Any:
    if depth > DEEPEST:
        raise InputError(f"a message is nested more than {DEEPEST} deep; send arrays as bytes.")
    if isinstance(value, list):
        return [_arrays(each, depth + 1) for each in value]
    if not isinstance(value, dict):
        return value
    kind = next((name for name in TYPES if name in value), None)
    if kind is not None and "shape" in value:
        return _array(value["shape"], kind, value[kind])
    return {name: _arrays(each, depth + 1) for name, each in value.items()}


def _array(shape: Any, kind: str, data: Any) -> Array:
    whole = (
        isinstance(shape, list)
        and len(shape) <= 3
        and all(type(n) is int and 0 <= n <= LARGEST for n in shape)
    )
    size = np.dtype(TYPES[kind]).itemsize
    if not whole or not isinstance(data, bytes) or len(data) != size * math.prod(shape):
        raise InputError(
            f"an array's shape does not fit its bytes; send shape and {kind} of as many numbers."
        )
    return np.frombuffer(data, TYPES[kind]).reshape(shape).astype(np.float64)


def _packed_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        name = "float32" if value.dtype == np.float32 else "float64"
        return {"shape": list(value.shape), name: np.ascontiguousarray(value, TYPES[name]).tobytes()}
    raise TypeError(f"a {type(value).__name__} cannot be sent")
