"""The parameters of the bench: what of its scenes is drawn, and what its sensors do."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from bcppl.arguments import number_within
from bcppl.models.worlds.bench.errors import BenchErrors
from bcppl.models.worlds.simulated_sensors import ProbeErrors
from bcppl.rendering.depth_noise import DepthNoise


@dataclass(frozen=True)
class BenchParameters(ProbeErrors):
    """Parameters of the bench: metres, radians, newtons, seconds; standard deviations where not stated.

    Attributes:
        clearances: diametral; one is drawn per scene.
        top: (3,) guessed centre of the part's top face; the table's top is z = 0.
        translation, tilt, yaw: limits of the prior of the part's pose.
        distance, height, around: of a camera: from the guessed top; elevation above the table, seen from
            there; and between the headings of the two.
        width, rows, focal: of the images, pixels.
        depth_noise: of the depth images.
        camera_shift, camera_turn: errors of the cameras' stated poses, along and about each axis.
        camera_error_factor: by which they are larger, for cameras worse than stated.
        range_bias: of a camera's ranges.
        occluder: whether a box that is in no recording hides some of the part from one camera.
        hidden: the share of the part's pixels that it hides.
        force_drift, torque_drift: of the wrench sensor's bias after `drift_time` (s), N and N m.
        window: the length of a probe's windows, s.
        time_step: of the physics.
        friction: limits between which the coefficient is drawn.
        time_constant, damping_ratio: medians of the contacts'; drawn per scene, log-uniformly.
        contact_factor: the largest factor from the median.
        errors: of the robot, the grasp and the parts, all off by default.
    """

    clearances: tuple[float, ...] = (0.0001, 0.0002, 0.0005, 0.001)
    top: tuple[float, float, float] = (0.5, 0.0, 0.15)
    translation: float = 0.02
    tilt: float = math.radians(10.0)
    yaw: float = math.radians(30.0)
    distance: tuple[float, float] = (0.35, 0.6)
    height: tuple[float, float] = (math.radians(30.0), math.radians(60.0))
    around: float = math.radians(90.0)
    width: int = 160
    rows: int = 120
    focal: float = 160.0
    depth_noise: DepthNoise = field(
        default_factory=lambda: DepthNoise(scale=0.002, step=0.001, dropout=0.05, flying=0.5)
    )
    camera_shift: float = 0.002
    camera_turn: float = math.radians(0.5)
    camera_error_factor: float = 1.0
    range_bias: float = 0.002
    occluder: bool = False
    hidden: float = 1.0 / 3.0
    force_drift: float = 0.3
    torque_drift: float = 0.015
    drift_time: float = 6.0
    window: float = 0.5
    time_step: float = 0.0005
    friction: tuple[float, float] = (0.1, 0.5)
    time_constant: float = 0.004
    damping_ratio: float = 1.0
    contact_factor: float = 2.0
    errors: BenchErrors = field(default_factory=BenchErrors)

    @classmethod
    def real(cls) -> BenchParameters:
        """A bench with all the errors of a real one."""
        return cls(errors=BenchErrors.real())

    def __post_init__(self) -> None:
        number_within("the bench has camera_error_factor {}", self.camera_error_factor, least=0.0)
        number_within("the bench hides a share {} of the part", self.hidden, above=0.0, most=1.0)
        number_within("the bench has windows of {} s", self.window, above=0.0)
