"""Likelihoods of depth images by calibrated cameras, of a part alone or among clutter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pyro
import torch
from torch import Tensor

from bcppl.distributions.depth import ClutteredDepth, RobustDepth
from bcppl.effort import Effort
from bcppl.geometry.camera import Camera
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.ray_casting import RayCaster
from bcppl.sensors.depth import View
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered


class CalibratedCamera:
    """Depth images by cameras that stand where they are stated to stand (`RobustDepth`), at `depth_*`.

    Args:
        recording: its part and the backgrounds of its cameras.
        renderer: of the part, or None for ray casting.
        noise: further arguments of `RobustDepth`: scale, outlier, effective_pixels, ...
    """

    def __init__(self, recording: Recording, renderer: PartRenderer | None = None, **noise: Any) -> None:
        self.renderer = RayCaster(recording.part) if renderer is None else renderer
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

    Args:
        recording: its part and the backgrounds of its cameras; where a background was measured, pixels off
            the part are independent, as for `CalibratedCamera`.
        renderer: of the part, or None for ray casting.
        stride: every so many rows and columns are used; of an image with a background every so many pixels
            in each direction.
        temperature: the divisor of the log-likelihood.
        noise: further arguments of `RobustDepth`.
    """

    def __init__(
        self,
        recording: Recording,
        renderer: PartRenderer | None = None,
        *,
        stride: int,
        temperature: float,
        clutter: bool,
        **noise: Any,
    ) -> None:
        super().__init__(recording, renderer, **noise)
        self.stride, self.temperature, self.clutter = stride, temperature, clutter

    def image(self, camera: Camera, part: Tensor) -> Any:
        """The likelihood of an image of a part at poses (N, 7)."""
        if self.clutter and self.background.get(camera.name) is None:
            scale, stride, temperature = self.noise["scale"], self.stride, self.temperature
            return ClutteredDepth(self.renderer, camera, part, scale, lines=stride, temperature=temperature)
        background, region = self.background.get(camera.name), grid(camera.height, camera.width, self.stride)
        noise = {"background": background, "region": region, **self.noise}
        return RobustDepth(self.renderer, camera, part, **noise)


@lru_cache(maxsize=16)
def grid(height: int, width: int, stride: int) -> npt.NDArray[np.bool_]:
    """Pixels (H, W) of a grid: every stride-th in each direction."""
    chosen = np.zeros((height, width), dtype=bool)
    chosen[::stride, ::stride] = True
    return chosen
