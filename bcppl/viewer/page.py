"""The page as one file of HTML, which asks nothing of any other file or host.

Its Content-Security-Policy allows the one script and the one style that it holds, by their hashes, and no
request at all: text from a recording cannot run, and is written by the script as text.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from bcppl.recordings.hdf5 import replacing
from bcppl.robot.arm_with_peg import ArmWithPeg
from bcppl.sensors import Recording
from bcppl.untrusted.visible_text import visible
from bcppl.viewer.held import History, content

SCRIPTS = ("scene.js", "pictures.js", "page.js", "live.js")
HEIGHT = 820  # pixels, in a notebook


@dataclass(frozen=True, repr=False)
class Page:
    """A page.

    Attributes:
        text: the HTML.
        steps: how many steps it shows, the prior among them.
    """

    text: str
    steps: int

    def __repr__(self) -> str:
        return f"Page({self.steps} steps, {len(self.text) / 1e6:.1f} MB)"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page to a file, whole or not at all.

        Raises:
            InputError: it cannot be written.
        """
        with replacing(path) as beside:
            beside.write_text(self.text, encoding="utf-8")

    def _repr_html_(self) -> str:
        """The page in a frame of its own, for a notebook; its policy holds there too."""
        # Without `sandbox`: Chromium 150 leaves a sandboxed srcdoc of this size blank.
        style = f"width:100%;height:{HEIGHT}px;border:0"
        return f'<iframe style="{style}" srcdoc="{html.escape(self.text)}"></iframe>'


def view(
    recording: Recording,
    history: History = (),
    rows: Sequence[Mapping[str, str]] = (),
    *,
    title: str = "",
    facts: Mapping[str, object] | None = None,
    notes: Sequence[str] = (),
    arm: ArmWithPeg | None = None,
) -> Page:
    """The page of a run, or of a recording alone, to be saved or shown in a notebook.

    Part, peg, cameras and particles in space; a slider over the measurements; measured depth beside depth
    rendered at the mean or at a particle that is chosen, the force over time, the gap between peg and part.

    Args:
        recording: that was run, every measurement once.
        history: by step its label and belief, the prior first, as `(step.info.label, step.belief)`; nothing
            shows the recording alone, the part at its guess.
        rows: of a table, one for each step, such as `rows` of a run.json.
        title: of the page.
        facts: about the run, for the page's head.
        notes: sentences about the run, such as its warnings.
        arm: that holds the peg; it is drawn where the peg was measured, by inverse kinematics.

    Raises:
        InputError: there are more beliefs than measurements and the prior, or rows for other steps; or the
            arm reaches no touch.

    Warns:
        RuntimeWarning: the arm's meshes cannot be read, and segments are drawn in their place.
    """
    return page_of(content(recording, history, rows, facts, notes, arm), title or recording.part.name)


def page_of(held: Mapping[str, Any], title: str, sources: str = "") -> Page:
    """The page of a `content`.

    Args:
        held: the content.
        title: of the page.
        sources: what its script may connect to, as its policy states it; by default nothing.
    """
    title = visible(title)
    # Within a script element only "<" can begin what ends it, and JSON has it in strings alone.
    data = as_json(held).replace("<", "\\u003c")
    script = "\n".join(_text(name) for name in SCRIPTS)
    style = _text("page.css")
    page = _text("page.html")
    policy = f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'; base-uri 'none'"
    policy += f"; connect-src {sources}" if sources else ""
    pieces = {
        "POLICY": policy,
        "TITLE": html.escape(title),
        "STYLE": style,
        "DATA": data,
        "SCRIPT": script,
    }
    # Piece by piece from the template, so that nothing in a piece is taken for the place of another.
    text = "".join(pieces.get(word, word) for word in page.split("%%"))
    return Page(text, len(held["entries"]))


def _text(name: str) -> str:
    return files("bcppl.viewer").joinpath(name).read_text(encoding="utf-8").strip()


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def as_json(held: Mapping[str, Any]) -> str:
    """A content, or an entry of one, in one line."""
    return json.dumps(_plain(held), allow_nan=False)


def _plain(value: Any) -> Any:
    """The same with each array as its type, shape and little-endian bytes in base64."""
    if isinstance(value, np.ndarray):
        kept = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
        encoded = base64.b64encode(kept.tobytes()).decode("ascii")
        return {"type": kept.dtype.str[1:], "shape": list(kept.shape), "base64": encoded}
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value
