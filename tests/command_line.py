"""What tests of the command line share: what a command printed, and a recording of a few pushes."""

from __future__ import annotations

import dataclasses
from importlib.resources import files
from pathlib import Path

from bcppl.recordings import Recording, load

SHIPPED = Path(str(files("bcppl.models") / "recordings/point_probe_10_pushes.h5"))
FEW_MOVES = Path(__file__).with_name("few_moves.py")
PROBE = Path(str(files("bcppl.models") / "point_probe.py"))


@dataclasses.dataclass
class Ran:
    code: int
    out: str
    err: str


def short(count: int = 3) -> Recording:
    whole = load(SHIPPED)
    return dataclasses.replace(whole, measurements=whole.measurements[:count])
