"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="A setting of the model, such as profile=panda; may be repeated. A belief has those of its run.",
    ),
]

Recorded = Annotated[str, typer.Argument(help="A recording (.h5), or the name of a shipped one.")]

Given = Annotated[
    str,
    typer.Argument(
        help="A recording (.h5), a shipped one's name, or a belief that `bcppl run` wrote (belief_*.h5)."
    ),
]

Of = Annotated[str | None, typer.Option(help="The recording that a belief is of.")]

ModelName = Annotated[str | None, typer.Option(help="A model's name or file, as for `bcppl run`.")]

InferenceName = Annotated[
    str | None, typer.Option(help="An inference program's name or file, as for `bcppl run`.")
]

Particles = Annotated[int, typer.Option(min=2, help="How many particles; a belief has its own.")]

AsJson = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON; all else goes to standard error.")
]
