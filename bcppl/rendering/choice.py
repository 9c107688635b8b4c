"""Which renderer suits a part: triangles drawn, or rays cast."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.rasteriser import DepthRasteriser
from bcppl.rendering.renderer import DepthRenderer, Hits

Array = npt.NDArray[np.float64]

MOST_FACES = 30_000


class LensAwareRasteriser(DepthRasteriser):
    """Draws triangles, and casts rays for the cameras whose lens distorts: chosen anew at each call.

    What it has drawn and cast is counted together in its `effort`.
    """

    @cached_property
    def _rays(self) -> DepthRenderer:
        rays = DepthRenderer(self.part)
        rays.effort = self.effort
        return rays

    def hits(self, camera: Camera, world_from_part: Tensor | Array, *options: Any, **named: Any) -> Hits:
        """As `DepthRasteriser.hits`, for any lens."""
        if camera.is_distorted:
            return self._rays.hits(camera, world_from_part, *options, **named)
        return super().hits(camera, world_from_part, *options, **named)

    def images(self, camera: Camera, world_from_part: Tensor | Array) -> Array:
        """As `DepthRasteriser.images`, for any lens."""
        if camera.is_distorted:
            return self._rays.images(camera, world_from_part)
        return super().images(camera, world_from_part)


def renderer_for(part: Part, cameras: Iterable[Camera] = ()) -> DepthRasteriser | DepthRenderer:
    """The faster renderer of a part; all take the same calls and see the same, to single precision.

    `DepthRasteriser` draws triangles: its time goes with their number and with the pixels that they cover,
    and it uses all cores. It works in double precision. It is chosen for meshes of up to 30,000 faces. There
    it was the faster on one core, too: 8 to 32 times for a ring of 512 faces, 2.3 to 4.3 times for a drill of
    16,000 (75 poses, 128 x 128 to 640 x 480, `benchmarks/render.py`), and equal where only 32 x 32 pixels of
    the drill's images count, its worst case.

    `DepthRenderer` casts rays: its time goes with the pixels and hardly with the faces. It works in
    single precision. It is chosen for finer meshes, and where a lens of the `cameras` distorts.

    The rasteriser is compiled when it is first used, once for an installation: 11 s, then 0.6 s to load the
    code in every process. Where all rendering of a run takes a second, as with the
    shipped models, that is not worth while: they take `DepthRenderer`.

    Args:
        part: what is rendered; its mesh may be open.
        cameras: those that will see it. Without any, a mesh that is not too fine gets a
            `LensAwareRasteriser`, which casts rays for whatever camera turns out to distort.

    Raises:
        InputError: the mesh is empty or not finite.
    """
    expected = list(cameras)
    if any(camera.is_distorted for camera in expected) or len(part.faces) > MOST_FACES:
        return DepthRenderer(part)
    return DepthRasteriser(part) if expected else LensAwareRasteriser(part)
