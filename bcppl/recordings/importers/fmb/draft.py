"""What is in an FMB trajectory, and a configuration of it with guesses, to be edited."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bcppl.recordings.importers.bench.configuration.drafts import GUESS, drafted, offer, refuse_place, spelled
from bcppl.recordings.importers.fmb.reading import FORCE, POSE, Trajectory
from bcppl.untrusted.visible_text import visible

_DEPTH = "_depth"
_INSERTION = "insert"


def show(trajectory: Trajectory, write: Path | None) -> None:
    """List the arrays and skills of a trajectory, and print a configuration of it, or write it to a file.

    Raises:
        InputError: the file is damaged, or the file to write exists.
    """
    refuse_place(write)
    console = Console()
    table = Table("array", box=None, pad_edge=False)
    for name in trajectory.names:
        table.add_row(escape(visible(name)))
    console.print(table)
    skills = trajectory.skills()
    table = Table("skill", "from", "to", box=None, pad_edge=False)
    for name, begin, end in skills:
        table.add_row(escape(visible(name)), f"{begin:.1f} s", f"{end:.1f} s")
    console.print(table)
    spans = [[begin, end] for name, begin, end in skills if name == _INSERTION and end > begin]
    offer(console, _configuration(trajectory, spans), write, f"bcppl import fmb {trajectory.path} {write}")


def _configuration(trajectory: Trajectory, spans: list[list[float]]) -> str:
    streams = (
        "wrench:\n"
        f"  topic: {FORCE}  {GUESS}, as the next two lines\n"
        "  axes: frame\n"
        "  about: frame\n"
        "  sign: on_peg                              # what the part exerts on the peg; not documented\n"
        "pose:\n"
        f"  topic: {POSE}  {GUESS}\n"
    )
    cameras = "cameras:\n" if any(name.endswith(_DEPTH) for name in trajectory.names) else ""
    for name in trajectory.names:
        if name.endswith(_DEPTH):
            short = name.rpartition("/")[2].removesuffix(_DEPTH)
            place = "frame_from_camera" if short.startswith("wrist") else "world_from_camera"
            cameras += (
                f"  {spelled(short)}:  {GUESS}\n"
                f"    {{topic: {spelled(name)}, fx: 245, fy: 325, cx: 127.5, cy: 127.5,  # pixels\n"
                f"     near: 0.1, far: 1.5, scale: 0.0001,     # metres per count: not documented\n"
                f"     {place}: {{xyz: [0, 0, 0]}}, images: [{{time: 0.0}}]}}\n"
            )
    cut = f"cut: {{spans: {spans}}}  {GUESS}: the insertions\n" if spans else ""
    more = (
        f"clock: {{wrench_late: 0}}  {GUESS}: both are of one message\ngravity: {{load: compensated}}\n{cut}"
    )
    command = f"bcppl import fmb {spelled(trajectory.path.name)} CONFIG"
    return drafted(command, "the file", streams, cameras, more)
