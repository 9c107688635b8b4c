"""Image files from elsewhere, which importers open; each importer has its own sentence for what is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

MOST_PIXELS = 8 << 20  # beyond one for each byte of the file: an image of depth takes 64 MB


@contextmanager
def opened(path: Path, formats: list[str]) -> Iterator[Image.Image]:
    """An image file whose chunks were checked, its pixels not yet read.

    Args:
        path: of the file.
        formats: by Pillow's names: those that it gives to other programs, such as EPS, are none.

    Raises:
        ValueError: it claims more pixels than its size explains. Pillow itself raises errors of many types.
    """
    with _header(path, formats) as image:
        image.verify()  # reads all chunks, and none of the pixels
    with _header(path, formats) as image:
        yield image


def _header(path: Path, formats: list[str]) -> Image.Image:
    image = Image.open(path, formats=formats)
    if image.width * image.height > MOST_PIXELS + path.stat().st_size:
        raise ValueError(f"it claims {image.width} x {image.height} pixels in {path.stat().st_size} bytes")
    return image
