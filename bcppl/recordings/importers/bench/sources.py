"""What a log's streams and images are read from: files, or a bag beside files."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields, ImageFields
from bcppl.recordings.importers.bench.configuration.field_types import factor
from bcppl.recordings.importers.bench.configuration.fields import StreamFields
from bcppl.recordings.importers.bench.depth_images import read_depth
from bcppl.recordings.importers.bench.table import read_columns


@dataclass(frozen=True, eq=False)
class Shot:
    """One depth image.

    Attributes:
        label: of the image in messages.
        image: when it was taken.
        read: the depth (H, W) in metres.
    """

    label: str
    image: ImageFields
    read: Callable[[], Array]


class Log(Protocol):
    """Where the importer reads streams and images.

    Attributes:
        folder: that paths in the configuration are relative to.
    """

    folder: Path

    def rows(self, name: str, fields: StreamFields) -> tuple[Array, list[str]]:
        """Stamps in seconds and columns (T, 1 + C) of a stream, and what was done to read them."""

    def intrinsics(self, name: str, fields: CameraFields) -> CameraFields:
        """The fields of a camera with its intrinsics."""

    def shots(self, name: str, fields: CameraFields) -> tuple[list[Shot], list[str]]:
        """The images of a camera, in order, and what was done to read them."""


class Files:
    """A log of files in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def rows(self, name: str, fields: StreamFields) -> tuple[Array, list[str]]:
        """Stamps in seconds and columns (T, 1 + C) of a stream's file; nothing to report.

        Raises:
            InputError: the file cannot be read, or the stream is a topic's.
        """
        _refuse_topic(name, fields.topic)
        table = read_columns(self.folder / fields.file, [fields.time.column, *fields.columns])
        table[:, 0] *= factor(fields.time.unit)
        return table, []

    def intrinsics(self, name: str, fields: CameraFields) -> CameraFields:
        """The fields as they are stated.

        Raises:
            InputError: they name a topic.
        """
        _refuse_topic(f"cameras.{name}", fields.topic)
        return fields

    def shots(self, name: str, fields: CameraFields) -> tuple[list[Shot], list[str]]:
        """The images that the fields name, each read when it is asked for; nothing to report."""
        paths = [self.folder / image.file for image in fields.images]
        reading = [functools.partial(read_depth, path, fields) for path in paths]
        return [Shot(i.file, i, read) for i, read in zip(fields.images, reading, strict=True)], []


def _refuse_topic(name: str, topic: str) -> None:
    if topic:
        raise InputError(
            f"{name} names the topic {topic} of a bag; give the bag: bcppl import bag BAG CONFIG."
        )
