"""Pages opened in a browser without a screen and without a network, and pictures of them."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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


# Chromium reads from descriptor 3 and writes to 4.
WITH_PIPES = """
import fcntl, os, sys
asked, answers = (fcntl.fcntl(int(each), fcntl.F_DUPFD, 10) for each in sys.argv[1:3])
os.dup2(asked, 3)
os.dup2(answers, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Browser:
    """A browser that stays open, asked through pipes (DevTools protocol); it reaches this machine alone."""

    def __init__(self, url: str, profile: Path) -> None:
        assert CHROMIUM is not None
        words = ["--headless=new", "--no-sandbox", f"--user-data-dir={profile}", "--window-size=1200,900"]
        words += [
            *SOFTWARE,
            *OFFLINE[1:],
            f"{OFFLINE[0]} , EXCLUDE 127.0.0.1",
            "--remote-debugging-pipe",
            url,
        ]
        (read, answers), (asked, self._write) = os.pipe(), os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-c", WITH_PIPES, str(asked), str(answers), CHROMIUM, *words],
            pass_fds=(asked, answers),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(asked)
        os.close(answers)
        self._read = os.fdopen(read, "rb")
        self._count, self._session = 0, ""
        while not (pages := [t for t in self.ask("Target.getTargets")["targetInfos"] if t["type"] == "page"]):
            time.sleep(0.1)
        target = {"targetId": pages[0]["targetId"], "flatten": True}
        self._session = self.ask("Target.attachToTarget", **target)["sessionId"]

    def ask(self, method: str, **params: object) -> dict[str, Any]:
        """The result of a method."""
        self._count += 1
        message: dict[str, object] = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            letters = iter(lambda: self._read.read(1), b"\0")
            answer = json.loads(b"".join(letters))
            if answer.get("id") == self._count:
                return dict(answer["result"])

    def evaluated(self, script: str) -> Any:
        """The value of an expression on the page."""
        return self.ask("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def state(self, wanted: Mapping[str, str], seconds: float = 60.0) -> dict[str, str]:
        """What the page says of itself, once that includes what is wanted."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            state = dict(self.evaluated("({...document.documentElement.dataset})") or {})
            if wanted.items() <= state.items():
                return state
            time.sleep(0.1)
        raise AssertionError(f"{state} has not become {wanted}")

    def picture(self) -> Image.Image:
        """What the page looks like."""
        data = self.ask("Page.captureScreenshot")["data"]
        return Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._write)
        self._read.close()


def coloured(image: Image.Image, colour: Sequence[int], box: tuple[float, float, float, float]) -> int:
    """How many pixels in a box (shares of the picture) are nearly of a colour."""
    wide, high = image.size
    part = image.crop((int(box[0] * wide), int(box[1] * high), int(box[2] * wide), int(box[3] * high)))
    return int((np.abs(np.asarray(part).astype(int) - np.asarray(colour)).max(axis=-1) < 12).sum())
