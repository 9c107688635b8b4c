"""Likelihoods of depth images by calibrated cameras, of a part alone or among clutter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pyro
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.depth import ClutteredDepth, RobustDepth
from bcppl.distributions.pose_normals import PoseFactor
from bcppl.distributions.poses import NormalPose
from bcppl.effort import Effort
from bcppl.geometry.camera import Camera
from bcppl.rendering.extrinsics_error import line_of_sight
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors.depth import View
from bcppl.sensors.likelihoods.viewpoints import InstrumentError, Sighting, viewpoints_of
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered
from bcppl.traces.carried import once


class CalibratedCamera:
    """Depth images by cameras that stand where they are stated to stand (`RobustDepth`), at `depth_*`.

    Args:
        recording: its part and the backgrounds of its cameras.
        renderer: of the part, or None for ray casting.
        noise: further arguments of `RobustDepth`: scale, outlier, effective_pixels, ...
    """

    def __init__(self, recording: Recording, renderer: PartRenderer | None = None, **noise: Any) -> None:
        self.renderer = renderer_for(recording.part) if renderer is None else renderer
        self.background, self.noise = recording.background, noise

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The cost of rendering."""
        return {"rendering": self.renderer.effort}

    def observe(self, number: int, action: View, world_from_part: Tensor) -> None:
        """Sample `depth_*`."""
        pyro.sample(f"depth_{number}", self.image(action.camera, world_from_part))

    def image(self, camera: Camera, part: Tensor) -> Any:
        """The likelihood of an image of a part at poses (N, 7)."""
        background = self.background.get(camera.name)
        return RobustDepth(self.renderer, camera, part, background=background, **self.noise)

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """The images, by address."""
        return {f"depth_{n}": torch.from_numpy(m.observation.depth) for n, m in measurements}


class ClutteredCamera(CalibratedCamera):
    """The same of a part among things that nobody has modelled (`ClutteredDepth`).

    A mesh is not quite the part, images are registered to a pixel or two, and ranges are biased: all pixels
    of a part share these errors. Where images from a viewpoint see the part, `seen_by_*`, is therefore
    another pose than where it is, and normal about it; half of its variance is common to all viewpoints of an
    instrument (`InstrumentError`).

    Args:
        recording: its part and the backgrounds of its cameras; where a background was measured, pixels off
            the part are independent, as for `CalibratedCamera`.
        renderer: of the part, or None for ray casting.
        stride: every so many rows and columns are used; of an image with a background every so many pixels
            in each direction.
        temperature: the divisor of the log-likelihood.
        clutter: whether unknown surfaces continue from pixel to pixel.
        shift, turn: standard deviations of where an image sees the part, along and about each axis, metres
            and radians; a shift of 0 for images that see it where it is.
        bias: the same along the ray, metres, in addition.
        scale: of a pixel's error, metres.
        noise: further arguments of `RobustDepth`, of images with a background or without clutter.
    """

    nuisance_addresses = ("seen_by_*",)

    def __init__(
        self,
        recording: Recording,
        renderer: PartRenderer | None = None,
        *,
        stride: int,
        temperature: float,
        clutter: bool,
        shift: float,
        turn: float,
        bias: float,
        scale: float,
        **noise: Any,
    ) -> None:
        super().__init__(recording, renderer, scale=scale, **noise)
        self.stride, self.temperature, self.clutter = stride, temperature, clutter
        self.shift, self.turn, self.bias, self.scale = shift, turn, bias, scale
        self.error = InstrumentError(self._effect, math.sqrt(0.5))
        self.viewpoints = viewpoints_of(recording)

    def observe(self, number: int, action: View, world_from_part: Tensor) -> None:
        """Sample `depth_*`, and with a viewpoint's first image its `seen_by_*`."""
        camera, seen = action.camera, world_from_part
        if self.shift:
            sightings: dict[str, Sighting] = once(f"instrument {self.instrument(action)}", dict)
            viewpoint = self.viewpoint(action)
            if viewpoint not in sightings:
                before = list(sightings.values())
                mean, covariance, _ = self.error.predicted(camera, seen, before, [seen] * len(before))
                around = NormalPose(poses.retract(seen, mean), covariance)
                sightings[viewpoint] = Sighting(camera, pyro.sample(f"seen_by_{viewpoint}", around))
            seen = sightings[viewpoint].seen
        pyro.sample(f"depth_{number}", self.image(camera, seen))

    def _effect(self, camera: Camera, part: Tensor) -> Tensor:
        """Changes (N, 6, 7) of where an image sees parts at poses (N, 7), by errors of one deviation."""
        ray = self.bias * line_of_sight(camera, part)
        along = torch.cat([ray, torch.zeros_like(ray)], dim=-1)[..., None]
        own = torch.diag(part.new_tensor([self.shift] * 3 + [self.turn] * 3))
        return torch.cat([own.expand(*part.shape[:-1], 6, 6), along], dim=-1)

    def instrument(self, action: View) -> str:
        """The name of the instrument, whose images' errors are correlated."""
        return action.camera.instrument

    def viewpoint(self, action: View) -> str:
        """The name of the viewpoint, from which all images see the part at the same pose."""
        return self.viewpoints.get(action.camera.name, action.camera.name)

    def factor(self, actions: Sequence[View], values: Mapping[str, Tensor]) -> PoseFactor:
        """The Gaussian over the part's pose, given where one camera sees it (N, 7)."""
        seen = [Sighting(a.camera, values[f"seen_by_{self.viewpoint(a)}"]) for a in actions]
        return self.error.factor(seen)

    def image(self, camera: Camera, part: Tensor) -> Any:
        """The likelihood of an image of a part that is seen at poses (N, 7)."""
        if self.clutter and self.background.get(camera.name) is None:
            every, divisor = self.stride, self.temperature
            return ClutteredDepth(self.renderer, camera, part, self.scale, lines=every, temperature=divisor)
        background, region = self.background.get(camera.name), grid(camera.height, camera.width, self.stride)
        noise = {"background": background, "region": region, **self.noise}
        return RobustDepth(self.renderer, camera, part, **noise)


@lru_cache(maxsize=16)
def grid(height: int, width: int, stride: int) -> npt.NDArray[np.bool_]:
    """Pixels (H, W) of a grid: every stride-th in each direction."""
    chosen = np.zeros((height, width), dtype=bool)
    chosen[::stride, ::stride] = True
    return chosen
