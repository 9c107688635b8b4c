"""Depth images of a bag, those alone that a configuration asks for; and the intrinsics of their camera."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers.bag.reading import Bag, Message
from bcppl.recordings.importers.bag.rows import unstamped_words
from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields, ImageFields
from bcppl.recordings.importers.bench.configuration.field_types import Length, factor
from bcppl.recordings.importers.bench.depth_images import in_metres
from bcppl.recordings.importers.bench.sources import Shot

NEAR = 0.1  # s from a stated time within which an image must be
MOST_BYTES = 50_000_000  # of images as they are stored; with their depth in float64 five times as much
_DEPTHS: dict[str, tuple[str, Length]] = {
    "16UC1": ("u2", "mm"),
    "mono16": ("u2", "mm"),
    "32FC1": ("f4", "m"),
}
_BROWN = ("", "plumb_bob", "rational_polynomial", "none")  # with 5 coefficients; more have to be zero


class Images:
    """The images of one camera nearest to stated times, or `every` so many seconds.

    Args:
        name: of the camera.
        fields: its topic, and the times.
    """

    def __init__(self, name: str, fields: CameraFields) -> None:
        self._name, self._fields = name, fields
        unit = factor(fields.time_unit)
        self._wanted = [unit * (image.time or 0.0) for image in fields.images]
        self._kept: list[tuple[float, Message] | None] = [None] * len(self._wanted)
        self._due, self._bytes = -math.inf, 0
        self._unstamped, self._count = 0, 0
        self._parse: Any = None

    def add(self, bag: Bag, message: Message) -> None:
        """Keep an image if it is wanted, as it is stored."""
        stamp, unstamped = bag.raw_stamped(message)
        self._count += 1
        self._unstamped += unstamped
        self._parse = bag.parsed
        if self._fields.every is not None:
            if stamp >= self._due:
                self._due = stamp + self._fields.every * (1.0 - 1e-3)  # stamps scatter by less
                self._kept.append((stamp, message))
                self._weigh(len(message.raw))
            return
        for k, time in enumerate(self._wanted):
            best = self._kept[k]
            if best is None or abs(stamp - time) < abs(best[0] - time):
                self._kept[k] = (stamp, message)
                self._weigh(len(message.raw) - (0 if best is None else len(best[1].raw)))

    def shots(self, fields: CameraFields, size: tuple[int, int] | None) -> tuple[list[Shot], list[str]]:
        """The images, and how many stamps were zero.

        Args:
            fields: of the camera.
            size: height and width of which the intrinsics are, or None.

        Raises:
            InputError: an image is too far from its time, or nearest to two.
        """
        shots = []
        unit = factor(fields.time_unit)
        seen: dict[float, int] = {}
        for k, kept in enumerate(self._kept):
            assert kept is not None  # a topic without a message is refused before
            stamp, message = kept
            where = f"cameras.{self._name}.images[{k}].time"
            if self._wanted and abs(stamp - self._wanted[k]) > NEAR:
                raise InputError(
                    f"{where} is {self._wanted[k]:.3f} s, and the nearest image of {fields.topic} is of "
                    f"{stamp:.3f} s; give that, or another on the clock of the header stamps."
                )
            if stamp in seen:
                raise InputError(
                    f"{where} is nearest to the image of {stamp:.3f} s of {fields.topic}, as is that of "
                    f"images[{seen[stamp]}]; leave one of them out."
                )
            seen[stamp] = k
            label = f"of {stamp:.3f} s in {fields.topic}"
            read = functools.partial(_depth, f"the image {label}", self._parse, message, fields, size)
            shots.append(Shot(label, ImageFields(time=stamp / unit), read))
        return shots, unstamped_words(self._unstamped, self._count)

    def _weigh(self, count: int) -> None:
        self._bytes += count
        if self._bytes > MOST_BYTES:
            kept = sum(each is not None for each in self._kept)
            raise InputError(
                f"cameras.{self._name} asks for {kept} images and more of {self._fields.topic}, more than "
                f"{MOST_BYTES // 1_000_000} MB; give {'a longer every' if self._fields.every else 'fewer'}."
            )


class Intrinsics:
    """The first message of a camera's information, and when another differed from it."""

    def __init__(self) -> None:
        self._first: Any = None
        self._changed: float | None = None  # the stamp, s

    def add(self, bag: Bag, message: Message) -> None:
        """Keep the first, and the stamp of one that states something else."""
        info = bag.parsed(message)
        if self._first is None:
            self._first = info
        elif self._changed is None and _stated(info) != _stated(self._first):
            self._changed = bag.stamped(info.header, message)[0]

    def of(self, name: str, fields: CameraFields) -> CameraFields:
        """The fields with the intrinsics that the message states.

        Raises:
            InputError: it states none, binning or a part of the image, or another model of a lens; or a later
                message differs.
        """
        where = f"{fields.info}, which cameras.{name}.info names,"
        remedy = "state fx, fy, cx, cy and distortion in place of info"
        if self._changed is not None:
            raise InputError(
                f"{where} states other intrinsics from {self._changed:.3f} s on; cut the bag there, or "
                f"{remedy}."
            )
        rectified = "rect" in fields.topic.rpartition("/")[2]
        return fields.model_copy(update=intrinsics_of(where, self._first, remedy, rectified))

    @property
    def size(self) -> tuple[int, int] | None:
        """Height and width of the images that the intrinsics are of; None if they are not stated."""
        size = (int(self._first.height), int(self._first.width))
        return size if all(size) else None


def intrinsics_of(where: str, info: Any, remedy: str, rectified: bool = False) -> dict[str, Any]:
    """The focal lengths, principal point (pixels) and distortion that a CameraInfo states.

    Args:
        where: it is from, for messages.
        info: the message, of ROS 1 or ROS 2.
        remedy: what to do where it states none.
        rectified: whether the images are: their lens is P, without distortion.

    Raises:
        InputError: it states none, binning or a part of the image, or another model of a lens.
    """
    lens = [] if rectified else _numbers(info, "d")
    letter = "p" if rectified else "k"
    matrix = np.reshape(_numbers(info, letter), (3, -1))
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
        raise InputError(f"{where} states no intrinsics (its {letter.upper()} is not calibrated); {remedy}.")
    window = info.roi
    if max(info.binning_x, info.binning_y) > 1 or window.x_offset or window.y_offset:
        raise InputError(f"{where} states binning or a part of the image; {remedy} of the image itself.")
    if any(lens) and (info.distortion_model not in _BROWN or any(lens[5:])):
        raise InputError(f"{where} has the lens model {info.distortion_model!r}; rectify, and {remedy}.")
    stated = {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
    numbers = {key: float(value) for key, value in stated.items()}
    return {**numbers, "distortion": lens[:5] if any(lens) else []}


def _numbers(info: Any, letter: str) -> list[float]:
    """A matrix of a CameraInfo: ROS 1 writes its letter large, ROS 2 small."""
    return [float(each) for each in getattr(info, letter if hasattr(info, letter) else letter.upper())]


def _stated(info: Any) -> tuple[Any, ...]:
    """What a CameraInfo states of its lens, to be compared."""
    window = info.roi.x_offset, info.roi.y_offset
    size = info.height, info.width, info.binning_x, info.binning_y, info.distortion_model, *window
    return (*size, *(_numbers(info, letter) for letter in "dkp"))


def encoded(message: Any) -> Length | None:
    """The unit of an image's depth, by its encoding; None if it is no depth."""
    return _DEPTHS[message.encoding][1] if message.encoding in _DEPTHS else None


def pixels_of(
    where: str, image: Any, size: tuple[int, int], info: str = "its CameraInfo"
) -> tuple[Array, Length]:
    """The depths (H, W) of an Image, as they are encoded, and their unit.

    Args:
        where: it is from, for messages.
        image: the message.
        size: height and width that `info` states.
        info: what states the size, for messages.

    Raises:
        InputError: it is of another size, no depth, or incomplete.
    """
    if size != (image.height, image.width):
        raise InputError(
            f"{where} has {image.width} x {image.height} pixels, and {info} is of {size[1]} x "
            f"{size[0]}; give the info of these images."
        )
    if image.encoding not in _DEPTHS:
        raise InputError(
            f"{where} is encoded as {image.encoding!r}, and depth is 16UC1 or 32FC1; name the depth's topic."
        )
    kind, unit = _DEPTHS[image.encoding]
    dtype = np.dtype(f"{'>' if image.is_bigendian else '<'}{kind}")
    row = image.width * dtype.itemsize
    if image.step < row or len(image.data) < image.step * image.height or not row * image.height:
        raise InputError(f"{where} has fewer bytes than its {image.width} x {image.height} pixels need.")
    count = image.step * image.height
    data = np.frombuffer(image.data, dtype=np.uint8, count=count).reshape(image.height, image.step)
    return np.ascontiguousarray(data[:, :row]).view(dtype).astype(np.float64), unit


def _depth(
    where: str, parse: Any, message: Message, fields: CameraFields, size: tuple[int, int] | None
) -> Array:
    image = parse(message)
    pixels, unit = pixels_of(where, image, size or (image.height, image.width), fields.info or "")
    return in_metres(where, pixels, fields, unit)
