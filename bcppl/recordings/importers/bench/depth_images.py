"""Depth images of files: 16 bit PNG, .npy or EXR."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.array_files import npy
from bcppl.recordings.hdf5 import one_line
from bcppl.recordings.image_files import opened
from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields
from bcppl.recordings.importers.bench.configuration.field_types import Length, factor

_COLOURS = {2: "red, green and blue", 3: "a palette", 4: "grey and alpha", 6: "red, green, blue and alpha"}


def read_depth(path: Path, fields: CameraFields) -> Array:
    """A depth image (H, W) in metres, NaN where missing; rounded to float32, as recordings keep it.

    Raises:
        InputError: the file is missing, of another kind, or holds no image of one channel.
    """
    if not path.is_file():
        raise InputError(f"there is no depth image {path}; give its path relative to the configuration.")
    return in_metres(str(path), _pixels(path), fields)


def in_metres(where: str, pixels: Array, fields: CameraFields, unit: Length = "m") -> Array:
    """A depth image (H, W) in metres, NaN where missing; rounded to float32, as recordings keep it.

    Args:
        where: the image is from, for messages.
        pixels: (H, W) as they were logged.
        fields: the unit or scale of pixels, and the range that their median is checked with.
        unit: of pixels if neither is stated.

    Raises:
        InputError: the depth is far from the camera's range.
    """
    scale = factor(fields.unit or unit) if fields.scale is None else fields.scale
    depth = scale * pixels
    depth[~np.isfinite(depth) | (depth <= 0.0)] = np.nan
    if not np.isfinite(depth).any():
        raise InputError(f"{where} has no pixel with a depth; leave it out, or see where its camera looked.")
    middle = float(np.nanmedian(depth))
    if not fields.near / 3.0 <= middle <= 3.0 * fields.far:
        raise InputError(
            f"{where} has a median depth of {middle:.4g} m, for a camera that sees from {fields.near:g} to "
            f"{fields.far:g} m; state the unit of its depth."
        )
    return np.asarray(depth.astype(np.float32).astype(np.float64))


def _pixels(path: Path) -> Array:
    kind = path.suffix.lower()
    if kind == ".exr":
        pixels: Any = _exr(path)
    elif kind == ".npy":
        try:
            pixels = npy(path)
        except Exception as error:  # numpy has errors of many types
            raise InputError(f"{path} holds no plain numbers ({one_line(error)}); save it again.") from error
    elif kind in (".png", ".tif", ".tiff"):
        try:
            with opened(path, ["PNG", "TIFF"]) as image:
                pixels = np.asarray(image)
        except Exception as error:  # Pillow raises SyntaxError, struct.error, zlib.error and others
            raise InputError(
                f"{path} is no image ({one_line(error)}); export the depth again as 16 bit PNG."
            ) from error
        _refuse_colours(path)
        if pixels.dtype == np.uint8:
            raise InputError(f"{path} has 8 bits, too few for a depth; export it as 16 bit PNG or .npy.")
    else:
        raise InputError(f"{path} ends in {kind!r}; give a depth image as .png (16 bit), .npy or .exr.")
    if pixels.ndim != 2 or pixels.dtype.kind not in "iuf":
        raise InputError(f"{path} holds {pixels.dtype} of shape {pixels.shape}; give one channel of depth.")
    return np.asarray(pixels, dtype=np.float64)


def _refuse_colours(path: Path) -> None:
    """Refuse a PNG of several channels, of which Pillow reads 8 of 16 bits."""
    with path.open("rb") as file:
        header = file.read(26)
    if header.startswith(b"\x89PNG") and (colours := _COLOURS.get(header[25])):
        raise InputError(
            f"{path} is a PNG of {header[24]} bits with {colours}; export its depth as "
            "one channel of 16 bits."
        )


def _exr(path: Path) -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError(
            f"{path} is an EXR image, which needs OpenEXR: pip install 'bcppl[bench]'; or save it as .npy."
        ) from error
    try:
        with OpenEXR.File(str(path)) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
            data, shown = (
                np.asarray(file.header()[f"{each}Window"]).tolist() for each in ("data", "display")
            )
    except Exception as error:  # the library's own
        raise InputError(f"{path} cannot be read as EXR ({error}); save it again.") from error
    if data != shown:
        raise InputError(
            f"{path} has pixels from {data[0]} to {data[1]} of an image from {shown[0]} to {shown[1]}; save "
            "the whole image, for the intrinsics are of that."
        )
    for name in ("Z", "Y", "R", "depth.Z"):
        if name in channels:
            return channels[name]
    if len(channels) == 1:
        return next(iter(channels.values()))
    raise InputError(f"{path} has the channels {', '.join(channels)}; save the depth as channel Z.")
