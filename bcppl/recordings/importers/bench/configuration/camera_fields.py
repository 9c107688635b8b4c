"""The fields of a depth camera in a bench's configuration, and of its images."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from bcppl.recordings.importers.bench.configuration.field_types import (
    Above,
    AtLeast,
    Fields,
    Length,
    PoseFields,
    Time,
)


class ImageFields(Fields):
    """One depth image: when it was taken, or where the frame or the camera was; or of a fixed camera."""

    file: str = ""
    time: float | None = None
    world_from_frame: PoseFields | None = None


class CameraFields(Fields):
    """A depth camera: its intrinsics (pixels), the unit of its images, its range (m) and its pose.

    With a topic, its images are those of a bag at stated times or `every` so many seconds, and `info` is
    the topic that states its intrinsics.
    """

    topic: str = ""
    info: str = ""
    every: Above | None = None
    fx: Above | None = None
    fy: Above | None = None
    cx: float | None = None
    cy: float | None = None
    distortion: list[float] = []
    unit: Length | None = None
    scale: Above | None = None
    near: AtLeast
    far: Above
    world_from_camera: PoseFields | None = None
    frame_from_camera: PoseFields | None = None
    time_unit: Time = "s"
    images: list[ImageFields] = []
    background: str | None = None

    @property
    def needs_motion(self) -> bool:
        """Whether an image is placed by where the robot was at its time."""
        stated = self.images and all(image.world_from_frame is not None for image in self.images)
        return self.frame_from_camera is not None and not stated

    @model_validator(mode="after")
    def _sourced(self) -> Self:
        stated = [each is not None for each in (self.fx, self.fy, self.cx, self.cy)]
        if not self.info and not all(stated):
            lacking = [n for n, given in zip(("fx", "fy", "cx", "cy"), stated, strict=True) if not given]
            raise ValueError(f"lacks {' and '.join(lacking)}; add {'it' if len(lacking) == 1 else 'them'}")
        if self.info and (any(stated) or self.distortion):
            raise ValueError("has both info, a topic that states its intrinsics, and intrinsics; give one")
        if not self.topic:
            if self.info or self.every is not None:
                raise ValueError("has info or every, which are for images of a topic; name the topic")
            if not self.images or not all(image.file for image in self.images):
                raise ValueError("needs images, each with its file")
            return self
        if (self.every is None) == (not self.images):
            raise ValueError("needs either images, each with its time, or every (s)")
        if any(image.file or image.time is None or image.world_from_frame for image in self.images):
            raise ValueError("has images of a topic: give each its time alone")
        return self

    @model_validator(mode="after")
    def _placed(self) -> Self:
        if not self.topic and (self.unit is None) == (self.scale is None):
            raise ValueError("needs either unit (of its depth) or scale (metres per count)")
        if self.unit is not None and self.scale is not None:
            raise ValueError("has both unit and scale; give one")
        if (self.world_from_camera is None) == (self.frame_from_camera is None):
            raise ValueError("needs either world_from_camera (it stands) or frame_from_camera (on the arm)")
        if self.near >= self.far:
            raise ValueError(f"has a range from {self.near:g} to {self.far:g} m; give near below far")
        for image in self.images:
            placed = (image.time is None) != (image.world_from_frame is None)
            if self.frame_from_camera is not None and not placed:
                raise ValueError(
                    f"is on the arm: give its image {image.file} either time or world_from_frame"
                )
            if self.frame_from_camera is None and image.world_from_frame is not None:
                raise ValueError(f"stands: its image {image.file} has no world_from_frame; leave it out")
        if self.background is not None and self.world_from_camera is None:
            raise ValueError("is on the arm: a background is of a camera that stands; leave it out")
        return self
