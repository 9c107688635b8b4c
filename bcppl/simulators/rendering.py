"""Which renderer suits a part: triangles drawn, or rays cast."""

from __future__ import annotations

from collections.abc import Iterable

from bcppl.parts import Part
from bcppl.simulators.camera import Camera
from bcppl.simulators.rasteriser import DepthRasteriser
from bcppl.simulators.renderer import DepthRenderer

MOST_FACES = 30_000


def renderer_for(part: Part, cameras: Iterable[Camera] = ()) -> DepthRasteriser | DepthRenderer:
    """The faster renderer of a part; both take the same calls and see the same, to single precision.

    `DepthRasteriser` draws triangles: its time goes with their number and with the pixels that they cover,
    and it uses all cores. It is chosen for meshes of up to 30,000 faces. There it was the faster on one core,
    too: 8 to 20 times for a ring of 512 faces, 1.8 to 6 times for a drill of 16,000 (75 poses, 128 x 128 to
    640 x 480), and equal where only 32 x 32 pixels of the drill's images count, its worst case.

    `DepthRenderer` casts rays: its time goes with the pixels and hardly with the faces. It is chosen for
    finer meshes, and where a camera's lens distorts.

    The rasteriser is compiled when it is first used, once for an installation: 11 s, then 0.6 s to load the
    code in every process. Where all rendering of a run takes a second, as with the
    shipped models, that is not worth while: they take `DepthRenderer`.

    Args:
        part: what is rendered; its mesh may be open.
        cameras: those that will see it; without any, none is taken to distort.

    Raises:
        InputError: the mesh is empty or not finite.
    """
    distorted = any(camera.is_distorted for camera in cameras)
    if distorted or len(part.faces) > MOST_FACES:
        return DepthRenderer(part)
    return DepthRasteriser(part)
