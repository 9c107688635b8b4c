"""What is in a REASSEMBLE file, and a configuration of it with guesses, to be edited."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.drafts import GUESS, drafted, offer, refuse_place, spelled
from bcppl.recordings.importers.reassemble.reading import Segment, arrays, board, segments, span
from bcppl.untrusted.visible_text import visible

_INSERTION = "insert"


def show(path: Path, write: Path | None) -> None:
    """List the arrays and the segments of a file, and print a configuration of it, or write it to a file.

    Raises:
        InputError: the file is damaged or has no poses, or the file to write exists.
    """
    refuse_place(write)
    held, actions, place = arrays(path), segments(path), board(path)
    if "pose" not in held or not len(held["pose"].times):
        raise InputError(f"{path} has no poses; give another file of the data set.")
    zero = float(held["pose"].times[0])
    console = Console()
    table = Table("array", "columns", "rows", "mean rate", box=None, pad_edge=False)
    for name, each in held.items():
        lasts = float(each.times[-1] - each.times[0]) if len(each.times) else 0.0
        rate = f"{(len(each.times) - 1) / lasts:.4g} Hz" if lasts > 0.0 else "-"
        table.add_row(escape(visible(name)), str(each.values.shape[1]), str(len(each.times)), rate)
    console.print(table)
    table = Table("segment", "from", "to", "success", "action", box=None, pad_edge=False)
    for number, action in enumerate(actions):
        begin, end = span(action, zero)
        success = "yes" if action.success else "no"
        table.add_row(str(number), f"{begin:.2f} s", f"{end:.2f} s", success, escape(action.text))
    console.print(table)
    text = _configuration(path, actions, zero)
    if place is not None:
        xyz, xyzw = (", ".join(f"{number:.6g}" for number in each) for each in place)
        console.print(f"the board is at {{xyz: [{xyz}], xyzw: [{xyzw}]}} in the robot's base", markup=False)
    offer(console, text, write, f"bcppl import reassemble {path} {write}")


def _configuration(path: Path, actions: list[Segment], zero: float) -> str:
    streams = (
        "wrench:\n"
        f"  topic: compensated_base_force  {GUESS}; or measured_force: axes and about sensor, no gravity\n"
        "  axes: base\n"
        "  about: base\n"
        "  sign: on_peg                              # what the part exerts on the peg; not documented\n"
        "pose:\n"
        f"  topic: pose  {GUESS}\n"
    )
    spans = [
        [round(edge, 2) for edge in span(action, zero)]
        for action in actions
        if action.success and action.text.lower().startswith(_INSERTION)
    ]
    cut = f"cut: {{spans: {spans}}}  {GUESS}: the insertions that succeeded\n" if spans else ""
    more = f"gravity: {{load: compensated}}\n{cut}"
    command = f"bcppl import reassemble {spelled(path.name)} CONFIG"
    return drafted(command, "the file", streams, "", more)
