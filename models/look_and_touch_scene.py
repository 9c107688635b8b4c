"""What stays the same while a part is looked at and touched, and what a measurement says of a pose of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.contact.god_object import GodObject, WindowMotion
from bcppl.contact.sensing.felt import Felt
from bcppl.contact.wrench import Sensing
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.fitted import FittedNormal
from bcppl.distributions.manifold import ContactManifold, MeasuresGap
from bcppl.distributions.manifold_fit import Told
from bcppl.distributions.pose_normals import Modes
from bcppl.effort import Effort
from bcppl.geometry.camera import Camera
from bcppl.geometry.gap import PegGap
from bcppl.models.camera_error import Cameras, Look
from bcppl.rendering.renderer import DepthRenderer
from bcppl.robot.motion import ProbeWindow


@dataclass(frozen=True)
class Settings(Cameras):
    """What is known of the cameras (`bcppl.models.camera_error.Cameras`) and of the arm.

    Attributes:
        temperature: how much less a pixel is worth than it seems; the errors hold what all have in common.
        gap_noise: m, of where the peg's surface is at one stamp.
        gap_shared: m, common to all stamps of a window: stiffness and geometry are known to so much.
        sink: m that the peg sinks into the part at the forces of a probe.
        gap_outlier: the probability that a stamp, or a window's contacts, are something else.
        every: so many stamps apart the peg's pose counts.
        felt: from which force on there is a contact.
        free_space: whether it counts that the part is not where the peg moved freely.
    """

    bins: int = 1
    temperature: float = 6.0
    gap_noise: float = 0.00006
    gap_shared: float = 0.00001
    sink: float = 0.00002
    gap_outlier: float = 0.001
    every: int = 5
    felt: Felt = field(default_factory=Felt)
    free_space: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        number_within("look_and_touch is given gap_noise {}", self.gap_noise, above=0.0)
        whole_number("look_and_touch is given every {}", self.every)


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over a run: the prior, the renderer, and what is looked at, by camera.

    Attributes:
        fits: by address, what an image alone says of where its camera sees the part, in the tangent space at
            the guess, and of the camera's bias.
        near: by address, whether a window's peg came near where images place the part.
        told: by the number of actions, what all of their touches say to second order.
        placed: by the number of actions, the normals that resemble what all of them say of the part.
    """

    prior: Any
    renderer: DepthRenderer
    looks: Mapping[str, Look]
    gap: PegGap | None
    proxy: GodObject | None
    sensing: Sensing | None
    settings: Settings
    fits: dict[str, FittedNormal] = field(default_factory=dict)
    told: dict[int, Told] = field(default_factory=dict)
    placed: dict[int, Modes] = field(default_factory=dict)
    near: dict[str, bool] = field(default_factory=dict)

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """What each simulator has done so far."""
        efforts = {"rendering": self.renderer.effort}
        return efforts if self.gap is None else {**efforts, "gap": self.gap.effort}


def image_of(scene: Scene, camera: Camera, there: Tensor, bias: Tensor | float) -> RobustDepth:
    """What a camera with a bias (N,) makes of a part at `there` (N, 7), taken by its word."""
    settings = scene.settings
    return RobustDepth(
        scene.renderer,
        camera,
        there,
        scale=settings.scale,
        outlier=settings.outlier,
        temperature=settings.temperature,
        bias=bias,
    )


def touch_of(
    scene: Scene, window: ProbeWindow, part: Tensor, blur: float = 0.0, gap: MeasuresGap | None = None
) -> ContactManifold:
    """What a window says of parts at poses (N, 7), or would with errors `blur` metres wider."""
    settings, measures = scene.settings, scene.gap if gap is None else gap
    assert measures is not None
    return ContactManifold(
        measures,
        part,
        len(range(window.first, window.last, settings.every)),
        math.hypot(settings.gap_noise, blur),
        math.hypot(settings.gap_shared, blur),
        settings.sink,
        settings.gap_outlier,
        None if scene.proxy is None else WindowMotion(scene.proxy, window, settings.every),
    )
