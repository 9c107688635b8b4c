"""The fields of a bench's configuration, as pydantic models: strict, and without any that are not known.

A word such as `mm` states a unit, and `factor` what it is in SI. Poses are named after the frames that they
take from and to; `frame` is the robot's frame whose pose is logged, such as the flange or the tool's centre.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Length = Literal["m", "cm", "mm", "um"]
Angle = Literal["rad", "deg"]
Time = Literal["s", "ms", "us", "ns"]
Force = Literal["N", "mN", "kN", "lbf"]
Torque = Literal["Nm", "Ncm", "Nmm", "lbfin"]
Rotation = Literal["xyzw", "wxyz", "vector", "matrix"]

_SI = {
    **{"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    **{"rad": 1.0, "deg": 0.017453292519943295},
    **{"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    **{"N": 1.0, "mN": 1e-3, "kN": 1e3, "lbf": 4.4482216152605},
    **{"Nm": 1.0, "Ncm": 1e-2, "Nmm": 1e-3, "lbfin": 0.1129848290276167},
}

Three = Annotated[list[float], Field(min_length=3, max_length=3)]
Four = Annotated[list[float], Field(min_length=4, max_length=4)]
Above = Annotated[float, Field(gt=0.0)]
AtLeast = Annotated[float, Field(ge=0.0)]
Name = str | int  # of a column, or its number where a file has no names


def factor(unit: str) -> float:
    """What one of a unit is in SI: metres, radians, seconds, newtons, newton metres."""
    return _SI[unit]


class Fields(BaseModel):
    """Fields that are checked strictly; one that is not known is an error."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class PoseFields(Fields):
    """A pose: a translation and one way to write its rotation, or a matrix; without a rotation, no turn."""

    xyz: Three = [0.0, 0.0, 0.0]
    length: Length = "m"
    xyzw: Four | None = None
    wxyz: Four | None = None
    vector: Three | None = None
    angle: Angle = "rad"
    matrix: list[float] | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> Self:
        given = [name for name in ("xyzw", "wxyz", "vector", "matrix") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"has its rotation as {' and as '.join(given)}; give one of them")
        if self.matrix is not None and len(self.matrix) not in (12, 16):
            raise ValueError(f"has a matrix of {len(self.matrix)} numbers; give 12 or 16, row by row")
        if self.matrix is not None and any(self.xyz):
            raise ValueError("has both a matrix and xyz; give the matrix alone")
        return self


class TimeFields(Fields):
    """The column of a stream's stamps, and their unit."""

    column: Name
    unit: Time


class StreamFields(Fields):
    """A stream: a file, its stamps, and its columns by name."""

    file: str
    time: TimeFields
    columns: Annotated[list[Name], Field(min_length=1)]


class WrenchFields(StreamFields):
    """The wrench: its units, the axes that it is in, the point that its torques are about, and its sign."""

    columns: Annotated[list[Name], Field(min_length=6, max_length=6)]
    force: Force
    torque: Torque
    axes: Literal["sensor", "frame", "base"]
    about: Literal["sensor", "frame", "peg", "base"]
    sign: Literal["on_peg", "by_peg"]


class PoseStreamFields(StreamFields):
    """Poses of the frame in the robot's base: position and rotation, or a matrix row by row."""

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
        return self


class JointFields(StreamFields):
    """Joint angles, from the base outwards, and the robot whose link `tip` is the frame."""

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


class ArmFields(Fields):
    """Stiffness (N/m, N m/rad) and damping (N s/m, N m s/rad) along and about the commanded peg's axes."""

    stiffness: Annotated[list[AtLeast], Field(min_length=6, max_length=6)] = [5e4] * 3 + [2.5e3] * 3
    damping: Annotated[list[AtLeast], Field(min_length=6, max_length=6)] = [500.0] * 3 + [25.0] * 3


class ImageFields(Fields):
    """One depth image: when it was taken, or where the frame or the camera was; or of a fixed camera."""

    file: str
    time: float | None = None
    world_from_frame: PoseFields | None = None


class CameraFields(Fields):
    """A depth camera: its intrinsics (pixels), the unit of its images, its range (m) and its pose."""

    fx: Above
    fy: Above
    cx: float
    cy: float
    distortion: list[float] = []
    unit: Length | None = None
    scale: Above | None = None
    near: AtLeast
    far: Above
    world_from_camera: PoseFields | None = None
    frame_from_camera: PoseFields | None = None
    time_unit: Time = "s"
    images: Annotated[list[ImageFields], Field(min_length=1)]
    background: str | None = None

    @model_validator(mode="after")
    def _placed(self) -> Self:
        if (self.unit is None) == (self.scale is None):
            raise ValueError("needs either unit (of its depth) or scale (metres per count)")
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
    """A whole configuration."""

    part: BodyFields
    peg: PegFields
    guess: GuessFields
    wrench: WrenchFields
    pose: PoseStreamFields | None = None
    joints: JointFields | None = None
    command: PoseStreamFields | None = None
    frame_from_peg: PoseFields
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
        if (self.pose is None) == (self.joints is None):
            raise ValueError("needs either pose (of a frame of the robot) or joints (with a urdf and a tip)")
        used = "sensor" in (self.wrench.axes, self.wrench.about) or self.gravity.load == "stated"
        if used and self.frame_from_sensor is None:
            raise ValueError("lacks frame_from_sensor, where the wrench's sensor is on the frame; add it")
        return self
