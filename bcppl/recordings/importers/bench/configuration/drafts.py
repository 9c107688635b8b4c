"""Configurations with guesses, of the template of `bcppl new bench` and of what is known of a log."""

from __future__ import annotations

import math
from importlib.resources import files
from pathlib import Path

import yaml
from rich.console import Console

from bcppl.errors import InputError

GUESS = "# a guess"
_FIRST = "# A robot bench's log, for: bcppl import bench bench.yaml -o recording.h5\n"


def drafted(command: str, source: str, streams: str, cameras: str, more: str = "") -> str:
    """A configuration in YAML.

    Args:
        command: that reads it, with the word CONFIG.
        source: of the guesses, such as "the bag".
        streams: the fields of wrench and motion.
        cameras: the fields of the cameras.
        more: fields that the log's format states.
    """
    template = files("bcppl.recordings.importers.bench.configuration").joinpath("template.yaml")
    before, rest = template.read_text(encoding="utf-8").split("wrench:\n", 1)
    frames = rest[rest.index("frame_from_peg:") : rest.index("cameras:\n")]
    after = rest[rest.index("# What follows") :]
    head = before.replace(_FIRST, f"# For: {command} -o recording.h5\n")
    head = head.replace(
        "\npart:", f"\n# Lines with {GUESS[2:]!r} come from {source}; all others are examples.\npart:"
    )
    return "".join([head, streams, frames, cameras, more, after])


def spelled(name: str) -> str:
    """A name from a log as YAML has it within one line, in quotes where it would read as something else.

    A line break in a name would otherwise begin a field, in a comment too.
    """
    plain = name.isprintable()
    text = yaml.safe_dump(
        [name],
        default_flow_style=True,
        default_style=None if plain else '"',
        allow_unicode=plain,
        width=math.inf,
    )
    return str(text).strip()[1:-1]


def refuse_place(write: Path | None) -> None:
    """Refuse a file to write that is there already, or whose folder is not."""
    if write is not None and write.exists():
        raise InputError(f"{write} exists already; give another name, or remove it first.")
    if write is not None and not write.parent.is_dir():
        raise InputError(f"there is no folder {write.parent} to write {write.name} into; make it first.")


def refuse_both(write: Path | None, log: str) -> None:
    """Refuse a configuration to write beside one to read."""
    if write is not None:
        raise InputError(f"--write is for a {log} without a configuration; leave out one of the two.")


def offer(console: Console, text: str, write: Path | None, command: str) -> None:
    """Print a configuration, or write it to a file.

    Args:
        console: to print on.
        text: of the configuration.
        write: the file; None to print.
        command: that reads the file.
    """
    if write is None:
        console.print(f"\nA configuration; lines with {GUESS!r} are to be checked:\n", markup=False)
        console.print(text, highlight=False, markup=False, soft_wrap=True)
        return
    write.write_text(text, encoding="utf-8")
    print(f"wrote {write}: edit it, then {command} -o recording.h5")
