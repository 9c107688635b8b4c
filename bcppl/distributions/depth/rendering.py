"""The protocol of a renderer, which an image likelihood is given and does not import."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from torch import Tensor

from bcppl.arrays import Array, Mask

if TYPE_CHECKING:
    from bcppl.geometry.camera import Camera


class PixelHits(Protocol):
    """The pixels that see a part, for N particles: one entry for each (particle, pixel)."""

    @property
    def particle(self) -> npt.NDArray[np.int64]:
        """(M,) which particle."""

    @property
    def pixel(self) -> npt.NDArray[np.int64]:
        """(M,) which pixel, v * width + u."""

    @property
    def depth(self) -> Array:
        """(M,) depth along the optical axis, metres."""


class RendersDepth(Protocol):
    """A simulator of depth images, such as `bcppl.rendering.ray_casting.RayCaster`.

    One that renders K parts together has them in its attribute `parts` and takes poses (N, K, 7), as
    `bcppl.rendering.scene.SceneRenderer` does.
    """

    def hits(self, camera: Camera, world_from_part: Tensor, counted: Mask | None = None) -> PixelHits:
        """The camera's view of the part at poses (N, 7), at the counted pixels (H * W,) only."""

    def images(self, camera: Camera, world_from_part: Tensor) -> Array:
        """Depth images (N, H, W) in metres, +inf where a pixel does not see the part."""


class _Chosen(NamedTuple):
    """Some of the hits, as `PixelHits`."""

    particle: npt.NDArray[np.int64]
    pixel: npt.NDArray[np.int64]
    depth: Array


class CachedHits:
    """A camera's view of the same poses, compared with several images: rendered twice at most.

    The first image renders its own pixels alone, since most have no second. From then on all pixels that may
    count are cached.

    Args:
        render: the hits at the counted pixels (H * W,), or at all for None.
        region: (H * W,) pixels that may count; None for all.
    """

    __caches__ = ("_called", "_every")

    def __init__(self, render: Callable[[Mask | None], PixelHits], region: Mask | None) -> None:
        self._render, self._region = render, region
        self._called = False
        self._every: PixelHits | None = None

    def keep_all(self) -> CachedHits:
        """Itself, which renders every pixel at its first call: for images that count different ones."""
        self._called = True
        if self._region is not None:
            self._region, self._every = None, None  # what was cached lacks the pixels outside
        return self

    def __call__(self, counted: Mask) -> PixelHits:
        """The hits at the counted pixels (H * W,)."""
        if self._every is None:
            if not self._called:
                self._called = True
                return self._render(counted)
            self._every = self._render(self._region)
        every = self._every
        kept = np.flatnonzero(counted.take(every.pixel))
        return _Chosen(every.particle[kept], every.pixel[kept], every.depth[kept])
