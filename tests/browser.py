"""Pages opened in a browser without a screen and without a network, and pictures of them."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
OFFLINE = ("--host-resolver-rules=MAP * ~NOTFOUND", "--disable-background-networking", "--disable-sync")
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars")
SPACE = (0.0, 0.1, 0.55, 0.95)  # of the picture
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium to open the page in")


def opened(page: Path, state: str = "", seconds: int = 300) -> tuple[dict[str, str], Image.Image]:
    """What a page says of itself in a browser without a network, and a picture of it."""
    shot = page.with_suffix(".png")
    words = [
        "--headless=new",
        "--no-sandbox",
        f"--user-data-dir={page.parent / 'profile'}",
        *OFFLINE,
        *SOFTWARE,
    ]
    words += ["--window-size=1200,900", "--dump-dom", f"--screenshot={shot}", f"{page.as_uri()}{state}"]
    assert CHROMIUM is not None
    ran = subprocess.run([CHROMIUM, *words], capture_output=True, text=True, timeout=seconds)
    root = re.search("<html[^>]*>", ran.stdout)
    assert root is not None, ran.stderr
    return dict(re.findall(r'data-([a-z]+)="([^"]*)"', root[0])), Image.open(shot).convert("RGB")


def coloured(image: Image.Image, colour: Sequence[int], box: tuple[float, float, float, float]) -> int:
    """How many pixels in a box (shares of the picture) are nearly of a colour."""
    wide, high = image.size
    part = image.crop((int(box[0] * wide), int(box[1] * high), int(box[2] * wide), int(box[3] * high)))
    return int((np.abs(np.asarray(part).astype(int) - np.asarray(colour)).max(axis=-1) < 12).sum())
