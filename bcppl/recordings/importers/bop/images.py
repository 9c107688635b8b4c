"""Images of a BOP scene: depth as PNG or TIFF of 16 bits, colour as PNG or JPEG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bcppl.arrays import Array
from bcppl.errors import InputError, reason_of
from bcppl.recordings.image_files import opened

DEPTHS: dict[str, tuple[str, ...]] = {".png": ("I;16", "I"), ".tif": ("I;16",), ".tiff": ("I;16",)}  # modes
COLOURS: dict[str, tuple[str, ...]] = {".png": ("RGB",), ".jpg": ("RGB",)}
_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".tif": "TIFF", ".tiff": "TIFF"}


def depth_in_metres(path: Path, scale: float) -> Array:
    """The depth (H, W), metres, NaN where it is missing; rounded to float32, as recordings keep it.

    Args:
        path: of the image.
        scale: millimetres per count.

    Raises:
        InputError: as `pixels`.
    """
    counts = pixels(path, DEPTHS[path.suffix]).astype(np.float64)
    metres = 1e-3 * scale * counts
    metres[counts == 0] = np.nan
    return metres.astype(np.float32).astype(np.float64)


def pixels(path: Path, modes: Sequence[str]) -> npt.NDArray[Any]:
    """The pixels of an image; the checksums of a PNG are compared.

    Raises:
        InputError: it is missing, has none of the modes, is damaged, or too large for the bytes it has.
    """
    try:
        with opened(path, [_FORMATS[path.suffix]]) as image:
            if image.mode not in modes:
                raise ValueError(f"its mode is {image.mode}, not {' or '.join(modes)}")
            return np.asarray(image)
    except Exception as error:  # Pillow raises SyntaxError, struct.error, zlib.error and others
        reason = getattr(error, "strerror", None) or reason_of(error)
        what = f"{path} is missing or is no image that can be read ({reason})"
        raise InputError(f"{what}; give the folder of a BOP scene.") from error
