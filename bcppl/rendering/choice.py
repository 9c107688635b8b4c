"""The faster renderer of a part."""

from __future__ import annotations

from bcppl.geometry.parts import Part
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.rasterisation import Rasteriser
from bcppl.rendering.ray_casting import RayCaster

MOST_FACES = 30_000


def renderer_for(part: Part) -> PartRenderer:
    """The faster renderer of a part: `Rasteriser` up to 30,000 faces, `RayCaster` above.

    Both take the same calls, and their depths agree to single precision. On one core rasterisation was faster
    than ray casting by factors of 8 to 32 for a ring of 512 faces and of 2.3 to 4.3 for a drill of 16,000
    (75 poses, 128 x 128 to 640 x 480, `benchmarks/render.py`), and as fast in its worst case, where only
    32 x 32 pixels of the drill's images count.

    The rasteriser is compiled on its first use, once for an installation: 11 s, then 0.6 s to load the code
    in every process. The shipped models render for about a second in a run, and use `RayCaster`.

    Args:
        part: the part; its mesh may be open.

    Raises:
        InputError: the mesh is empty or not finite.
    """
    return RayCaster(part) if len(part.faces) > MOST_FACES else Rasteriser(part)
