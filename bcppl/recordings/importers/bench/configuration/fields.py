"""The fields of a bench's configuration, as pydantic models: strict, and without any that are not known.

Poses are named after the frames that they take from and to; `frame` is the robot's frame whose pose is
logged, such as the flange or the tool's centre.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields
from bcppl.recordings.importers.bench.configuration.field_types import (
    Above,
    Angle,
    AtLeast,
    Fields,
    Force,
    Length,
    Name,
    PoseFields,
    Rotation,
    Three,
    Time,
    Torque,
)

EVERY_JOINT = "*"  # in place of names: all joints of the robot up to its tip


class TimeFields(Fields):
    """The column of a stream's stamps, and their unit."""

    column: Name
    unit: Time


class StreamFields(Fields):
    """A stream: a file, its stamps and its columns by name; or a topic of a bag, which states them."""

    BY_TOPIC: ClassVar[dict[str, Any]] = {"file": "", "time": {"column": "stamp", "unit": "s"}}
    UNLESS_STATED: ClassVar[dict[str, Any]] = {}

    file: str
    topic: str = ""
    time: TimeFields
    columns: Annotated[list[Name], Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _of_a_topic(cls, content: Any) -> Any:
        if not isinstance(content, dict) or "topic" not in content:
            return content
        for name in content.keys() & cls.BY_TOPIC.keys():
            raise ValueError(f"names a topic, whose messages state {name!r}; leave that out")
        return {**cls.UNLESS_STATED, **content, **cls.BY_TOPIC}

    @model_validator(mode="after")
    def _each_column_once(self) -> Self:
        for column in self.columns:
            if self.columns.count(column) > 1:
                raise ValueError(f"names the column {column!r} twice; each number has its own")
        return self


class WrenchFields(StreamFields):
    """The wrench: its units, the axes that it is in, the point that its torques are about, and its sign."""

    BY_TOPIC = {**StreamFields.BY_TOPIC, "columns": ["fx", "fy", "fz", "tx", "ty", "tz"]}
    UNLESS_STATED = {"force": "N", "torque": "Nm"}

    columns: Annotated[list[Name], Field(min_length=6, max_length=6)]
    force: Force
    torque: Torque
    axes: Literal["sensor", "frame", "base"]
    about: Literal["sensor", "frame", "peg", "base"]
    sign: Literal["on_peg", "by_peg"]


class PoseStreamFields(StreamFields):
    """Poses of the frame in the robot's base: position and rotation, or a matrix row by row.

    `parent` and `child` are the two frames among those of a topic of transforms.
    """

    BY_TOPIC = {
        **StreamFields.BY_TOPIC,
        "columns": ["x", "y", "z", "qx", "qy", "qz", "qw"],
        "rotation": "xyzw",
    }
    UNLESS_STATED = {"length": "m"}

    parent: str | None = None
    child: str | None = None
    rotation: Rotation
    length: Length
    angle: Angle = "rad"

    @model_validator(mode="after")
    def _as_many_columns(self) -> Self:
        wanted = {"xyzw": (7,), "wxyz": (7,), "vector": (6,), "matrix": (12, 16)}[self.rotation]
        if len(self.columns) not in wanted:
            raise ValueError(
                f"has {len(self.columns)} columns for the rotation {self.rotation!r}; "
                f"give {' or '.join(map(str, wanted))}"
            )
        if (self.parent is None) != (self.child is None):
            raise ValueError("needs both parent and child, the frames of a topic of transforms")
        if self.parent is not None and not self.topic:
            raise ValueError("has parent and child, which are for a topic of transforms; leave them out")
        return self


class JointFields(StreamFields):
    """Joint angles, from the base outwards, and the robot whose link `tip` is the frame.

    With a topic, columns are the joints' names; by default those of the robot up to its tip.
    """

    UNLESS_STATED = {"angle": "rad", "columns": [EVERY_JOINT]}

    angle: Angle
    urdf: str
    tip: str


class ClockFields(Fields):
    """How late the wrench's stamps are relative to the pose's: stated, or estimated within a limit.

    `drift` is in parts per million: how much faster the wrench's clock runs. The
    limit is 0.1 s if none is given.
    """

    wrench_late: float | None = None
    drift: float = 0.0
    estimate: Literal["offset", "offset_and_drift"] = "offset"
    within: Above | None = None
    unit: Time = "s"

    @model_validator(mode="after")
    def _stated_together(self) -> Self:
        if self.drift and self.wrench_late is None:
            raise ValueError("states a drift but not wrench_late; give both, or estimate: offset_and_drift")
        if self.wrench_late is None:
            return self
        if estimated := sorted(self.model_fields_set & {"estimate", "within"}):
            raise ValueError(f"has both wrench_late and {estimated[0]}; leave one of them out")
        if self.wrench_late and "unit" not in self.model_fields_set:
            raise ValueError("has wrench_late without its unit; give unit: ms or unit: s")
        return self


class GravityFields(Fields):
    """The tool's weight: identified from the log, stated, or compensated by the controller already."""

    load: Literal["identified", "stated", "compensated"] = "identified"
    mass: AtLeast | None = None
    center: Three | None = None
    length: Length = "m"

    @model_validator(mode="after")
    def _stated(self) -> Self:
        if (self.load == "stated") != (self.mass is not None) or (self.mass is None) != (self.center is None):
            raise ValueError("needs mass (kg) and center (in the sensor's frame) with load: stated alone")
        return self


class CutFields(Fields):
    """The rate of the common stamps (1/s), and how they are cut into probes and windows (s, N).

    `gap` is the longest interval of a stream that is interpolated.
    """

    rate: Annotated[float, Field(ge=20.0, le=2000.0)] | None = None
    window: Above = 0.5
    find: Literal["whole", "touches"] = "whole"
    spans: list[Annotated[list[float], Field(min_length=2, max_length=2)]] = []
    force: Above = 2.0
    before: Above = 0.5
    after: Above = 0.3
    gap: Above | None = None

    @model_validator(mode="after")
    def _found_or_stated(self) -> Self:
        if {"find", "spans"} <= self.model_fields_set:
            raise ValueError("has both find and spans; leave one of them out")
        if "spans" in self.model_fields_set and not self.spans:
            raise ValueError("has no span in spans; give some, or leave it out")
        return self


class ArmFields(Fields):
    """Stiffness (N/m, N m/rad) and damping (N s/m, N m s/rad) along and about the commanded peg's axes."""

    stiffness: Annotated[list[AtLeast], Field(min_length=6, max_length=6)] = [5e4] * 3 + [2.5e3] * 3
    damping: Annotated[list[AtLeast], Field(min_length=6, max_length=6)] = [500.0] * 3 + [25.0] * 3


class BodyFields(Fields):
    """A mesh with the unit of its lengths, or a peg by its dimensions; and its convex pieces."""

    mesh: str | None = None
    round: Annotated[list[Above], Field(min_length=2, max_length=2)] | None = None
    box: Annotated[list[Above], Field(min_length=2, max_length=3)] | None = None
    length: Length
    name: str | None = None
    pieces: Literal["auto", "layers", "coacd", "none"] = "auto"
    clearance: Above | None = None

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        if sum(each is not None for each in (self.mesh, self.round, self.box)) != 1:
            raise ValueError("needs one of mesh, round: [diameter, length] and box: [width, length]")
        if (self.pieces == "coacd") != (self.clearance is not None):
            raise ValueError("needs the clearance of peg and hole with pieces: coacd, and only then")
        return self


class PegFields(BodyFields):
    """The held peg; its frame's origin is where it is held, z along it away from the tip."""

    peg_from_mesh: PoseFields = PoseFields()


class GuessFields(Fields):
    """The prior: the part's pose, half widths of its translations, limits of its tilt and yaw."""

    world_from_part: PoseFields
    translation: Annotated[list[AtLeast], Field(min_length=3, max_length=3)]
    length: Length
    tilt: AtLeast
    yaw: AtLeast
    angle: Angle


class BenchFields(Fields):
    """A whole configuration: of touches, or without a wrench of depth images alone."""

    part: BodyFields
    peg: PegFields | None = None
    guess: GuessFields
    wrench: WrenchFields | None = None
    pose: PoseStreamFields | None = None
    joints: JointFields | None = None
    command: PoseStreamFields | None = None
    frame_from_peg: PoseFields | None = None
    frame_from_sensor: PoseFields | None = None
    world_from_base: PoseFields = PoseFields()
    clock: ClockFields = ClockFields()
    gravity: GravityFields = GravityFields()
    cut: CutFields = CutFields()
    arm: ArmFields = ArmFields()
    cameras: dict[str, CameraFields] = {}
    truth: PoseFields | None = None
    model: str = "look_and_touch"
    source: str = ""

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.wrench is None and not self.cameras:
            raise ValueError("lacks both wrench (of touches) and cameras; add one of them")
        if self.wrench is None and self.command is not None:
            raise ValueError("has a command but no wrench, and so no touches; leave it out, or add wrench")
        placed = any(camera.needs_motion for camera in self.cameras.values())
        if self.pose is not None and self.joints is not None:
            raise ValueError("has both pose and joints; give one")
        if (self.wrench is not None or placed) and self.pose is None and self.joints is None:
            raise ValueError("needs either pose (of a frame of the robot) or joints (with a urdf and a tip)")
        return self

    @model_validator(mode="after")
    def _touched(self) -> Self:
        if self.wrench is None:
            return self
        for name, why in (("peg", "which is held"), ("frame_from_peg", "where the peg is on the frame")):
            if getattr(self, name) is None:
                raise ValueError(f"lacks {name}, {why}; add it")
        used = "sensor" in (self.wrench.axes, self.wrench.about) or self.gravity.load == "stated"
        if used and self.frame_from_sensor is None:
            raise ValueError("lacks frame_from_sensor, where the wrench's sensor is on the frame; add it")
        return self
